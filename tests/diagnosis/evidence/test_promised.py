"""What effects promise: Shapley's shares by hand, and on a linear problem exactly what is then realised."""

from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.evidence import selecting
from bayessim_mjx.diagnosis.fitting.candidates import Candidate, Coordinate
from bayessim_mjx.diagnosis.fitting.fitter import Fit
from bayessim_mjx.diagnosis.selection.screen import Column

GROUPS, EACH, STEPS = 4, 5, 30
TRUTH = {"a": 0.5, "b": -0.3}


def test_shapley_s_shares_by_hand():
    worth = {(): 0.0, (0,): 0.5, (1,): 0.1, (0, 1): 0.8}
    shares = statistics.shapley(2, lambda some: worth[tuple(sorted(some))])
    # (0.5 + 0.8 - 0.1) / 2 and (0.1 + 0.8 - 0.5) / 2
    np.testing.assert_allclose(shares, [0.6, 0.2])


def toy() -> SimpleNamespace:
    """Windows whose residuals are linear in two effects, noise 1; nothing known to refit."""
    rng = np.random.default_rng(0)
    group = np.repeat(np.arange(GROUPS), EACH)
    columns = {n: 2.0 * rng.normal(size=(len(group), STEPS)) for n in TRUTH}
    noise = rng.normal(size=(len(group), STEPS))
    r = noise + sum(TRUTH[n] * c for n, c in columns.items())
    coordinates = {n: Coordinate(n, (i,), 0.0, -1.0, 1.0) for i, n in enumerate(TRUTH)}

    def run(thetas, offsets):
        return np.stack([r - sum(t[i] * c for i, c in enumerate(columns.values())) for t in thetas])

    fitter = SimpleNamespace(
        base=(), whiten=lambda errors: errors,
        simulator=SimpleNamespace(run=run, windows=SimpleNamespace(group=group)),
        vector=lambda coordinates, values: np.array([
            dict(zip([c.name for c in coordinates], values, strict=True)).get(n, 0.0) for n in TRUTH
        ]),
    )  # fmt: skip
    start = np.zeros((len(group), 1))
    B = np.zeros((len(group), STEPS, 1))
    fit = Fit((), np.zeros(0), start, r, np.zeros((*r.shape, 0)), B, np.ones(len(group)), 0.0, spread=np.ones(1))
    effects = [Candidate(n, "joint", "joint", (c,), (False,)) for n, c in coordinates.items()]
    screened = [SimpleNamespace(candidate=e, start=np.array([0.7 * TRUTH[e.effect]])) for e in effects]
    base = SimpleNamespace(fit=fit)
    return SimpleNamespace(fitter=fitter, base=base, screened=screened, noise=float(STEPS), effects=effects, left=noise)


def test_on_a_linear_problem_the_promise_is_kept():
    found = toy()
    before, after = (float(np.mean(x**2)) for x in (found.base.fit.r, found.left))
    total, each = selecting.promised(found, found.effects)
    assert total == pytest.approx((before - after) / (before - 1.0), abs=0.02)
    assert sum(each.values()) == pytest.approx(total, abs=1e-9)
    # columns of the same size, nearly orthogonal: shares as the squared amounts, 25 : 9
    assert each["a@joint"] / each["b@joint"] == pytest.approx(25 / 9, rel=0.25)


def test_a_secant_is_not_followed_beyond_the_range():
    effect = Candidate("a", "joint", "joint", (Coordinate("a", (0,), 0.0, -1.0, 1.0),), (False,))
    assert Column(effect, np.array([0.8]), np.zeros(1)).room == pytest.approx((-1.25, 1.25))
    assert Column(effect, np.array([-0.1]), np.zeros(1)).room == pytest.approx((-10.0, 10.0))
