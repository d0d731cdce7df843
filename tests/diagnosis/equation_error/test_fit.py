"""The model of the effort and its derivative, and a fit of a scale and a sum to products made by hand."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis.equation_error import fit as fitting
from bayessim_mjx.diagnosis.equation_error import terms
from bayessim_mjx.diagnosis.equation_error.sums import Layout, Sums

LAYOUT = Layout(bodies=0, nv=2)
SPEED, KNOWN, EFFORT = (LAYOUT.at(n) for n in ("speed", "known", "effort"))


def column(dof: int, at: int, size: float = 1.0) -> np.ndarray:
    out = np.zeros((LAYOUT.nv, LAYOUT.size))
    out[dof, at] = size
    return out


def drag(dof: int) -> fitting.Term:
    maps = column(dof, SPEED)[:, :, None]
    return fitting.Term("viscous_friction", f"joint{dof}", lambda c: maps)


def test_the_derivative_is_that_of_the_model() -> None:
    """Of a scale on a sum, and of one drive of two at a joint."""
    every = np.ones(2, bool)
    own = [
        drag(0),
        terms.scale("actuator_gain", "all", every),
        terms.scale("actuator_gain", "left", every & [0, 1], rest=column(1, EFFORT, 0.3)),
    ]
    spans, values = [slice(i, i + 1) for i in range(3)], np.array([0.7, 1.2, 0.8])
    design = fitting._effort(LAYOUT, own, spans, values)[1]
    for k, step in enumerate(1e-6 * np.eye(3)):
        ends = [fitting._effort(LAYOUT, own, spans, values + s * step)[0] for s in (1, -1)]
        assert design[:, :, k] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-8)


def test_a_scale_and_a_sum_are_found_together() -> None:
    """effort = 0.8 (known + 0.5 speed) at both joints."""
    rng, rows = np.random.default_rng(0), 400
    gram = np.zeros((2, LAYOUT.size, LAYOUT.size))
    for v in range(2):
        x = np.zeros((rows, LAYOUT.size))
        x[:, [KNOWN, SPEED]] = rng.normal(size=(rows, 2))
        x[:, EFFORT] = 0.8 * (x[:, KNOWN] + 0.5 * x[:, SPEED])
        gram[v] = x.T @ x
    sums = Sums(LAYOUT, gram, np.full(2, float(rows)), ("effort", "effort"), 0.01)
    scale = terms.scale("actuator_gain", "all", np.ones(2, bool))
    found = fitting.fit(sums, [drag(0), drag(1), scale])
    assert found.values == pytest.approx([0.5, 0.5, 0.8], abs=1e-4) and found.feasible
    assert np.sqrt(fitting.left(sums, found.model)).max() < 1e-4
    assert fitting.evidence(sums, found) > fitting.evidence(sums, fitting.fit(sums, [drag(0), drag(1)]))
