"""A flexible force beats named effects only by a share of the whole gap that matters."""

from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.summary.verdict import beaten as is_beaten

WINDOWS, NOISE = 10, 50.0


def found(base: float, named: float, flexible: float, significant: bool = True):
    """Findings whose mean squares per sample are these, in noise units."""

    def total(level):
        return level * NOISE * WINDOWS

    state = SimpleNamespace(
        base=SimpleNamespace(plain=np.full(WINDOWS, total(base) / WINDOWS), cost=np.zeros(WINDOWS)),
        noise=NOISE,
    )
    condition = SimpleNamespace(significant=significant, cost=np.full(WINDOWS, total(flexible) / WINDOWS))
    model = SimpleNamespace(plain=np.full(WINDOWS, total(named) / WINDOWS))
    return SimpleNamespace(
        selection=SimpleNamespace(state=state), model=model, flexible_base=SimpleNamespace(condition=condition)
    )


@pytest.mark.parametrize(
    ("base", "named", "flexible", "significant", "beaten"),
    [
        (1000, 400, 100, True, True),  # 30 % of the gap more
        (1000, 400, 100, False, False),
        (1000, 400, 300, True, False),  # better, but not much
        (1e6, 400, 100, True, False),  # the effects closed 99.96 %: what is left is real and irrelevant
    ],
)
def test_beaten_is_relevant_and_significant(base, named, flexible, significant, beaten):
    assert is_beaten(found(base, named, flexible, significant)) is beaten
