"""Small parts of the inference whose answers are closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import importance, local_recalibration, product_calibration
from bayessim_mjx.inference.final_importance_sampling import generalised_pareto
from bayessim_mjx.inference.mixture_fit import Mixture
from bayessim_mjx.inference.temperature import tempered
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter(name, 0.0, -1.0, 1.0) for name in "ab"])
SD = 0.02  # in unit coordinates


def at(middle: float = 0.5) -> Distribution:
    return Distribution.from_unit(SPACE, np.zeros(1), np.full((1, 2), middle), SD * np.eye(2)[None])


def test_a_set_is_judged_with_the_widening_that_the_other_half_asks_for() -> None:
    """Truths of even sets lie 4 sd off, those of odd sets in the middle: these ask for no widening, those for 2.8."""
    count = 40
    thetas = np.zeros((count, 2))
    thetas[::2, 0] = 4 * SD * 2  # theta is twice as wide as the unit cube
    found = product_calibration.counted(1, product_calibration.stacked([at()] * count), thetas)
    # even sets with the factor 1 of the odd ones: 1 - exp(-4^2 / 2) of a Gaussian in two dimensions
    np.testing.assert_allclose(found.levels[::2], 1 - np.exp(-8.0), atol=2e-3)
    assert found.levels[1::2].max() < 0.01
    assert (
        found.gain < np.log(1 / (2 * np.pi * SD**2)) - 3.5
    )  # half of the sets are 8 nats worse, less the widened half


def test_one_factor_on_standard_deviations() -> None:
    np.testing.assert_allclose(tempered(at(), 3.0).scales[0], 3 * SD * np.eye(2), rtol=1e-5)


def test_a_mean_error_is_drawn_to_zero_by_what_chance_adds() -> None:
    """16 errors of mean 1 and variance 1: the mean's square is 1/16 more than the truth's on average."""
    off = np.tile([-1.0, 1.0], 8)[:, None]
    off = 1.0 + off / off.std(ddof=1)
    move, cov = local_recalibration.mean_error(off)
    np.testing.assert_allclose(move, [1 - 1 / 16], rtol=1e-9)
    np.testing.assert_allclose(cov, [[1.0]], rtol=1e-9)


def test_the_shape_of_a_short_tail_is_drawn_to_a_half_by_ten_draws_worth() -> None:
    """PSIS: (n k + 10 / 2) / (n + 10). Of ten exponential exceedances (k = 0) that is a quarter on average, not 0."""
    rng = np.random.default_rng(0)
    shapes = [generalised_pareto(np.sort(rng.exponential(size=10)))[0] for _ in range(800)]
    assert np.mean(shapes) == pytest.approx(0.25, abs=0.08)
    long = [generalised_pareto(np.sort(rng.exponential(size=4000)))[0] for _ in range(10)]
    assert np.mean(long) == pytest.approx(0.0, abs=0.03)


def test_draws_are_from_the_density_that_weighs_them() -> None:
    """The last part of a mixture, the prior, is Gaussian; the others have five degrees of freedom."""
    rng = np.random.default_rng(0)
    for weights, law in (([1e-12, 1.0], stats.norm()), ([1.0, 1e-12], stats.t(importance.FREEDOM))):
        q = Mixture(np.array(weights), np.zeros((2, 1)), np.ones((2, 1, 1)))
        z = importance._draw(rng, q, 20_000)
        assert stats.kstest(z[:, 0], law.cdf).pvalue > 0.01
        np.testing.assert_allclose(importance._heavy(q, z[:50]), law.logpdf(z[:50, 0]), atol=1e-6)


def test_a_density_at_its_middle() -> None:
    """log of 1 over 2 pi sd^2, over the prior's 1 in the unit square."""
    assert float(at().log_gain(jnp.zeros(2))) == pytest.approx(-np.log(2 * np.pi * SD**2), abs=1e-3)
