"""What simulators differ by, deviates and shares over conditions: they cover the truth as often as they say."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fitter import Fit
from bayessim_mjx.diagnosis.selection import heldout, models


def test_simulators_differ_by_a_part_of_a_period_and_a_percent():
    """Times are uncertain by the period, other numbers by their size; known parameters where that is asked for."""
    known = Coordinate("arm_mass_mult", (0,), 1.0, 0.8, 1.2)
    delay = Coordinate("motor.actuator_delay.delay", (1,), 0.0, 0.0, 0.1, unit="s")
    gain = Coordinate("motor.actuator_gain.gain", (2,), 1.0, 0.2, 2.0)
    fit = SimpleNamespace(coordinates=(known, delay, gain), values=np.array([1.1, 0.02, 0.7]))
    model = SimpleNamespace(effects=(SimpleNamespace(coordinates=(delay, gain)),), fit=fit)
    np.testing.assert_allclose(models.systematic(model, 0.01), [0.0, 0.03 * 0.01, 0.01 * 0.3])
    np.testing.assert_allclose(models.systematic(model, 0.01, known=True), [0.01 * 1.1, 0.03 * 0.01, 0.01 * 0.3])


def alike_within(rng: np.random.Generator, conditions: int, windows: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """(values of windows that differ by condition much more than within one, their conditions)."""
    group = np.repeat(np.arange(conditions), windows)
    return rng.normal(size=conditions)[group] + 0.1 * rng.normal(size=len(group)), group


@pytest.mark.parametrize("conditions", [2, 3, 4, 8])
def test_a_mean_that_is_zero_exceeds_two_deviations_as_often_at_every_number_of_conditions(conditions):
    rng = np.random.default_rng(conditions)
    hits = [statistics.normal_deviate(*alike_within(rng, conditions)) > 2.0 for _ in range(1500)]
    assert 0.01 < np.mean(hits) < 0.04  # 2.3 % by the normal law, standard error .4; as independent windows 30 %


def test_the_deviate_of_two_conditions_by_hand():
    """Means 3 and 5: t = 4 / 1 with one degree of freedom, P(T > 4) = 1/2 - atan(4) / pi = .0780."""
    found = statistics.normal_deviate(np.array([3.0, 3.0, 5.0, 5.0]), np.array([0, 0, 1, 1]))
    assert stats.norm.sf(found) == pytest.approx(0.5 - np.arctan(4.0) / np.pi, rel=1e-6)
    assert statistics.normal_deviate(-np.array([3.0, 3.0, 5.0, 5.0]), np.array([0, 0, 1, 1])) == pytest.approx(-found)


def test_one_condition_says_nothing_of_others():
    cost, group = np.array([4.0, 5.0, 6.0]), np.zeros(3, int)
    assert statistics.normal_deviate(cost, group) == 0.0
    ends = [statistics.interval_of_rms(cost, group), heldout.Closed(cost, cost / 2, group).interval()]
    ends += statistics.interval_of_shares(np.ones((3, 2)), group)
    assert np.isnan(ends).all()


def test_conditions_that_count():
    assert statistics.freedom(np.ones((5, 1))) == pytest.approx(4.0)
    assert statistics.freedom(np.array([[1.0], [1.0], [2.0]])) == pytest.approx(16 / 6 - 1)
    assert statistics.freedom(np.array([[1e9], [1.0]]), 0.5) == pytest.approx(0.5)


def squares(rng: np.random.Generator, conditions: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Windows before and after, heavy-tailed between conditions: a share of .25 is left on average."""
    group = np.repeat(np.arange(conditions), 5)
    size, left = 30 * rng.gamma(0.8, size=conditions), rng.beta(2, 6, conditions)
    each = rng.gamma(1.5, size=len(group)) / 1.5 * size[group]
    noise = rng.chisquare(25, size=(2, len(group))) / 25
    return noise[0] + each, noise[1] + left[group] * each, group


@pytest.mark.parametrize("conditions", [2, 3, 5, 8])
def test_intervals_of_the_share_closed_cover_it(conditions):
    """Nominal 90 %; a bootstrap of windows covers half. The figures: benchmarks/diagnosis/intervals.py."""
    rng = np.random.default_rng(conditions)
    found = [heldout.Closed(*squares(rng, conditions)).interval() for _ in range(400)]
    assert 0.86 < np.mean([low <= 0.75 <= high for low, high in found]) < 0.98


def test_parts_of_what_is_closed_add_up_and_stay_below_one():
    before, after, group = squares(np.random.default_rng(0), 6)
    whole = heldout.Closed(before, after, group)
    assert whole.value == pytest.approx((before - after).sum() / (before - 1).sum())
    own = np.stack([0.7 * (before - after), 0.3 * (before - after)])
    parts = [heldout.Closed(before, after, group, own=o, every=own.sum(0)) for o in own]
    assert [p.value for p in parts] == pytest.approx([0.7 * whole.value, 0.3 * whole.value])
    for part in (whole, *parts):
        low, high = part.interval()
        assert low < part.value < high <= 1.0
    lucky = np.full_like(before, 0.9)  # below the noise: all is closed, and no more
    assert sum(heldout.Closed(before, lucky, group, own=o, every=own.sum(0)).value for o in own) == pytest.approx(1.0)
    at_noise = heldout.Closed(before, np.full_like(before, 0.9), group)
    assert at_noise.value == 1.0 and at_noise.interval()[1] == 1.0


@pytest.mark.parametrize("left", [0.77, 0.9, 1.0, 1.3, 4.0])
@pytest.mark.parametrize("gap", [5.0, 300.0, 1e6])
def test_no_interval_of_a_share_has_zero_width(left, gap):
    """Six conditions that hardly differ; a left-over below 1 says by how much the noise was taken for too large."""
    rng, group = np.random.default_rng(0), np.repeat(np.arange(6), 5)
    before, after = (size * (1 + 1e-3 * rng.normal(size=30)) for size in (gap, left))
    part = 0.7 + 1e-3 * rng.normal(size=30)
    every = [heldout.Closed(before, after, group), heldout.Closed(before, after, group, own=part, every=np.ones(30))]
    for closed in every:
        low, high = closed.interval()
        assert low < high <= 1.0 and low <= closed.value <= high
    low, _ = every[0].interval()
    if left < 1.0:  # the floor may be off by about as much as is left below it
        assert 1.0 - low >= 0.5 * (1.0 - left) / gap


@pytest.mark.parametrize("noise", [(1.0,), (0.6, 1.1)])
@pytest.mark.parametrize("spread", [0.1, 30.0])
def test_the_noise_floor_is_what_noise_leaves_after_start_states_were_fitted_to_it(spread, noise):
    """By simulation: white noise on 12 numbers of a window, and a start state of two numbers."""
    rng = np.random.default_rng(1)
    B = np.repeat(rng.normal(size=(1, 12, 2)), 4000, 0)
    r = rng.normal(size=(4000, 12)) * np.tile(noise, 12 // len(noise))
    x, A, every = np.zeros((4000, 2)), np.zeros((4000, 12, 0)), np.ones(4000)
    fit = Fit((), np.zeros(0), x, r, A, B, every, 0.0, spread=np.full(2, spread))
    _, starts = fit.quadratic()
    left = r - np.einsum("wns,ws->wn", B, starts.step(fit.A, np.zeros(0)))
    floor = heldout.noise_floor(fit, np.array(noise))
    assert floor == pytest.approx(np.mean(left**2), abs=0.02)
    if noise == (1.0,):
        assert floor[0] == pytest.approx(10 / 12, abs=1e-3) if spread > 1 else floor[0] > 0.87
