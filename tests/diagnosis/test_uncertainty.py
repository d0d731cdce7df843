"""Intervals of parameters on a linear problem whose answer is known: they cover it as often as they say."""

from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis import uncertainty
from bayessim_mjx.diagnosis.candidates import Coordinate
from bayessim_mjx.diagnosis.fit import Fitter, Job
from bayessim_mjx.diagnosis.models import Model, scored
from bayessim_mjx.diagnosis.quadratic import solve

TRUTH = np.array([0.1, 0.3])
NAMES = ("known", "effect")
STEPS, EACH = 12, 4  # residuals of a window, windows of a condition


def problem(
    conditions: int, rng: np.random.Generator, differs: float, uneven: float = 0.0, alike: float = 0.0
) -> tuple[Fitter, Model]:
    """Residuals of a known parameter and an effect whose values differ by `differs` from condition to condition.

    Args:
        uneven: how differently strong the conditions excite them; alike: how similarly the two act.
    """
    group = np.repeat(np.arange(conditions), EACH)
    strength = np.exp(uneven * rng.normal(size=conditions))[group]
    A = 0.2 * rng.normal(size=(len(group), STEPS, 2)) * strength[:, None, None]
    A[..., 1] = alike * A[..., 0] + (1 - alike) * A[..., 1]
    B = rng.normal(size=(len(group), STEPS, 1))
    own = TRUTH + differs * rng.normal(size=(conditions, 2))
    start = 0.5 * rng.normal(size=(len(group), 1))
    r = np.einsum("wnk,wk->wn", A, own[group]) + np.einsum("wns,ws->wn", B, start)
    r += rng.normal(size=r.shape)
    coordinates = tuple(Coordinate(n, (i,), 0.0, -2.0, 2.0, 1 / 16) for i, n in enumerate(NAMES))
    fitter = SimpleNamespace(
        spread=np.array([0.5]), used=np.ones(1, bool), base=coordinates[:1],
        simulator=SimpleNamespace(windows=SimpleNamespace(group=group)),
    )  # fmt: skip
    fitter.scores = lambda job, group=None: Fitter.scores(fitter, job, group)
    job = Job(coordinates, np.zeros(2), np.zeros((len(group), 1)), r, A, B, np.ones(len(group)), 0.0)
    q, starts = job.quadratic(fitter.spread)
    g, S = q.weighted(job.weight)
    precision, pull, low, high = job.prior()
    job.values = solve(S + np.diag(precision), g + pull, low, high)
    job.offsets = starts.step(A, job.values)
    job.r = r - A @ job.values - np.einsum("wns,ws->wn", B, job.offsets)
    return fitter, scored(fitter, job, ())


@pytest.mark.parametrize("conditions", [3, 5])
@pytest.mark.parametrize(("differs", "uneven"), [(0.0, 0.0), (1.0, 0.0), (0.3, 0.5)])
def test_90_percent_intervals_cover_85_to_95_percent(conditions, differs, uneven):
    rng = np.random.default_rng(conditions)
    covered = []
    for _ in range(300):
        fitter, model = problem(conditions, rng, differs, uneven)
        sd = np.sqrt(np.diag(uncertainty.covariance(fitter, model)))
        covered.append(np.abs(model.job.values - TRUTH) < 1.645 * sd)
    rate = np.mean(covered)
    assert 0.85 <= rate <= 0.96


def test_what_acts_alike_is_known_together_better_than_each():
    fitter, model = problem(5, np.random.default_rng(0), 0.0, alike=0.9)
    found = uncertainty.covariance(fitter, model)
    sd = np.sqrt(np.diag(found))
    assert found[0, 1] / sd[0] / sd[1] < -0.9  # what one takes the other gives
    together = np.array([1.0, 0.9])  # the direction that the residuals see
    assert together @ found @ together < 0.1 * (sd @ sd)
    assert np.linalg.eigvalsh(found).min() > 0


def test_simulators_differ_by_a_part_of_a_step_and_a_percent():
    """Known parameters keep their interval; times are uncertain by the step, other numbers by their size."""
    known = Coordinate("arm_mass_mult", (0,), 1.0, 0.8, 1.2)
    delay = Coordinate("motor.actuator_delay.delay", (1,), 0.0, 0.0, 0.1, unit="s")
    gain = Coordinate("motor.actuator_gain.gain", (2,), 1.0, 0.2, 2.0)
    job = SimpleNamespace(coordinates=(known, delay, gain), values=np.array([1.1, 0.02, 0.7]))
    model = SimpleNamespace(effects=(SimpleNamespace(coordinates=(delay, gain)),), job=job)
    np.testing.assert_allclose(uncertainty.systematic(model, 0.01), [0.0, 0.07 * 0.01, 0.01 * 0.3])
    np.testing.assert_allclose(uncertainty.systematic(model, 0.01, 0.04), [0.0, 0.07 * 0.01, (0.01 + 0.15 * 0.2) * 0.3])
