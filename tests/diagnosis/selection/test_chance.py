"""What the best of many candidates gains by chance: where the answer is known, and where the noise has a colour."""

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter

from bayessim_mjx.diagnosis.selection import chance
from bayessim_mjx.diagnosis.selection.criteria import Criteria
from bayessim_mjx.diagnosis.selection.decide import decide, order
from tests.diagnosis.selection.planted import law, table

WINDOWS, ROWS, CANDIDATES = 120, 40, 30


def columns(r, laws, samples=ROWS, group=None):
    """Candidates without limits on residuals whose noise is 1."""
    k, free = laws.shape[2], np.inf
    group = np.arange(len(r)) if group is None else group
    return chance.Columns(
        laws,
        np.full(k, -free),
        np.full(k, free),
        np.zeros((*r.shape, 1)),
        np.ones(1),
        r,
        np.ones_like(r),
        np.ones(len(r)),
        group,
        samples,
        ROWS,
    )


def planted(rng, memory=0.0, size=1.0, smooth=False, windows=WINDOWS):
    """(residuals with an autocorrelation, candidates)."""
    white = rng.normal(size=(windows, ROWS + 50))
    r = lfilter([np.sqrt(1 - memory**2)], [1, -memory], white, axis=1)[:, 50:] * size
    laws = rng.normal(size=(windows, ROWS, CANDIDATES))
    laws = np.cumsum(laws, 1) if smooth else laws
    return r, laws - laws.mean(1, keepdims=True)


def test_white_noise_gains_what_the_best_of_so_many_chi_squares_does():
    """Leaving one out costs 2 as Akaike's criterion does (Stone, 1977): nats are (max chi2_1 - 2) / 2."""
    rng = np.random.default_rng(0)
    found = chance.best_gains(columns(*planted(rng)), rng, 300)
    for level, near in ((0.5, 0.25), (0.95, 1.0)):
        analytic = (stats.chi2.ppf(level ** (1 / CANDIDATES), 1) - 2) / 2
        assert np.quantile(found, level) == pytest.approx(analytic, abs=near)


@pytest.mark.parametrize("memory", [0.0, 0.9])
def test_the_family_wise_error_is_what_was_asked_for_whatever_the_colour_and_size_of_the_noise(memory):
    """Fresh null residuals, each with a bootstrap of its own: the best of all candidates passes 10 % in about 10 %."""
    rng, alarms = np.random.default_rng(1), []
    for _ in range(100):
        r, laws = planted(rng, memory, size=rng.uniform(1, 5), smooth=True, windows=48)
        null = columns(r, laws, samples=ROWS / (1 + 2 * memory / (1 - memory)))
        seen = chance.gains(null, r[None]).max()
        alarms.append(chance.probability(chance.best_gains(null, rng, 40), seen) < 0.1)
    assert 0.02 < np.mean(alarms) < 0.2


def test_a_planted_effect_is_beyond_chance_and_one_in_few_windows_too():
    rng = np.random.default_rng(2)
    r, laws = planted(rng, 0.9, smooth=True)
    few = np.zeros((WINDOWS, 1))
    few[[3, 40, 41, 90]] = 1.0  # a limit that is reached in four windows
    laws[:, :, 1] *= few
    for law_, amount in ((0, 0.3), (1, 2.0)):
        gap = r + amount * laws[:, :, law_]
        null = columns(gap, laws)
        seen = chance.gains(null, gap[None])[0]
        assert seen.argmax() == law_ and chance.probability(chance.best_gains(null, rng, 100), seen.max()) < 0.02


def test_noise_keeps_size_and_covariance():
    rng = np.random.default_rng(3)
    r, laws = planted(rng, 0.9)
    r[:60] *= 2.0
    drawn = chance.noise(columns(r, laws), rng, 40)
    sizes = np.sqrt(np.mean(drawn**2, axis=(0, 2)))
    np.testing.assert_allclose(sizes / np.sqrt(np.mean(r**2, 1)), 1.0, atol=0.25)
    lagged = lambda x: np.mean(x[..., 1:] * x[..., :-1]) / np.mean(x**2)  # noqa: E731
    assert lagged(drawn) == pytest.approx(lagged(r), abs=0.03)


def test_noise_that_grows_with_speed_is_told_from_noise_that_does_not():
    rng = np.random.default_rng(4)
    rate = rng.normal(size=(WINDOWS, ROWS))
    for jitter in (0.0, 2.0):
        sd = np.sqrt(1 + (jitter * rate) ** 2)
        found = chance.profile(sd * rng.normal(size=rate.shape), np.ones_like(rate), rate**2)
        np.testing.assert_allclose(found, sd, rtol=0.1)


def test_what_chance_gains_as_often_is_not_named():
    a = law("a")
    known = table({(): 4.0, (a,): 2.0}, samples=80)  # 41 nats
    for best, named in ((5.0, {a.label}), (60.0, set())):
        null = type(known)(known.rows, known.laws, known.group, known.noise, 1.0, np.full(100, best))
        assert set(decide(null, order(null.laws), Criteria()).answer) == named
