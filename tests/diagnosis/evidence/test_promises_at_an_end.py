"""What an effect promises while a known parameter that does its work rests at an end of its range: exact numbers."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from bayessim_mjx.diagnosis.evidence import promises
from bayessim_mjx.diagnosis.evidence.gaussian import Hyper
from bayessim_mjx.diagnosis.evidence.parameters import belief_of
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fitter import Fit

ROWS = 400


def problem(true: float, effect: float, low: float) -> SimpleNamespace:
    """Residual of noise 1 about a fit at 1: one known parameter from `low` on, two columns that are alike to it."""
    rng = np.random.default_rng(0)
    a, b, c = rng.normal(size=(3, ROWS))
    one, two = 0.9 * a + 0.4 * b, 0.2 * a + c
    r = a * (true - 1.0) + effect * one + rng.normal(size=ROWS)
    known = Coordinate("m", (0,), 1.0, low, 3.0, precision=1.0)
    fit = Fit(
        (known,), np.ones(1), np.zeros((1, 1)), r[None], a[None, :, None], np.zeros((1, ROWS, 1)), np.ones(1), 0.0
    )
    columns = [SimpleNamespace(change=x[None], precision=1e-2, room=(-50.0, 50.0)) for x in (one, two)]
    whole = np.column_stack([r, a, one, two])
    weighing = SimpleNamespace(products=lambda fit, hyper, more, own: (whole.T @ whole, 0.0))
    return SimpleNamespace(weighing=weighing, fit=fit, columns=columns, Q=whole.T @ whole)


def best(of: SimpleNamespace, own: tuple[int, ...]) -> float:
    """Log density that columns add at the best step within bounds, without the determinants."""
    belief, i = belief_of(of.fit), [1, *(2 + j for j in own)]
    precision = np.array([*belief.precision, *(1e-2 for _ in own)])
    mean = np.array([*belief.mean, *(0.0 for _ in own)])

    H, g = of.Q[np.ix_(i, i)] + np.diag(precision), of.Q[0, i] + precision * mean
    root = np.linalg.cholesky(H)
    ends = [np.array([end, *(sign * 50.0 for _ in own)]) for end, sign in ((belief.low[0], -1), (belief.high[0], 1))]
    x = lsq_linear(root.T, np.linalg.solve(root, g), ends, method="bvls", tol=1e-14).x
    alone = np.zeros(len(i))
    alone[0] = belief.best(of.Q[:2, :2])[0]
    return float(g @ (x - alone) - 0.5 * (x @ H @ x - alone @ H @ alone))


@pytest.mark.parametrize(
    ("true", "effect", "low"), [(1.2, -1.0, 0.5), (1.0, -0.3, 0.5), (0.2, 0.0, 0.5), (1.2, 0.5, 0.5)]
)
@pytest.mark.parametrize("own", [(0,), (1,), (0, 1)])
def test_the_best_step_within_bounds_is_promised(true, effect, low, own):
    of = problem(true, effect, low)
    hyper = Hyper(np.full(1, promises.PRIORS.usual), 1.0, np.ones(1))
    levels = promises._levels(of.weighing, of.fit, np.arange(1), hyper, of.columns)
    precision = np.full(len(own), 1e-2)
    exact = []
    for level in levels:
        H = level.S[np.ix_(own, own)] + np.diag(precision)
        prices = 0.5 * np.linalg.slogdet(H)[1] - 0.5 * np.sum(np.log(precision))
        exact.append(level.of(own).nats + prices)
    assert max(exact) == pytest.approx(best(of, own), rel=1e-6)
    found = max(level.of(own).nats for level in levels)
    table = [level.singles()[own[0]] if len(own) == 1 else level.pairs()[own] for level in levels]
    assert max(table) == pytest.approx(found, rel=1e-6)


def test_an_effect_that_a_bound_hides_promises_nothing_while_it_is_held():
    of = problem(1.2, -1.0, 0.5)
    hyper = Hyper(np.full(1, promises.PRIORS.usual), 1.0, np.ones(1))
    held, free = promises._levels(of.weighing, of.fit, np.arange(1), hyper, of.columns)
    assert free.of((0,)).nats > held.of((0,)).nats + 10
