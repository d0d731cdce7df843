"""Products of several factors, judged on sets: what is exact stays as it is, what shares an error is widened."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import product_calibration
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter(name, 0.0, -1.0, 1.0) for name in "ab"])
SD, COUNT, MANY = 0.1, 8, 48


def made(bias: float, seed: int = 0):
    """Sets of Gaussian posteriors of measurements with noise SD; all of a set are off by the same `bias` SD."""
    rng = np.random.default_rng(seed)
    thetas = rng.uniform(-0.5, 0.5, (MANY, 2))
    off = bias * SD * rng.normal(size=(MANY, 1, 2))
    means = thetas[:, None] + off + SD * rng.normal(size=(MANY, COUNT, 2))
    scale = np.eye(2)[None] * SD / 2  # in unit coordinates
    rows = [[Distribution.from_unit(SPACE, np.zeros(1), (m[None] + 1) / 2, scale) for m in each] for each in means]
    return rows, thetas


def test_counts():
    assert (
        product_calibration.counts_to(1) == [1]
        and product_calibration.counts_to(8) == [1, 2, 4, 8]
        and product_calibration.counts_to(11) == [1, 2, 4, 8, 11]
    )


@pytest.fixture(scope="module")
def exact():
    return product_calibration.judge(*made(0.0), components=1)


def test_exact_products_are_left_as_they_are(exact):
    assert [c.trajectories for c in exact.counts] == [1, 2, 4, 8] and exact.saturates_at == 8
    for c in exact.counts:
        assert c.widening < 1.3
        # two numbers known to SD / sqrt(n) of a range of 2: log(4) - log(2 pi SD^2 / n) - 1
        expected = np.log(4) - np.log(2 * np.pi * SD**2 / c.trajectories) - 1
        assert c.gain == pytest.approx(expected, abs=0.35)
        for level in (0.5, 0.8):
            assert c.coverage(level) == pytest.approx(level, abs=0.2)


def test_a_shared_error_is_found_and_widened(exact):
    found = product_calibration.judge(*made(0.5, 1), components=1)
    last = found.at(8)
    # of n = 8 the error is sqrt(1/8 + .25) SD, the claim SD / sqrt(8)
    assert last.widening == pytest.approx(np.sqrt(1 + 8 * 0.25), rel=0.2)
    assert last.plain < last.gain < exact.at(8).gain
    for level in (0.5, 0.8):
        assert last.coverage(level) == pytest.approx(level, abs=0.2)
    assert found.at(5).trajectories == 4 and "widened" in found.sentence()


@pytest.mark.slow
@pytest.mark.ci
def test_products_as_they_are_used_are_judged_with_the_widening_that_they_have(exact):
    """Errors shared by a set: as sure as they claim to be, and widened by what they ask for."""
    shared = made(0.5, 2)
    as_they_are = product_calibration.judge(*shared, components=1, widened_by=lambda n: 1.0)
    last = as_they_are.at(8)
    assert last.widening == 1.0 and last.gain == pytest.approx(last.plain)
    # a product of 8 claims a third of the variance: half of the 50 % regions' truths lie outside of them
    assert [level for level, *_ in as_they_are.off] == [0.5, 0.8, 0.95] and last.coverage(0.5) < 0.35
    wider = product_calibration.judge(*shared, components=1, widened_by=lambda n: np.sqrt(1 + n * 0.25))
    assert not wider.off and wider.at(8).gain > last.gain and wider.at(8).coverage(0.8) == pytest.approx(0.8, abs=0.2)
    assert exact.saturation.startswith("each of the 8 trajectories sharpened")
    told = as_they_are.to_dict()
    assert told["carried"] == as_they_are.saturates_at and told["counts"][-1]["coverage"]["0.5"] == last.coverage(0.5)


def test_a_truth_outside_of_a_product_does_not_spoil_the_mean():
    rows, thetas = made(0.0)
    found = product_calibration.judge(rows, np.asarray(thetas) * 0 + 0.99, components=1)
    assert np.isfinite([c.gain for c in found.counts]).all() and jnp.isfinite(found.at(1).widening)


@pytest.mark.parametrize("bias", [0.2, 0.5])
def test_beyond_the_sets_that_were_judged_the_shared_error_stays(bias):
    """b^2 of what all trajectories share and s^2 / n of what they do not: the claim s / sqrt(n) is w^2 = 1 + n b^2 off.

    Judged on sets of 8, used for 100 trajectories. The widening of 8 would claim 3.5 times too little at b = .5.
    """
    found = product_calibration.judge(*made(bias, 2), components=1)
    right = np.sqrt(1 + 100 * bias**2)
    assert 0.8 * right < found.widening(100) < 1.35 * right
    at = replace(found, known=100)
    assert f"widened {at.widening(100):.2f} times" in at.sentence() and "simulated sets of 8" in at.sentence()
    assert at.to_dict()["widening"] == at.widening(100) and at.to_dict()["known"] == 100


def test_what_sets_cannot_tell_from_no_error_is_reckoned_with_beyond_them():
    """A widening of 1 may hide one below the next factor that is tried, and that grows with the trajectories."""
    one = product_calibration.Count(32, 1.0, 5.0, 0.1, 5.0, np.linspace(0, 1, 64))
    found = product_calibration.Sets((one,))
    step = product_calibration.FACTORS[1]
    assert found.widening(32) == 1.0
    assert found.widening(3200) == pytest.approx(np.sqrt(1 + (step**2 - 1) * 100))
    widths = [found.widening(n) / np.sqrt(n) for n in (40, 100, 400, 10_000)]
    assert widths == sorted(widths, reverse=True) and widths[-1] > 0.9 * np.sqrt(
        (step**2 - 1) / 32
    )  # it stops narrowing
