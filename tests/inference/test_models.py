"""Networks on Fourier features on a problem whose posterior is known; densities by quadrature."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import InferenceSettings, fit, infer, init, mdn
from bayessim_mjx.parameters import Parameter, ParameterSpace

FLAT = ParameterSpace([Parameter("a", 0.0, -1.0, 1.0), Parameter("b", 0.0, -1.0, 1.0)])
NOISE = 0.3
SMALL = InferenceSettings(
    components=2, hiddenLayers=(16,), min_steps=300, max_steps=300, fourierFeatures=32, ensemble=1
)


def key(seed: int = 0) -> jax.Array:
    return jax.random.PRNGKey(seed)


def pairs(space: ParameterSpace, n: int = 2000) -> tuple[jax.Array, jax.Array]:
    """x = theta + N(0, 0.3^2)."""
    thetas = Distribution.prior(space).sample(key(1), n)
    return thetas, thetas + NOISE * jax.random.normal(key(2), thetas.shape)


def trained(space: ParameterSpace, **options):
    settings = dataclasses.replace(SMALL, **options)
    return fit(key(3), init(key(4), settings, space, 2), *pairs(space))


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"modelClass": "MDRFF"},
        {"modelClass": "MDRFF_Matern32_median", "fullCovariance": False},
    ],
    ids=lambda o: " ".join(map(str, o.values())),
)
def test_every_model_learns_the_posterior_in_its_box(options):
    """Exact: N(x, 0.3^2) cut off at the walls, each parameter by itself."""
    state, info = trained(FLAT, **options)
    x = jnp.asarray([[0.2, 0.9]])
    q = infer(state, x)
    axis = -1 + 2 * (np.arange(200) + 0.5) / 200
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2).astype(np.float32)
    got = np.exp(np.asarray(q.log_prob(points), np.float64)) * (2 / 200) ** 2
    exact = np.exp(-0.5 * np.sum((points - np.asarray(x)) ** 2, axis=1) / NOISE**2)
    exact /= exact.sum()
    assert got.sum() == pytest.approx(1.0, abs=1e-2)
    assert 0.5 * np.abs(got - exact).sum() < 0.2  # the prior: 0.8; near a wall and with so few rows the best are at 0.1
    assert q.components == state.settings.components * state.settings.ensemble
    assert float(info.parameter_gain.min()) > 0.3 and bool(info.identified.all())


def test_the_slope_of_a_gaussian_is_the_closed_one():
    """d/dv = -C^-1 v, d/dC = (a a^T - C^-1) / 2 with a = C^-1 v; precisions of 1 to 1e6."""
    rng = np.random.default_rng(0)
    v, root = rng.normal(size=(6, 4)), rng.normal(size=(6, 4, 4)) * np.asarray([1, 1, 10, 1000])[:, None]
    cov = root @ np.swapaxes(root, 1, 2) + np.eye(4)
    a, inverse = np.linalg.solve(cov, v[..., None])[..., 0], np.linalg.inv(cov)
    found = jax.grad(lambda v, c: jnp.sum(mdn.log_gaussian(v, c)), (0, 1))(
        jnp.asarray(v, jnp.float32), jnp.asarray(cov, jnp.float32)
    )
    np.testing.assert_allclose(found[0], -a, atol=1e-3)
    np.testing.assert_allclose(found[1], 0.5 * (a[:, :, None] * a[:, None, :] - inverse), atol=1e-3)
