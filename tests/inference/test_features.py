"""Fourier features against the analytic kernels; the names of the models."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.special import gamma, kv

from bayessim_mjx.inference import InferenceSettings
from bayessim_mjx.inference.densities import mdrff

KERNELS = ["RBF", "Matern12", "Matern32", "Matern52"]


@pytest.mark.parametrize("sequence", ["sobol", "halton"])
@pytest.mark.parametrize("kernel", KERNELS)
def test_inner_products_of_features_are_the_kernel(kernel, sequence):
    """Error below that of as many independent draws: 1 / sqrt(2 M) per pair."""
    rng, count, bandwidth = np.random.default_rng(0), 1024, 1.7
    x = rng.normal(size=(40, 3)).astype(np.float32)
    omega = mdrff.frequencies(kernel, 3, count, sequence=sequence)
    phi = np.asarray(mdrff.fourier(jnp.asarray(x), jnp.asarray(omega), jnp.float32(1 / bandwidth)))
    got = phi @ phi.T / (2 * count)
    distance = np.linalg.norm(x[:, None] - x[None], axis=-1) / bandwidth
    error = got - mdrff.kernel(kernel, distance)
    assert np.sqrt(np.mean(error**2)) < 1 / np.sqrt(2 * count)
    np.testing.assert_allclose(np.diag(got), 1.0, atol=1e-5)


def test_kernels_are_the_general_matern_formula():
    r = np.linspace(0.1, 3, 20)
    for name, nu in (("Matern12", 0.5), ("Matern32", 1.5), ("Matern52", 2.5)):
        s = np.sqrt(2 * nu) * r
        np.testing.assert_allclose(mdrff.kernel(name, r), 2 ** (1 - nu) / gamma(nu) * s**nu * kv(nu, s), rtol=1e-10)
    np.testing.assert_array_equal(mdrff.kernel("Laplace", r), mdrff.kernel("Matern12", r))


@pytest.mark.parametrize(("kernel", "dof"), [("Matern12", 1), ("Matern32", 3), ("Matern52", 5)])
def test_frequencies_of_matern_are_one_multivariate_t_vector(kernel, dof):
    """Every marginal is Student t with 2 nu degrees of freedom (BayesSimIG: 2 and 4), and entries share their scale."""
    omega = mdrff.frequencies(kernel, 2, 4096)
    for row in omega:
        assert stats.kstest(row, stats.t(dof).cdf).statistic < 0.01
    assert stats.kstest(np.sum(omega**2, axis=0) / 2, stats.f(2, dof).cdf).statistic < 0.01


def test_median_distance_and_unusable_rows():
    x = jnp.asarray([[0.0], [1.0], [3.0], [1e6]])
    assert float(mdrff.median_distance(x, jnp.asarray([True, True, True, False]))) == pytest.approx(2.0)
    assert float(mdrff.median_distance(x, jnp.asarray([True, False, False, False]))) == 1.0


def test_names_of_models():
    parsed = {name: InferenceSettings(modelClass=name) for name in ("MDNN", "MDRFF", "MDRFF_Matern32", "MDRFF_RBF_4.0")}
    assert [s.density[0] for s in parsed.values()] == ["MDNN", "MDRFF", "MDRFF", "MDRFF"]
    validated = [(kernel, "validation") for kernel in ("RBF", "Matern32")]
    assert [s.density[1] for s in parsed.values()] == [None, *validated, ("RBF", 4.0)]
    assert InferenceSettings(modelClass="MDRFF_Matern52_median").density == ("MDRFF", ("Matern52", "median"))
    for name in ("MDRFF_RBF_0", "MDRFF_RBF_1e999", "MDRFF_Cosine", "MDRFF_RBF_1.2.3", "MDNN_RBF", None):
        with pytest.raises(ValueError, match="modelClass = .*(allowed are MDNN, MDRFF|no positive finite)"):
            InferenceSettings(modelClass=name)
    with pytest.raises(ValueError, match="plain, matched, truncated, probit, logit"):
        InferenceSettings(coordinates="polar")
    with pytest.raises(ValueError, match="RBF, Laplace"):
        mdrff.frequencies("Cosine", 2, 8)
