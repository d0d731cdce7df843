"""The emulator on a linear simulator with known noise: what it leaves of a measurement is known in distribution."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2, kstest

from bayessim_mjx.inference import emulator

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole diagnoses and fits

NOISE, FEATURES = 0.1, 8
SLOPE = np.random.default_rng(0).normal(size=(2, FEATURES))


def simulate(seed, n, low=0.0, high=1.0):
    """u [n, 2] and y [n, 8] = (u - 1/2) SLOPE + noise."""
    rng = np.random.default_rng(seed)
    u = rng.uniform(low, high, (n, 2))
    y = (u - 0.5) @ SLOPE + NOISE * rng.normal(size=(n, FEATURES))
    return jnp.asarray(u, jnp.float32), jnp.asarray(y, jnp.float32)


@pytest.fixture(scope="module")
def layers():
    return emulator.trained(*simulate(1, 3000), jnp.ones(3000))


def test_what_is_left_at_the_best_theta_has_the_chi_square_of_the_noise(layers):
    _, y = simulate(2, 400, 0.3, 0.7)  # the box's walls are several standard deviations away
    best, left = emulator.explained(layers, jnp.eye(FEATURES) / NOISE, simulate(1, 500)[0], jnp.full((400, 2), 0.5), y)
    exact = 0.5 + np.linalg.lstsq(SLOPE.T, np.asarray(y).T, rcond=None)[0].T
    np.testing.assert_allclose(best, exact, atol=0.02)
    square = np.sum(np.asarray(left) ** 2, axis=1)
    assert square.mean() == pytest.approx(FEATURES - 2, abs=0.6)  # each parameter takes one degree of freedom
    assert kstest(square, chi2(FEATURES - 2).cdf).pvalue > 1e-3


def test_a_guess_beside_the_point_does_no_harm(layers):
    u, y = simulate(3, 50, 0.3, 0.7)
    unit, library = jnp.eye(FEATURES) / NOISE, simulate(1, 500)[0]
    near = emulator.explained(layers, unit, library, u, y)[0]
    far = emulator.explained(layers, unit, library, jnp.where(u > 0.5, 0.0, 1.0), y)[0]
    np.testing.assert_allclose(far, near, atol=2e-3)


def test_rows_that_do_not_count_are_not_seen(layers):
    u, y = simulate(1, 3000)
    used = jnp.arange(3000) < 2000
    clean, spoilt = (
        emulator.trained(u, jnp.where(used[:, None], y, fill), used.astype(jnp.float32)) for fill in (0.0, 1e6)
    )
    for a, b in zip(clean, spoilt, strict=True):
        np.testing.assert_array_equal(a[0], b[0])
