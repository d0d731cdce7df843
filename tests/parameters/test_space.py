"""Vector <-> names, unit coordinates and priors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import Parameter, ParameterSpace

MASS = Parameter("mass", 1.0, 0.5, 2.0, unit="kg")
DAMPING = Parameter("damping", 1.0, 0.01, 10.0, prior="loguniform")
DELAY = Parameter("delay", 0.01, 0.0, 0.05, unit="s", prior="gaussian", mean=0.02, sd=0.01)
SPACE = ParameterSpace([MASS, DAMPING, DELAY])


def test_names_and_vectors():
    assert len(SPACE) == 3 and SPACE.names == ("mass", "damping", "delay") and SPACE.units == ("kg", "", "s")
    assert SPACE.low.dtype == np.float32
    np.testing.assert_allclose(SPACE.vector({"damping": 5}), [1, 5, 0.01])
    np.testing.assert_allclose(SPACE.vector([1, 2, 0.03]), [1, 2, 0.03])
    assert SPACE.as_dict([1, 2, 0]) == {"mass": 1.0, "damping": 2.0, "delay": 0.0}
    assert SPACE.subset(["delay", "mass"]).names == ("delay", "mass")
    assert ParameterSpace([MASS]) + ParameterSpace([DAMPING, DELAY]) == SPACE
    assert len({SPACE, ParameterSpace([MASS, DAMPING, DELAY])}) == 1


@pytest.mark.parametrize("seed", range(3))
def test_unit_coordinates_and_back(seed):
    u = jax.random.uniform(jax.random.PRNGKey(seed), (100, 3))
    theta = SPACE.from_unit(u)
    assert SPACE.contains(theta).all()
    np.testing.assert_allclose(SPACE.to_unit(theta), u, atol=2e-5)


def test_the_ends_are_exact():
    for u, theta in ((0.0, SPACE.low), (1.0, SPACE.high)):
        np.testing.assert_array_equal(SPACE.from_unit(jnp.full(3, u)), theta)
        np.testing.assert_array_equal(SPACE.to_unit(theta), np.full(3, u))
    np.testing.assert_array_equal(SPACE.contains(np.stack([SPACE.low, SPACE.high, SPACE.high * 1.01])), [1, 1, 0])


def test_medians_known_beforehand():
    median = SPACE.from_unit(jnp.full(3, 0.5))
    assert median[0] == pytest.approx(1.25)
    assert median[1] == pytest.approx(np.sqrt(0.01 * 10), rel=1e-5)  # geometric mean
    wide = ParameterSpace([Parameter("x", 0, -5, 5, prior="gaussian", mean=0.3, sd=0.1)])
    assert wide.from_unit(jnp.array([0.5]))[0] == pytest.approx(0.3)
    assert wide.to_unit(jnp.array([0.4]))[0] == pytest.approx(0.841345, abs=1e-5)  # Phi(1)


@pytest.mark.parametrize("parameter", [MASS, DAMPING, DELAY])
def test_the_prior_density_integrates_to_one(parameter):
    space = ParameterSpace([parameter])
    grid = np.linspace(parameter.low, parameter.high, 200_001, dtype=np.float32)
    density = np.exp(np.asarray(space.log_prior(grid[:, None]), np.float64))
    assert np.trapezoid(density, grid.astype(np.float64)) == pytest.approx(1, abs=1e-3)


def test_the_joint_density_is_the_product_and_vanishes_outside():
    theta = jnp.array([1.0, 1.0, 0.02])
    parts = sum(ParameterSpace([p]).log_prior(theta[i : i + 1]) for i, p in enumerate(SPACE.parameters))
    assert SPACE.log_prior(theta) == pytest.approx(float(parts), rel=1e-5)
    outside = theta.at[1].set(-1.0)
    assert SPACE.log_prior(outside) == -np.inf
    assert not np.isnan(jax.grad(lambda t: SPACE.log_prior(t))(theta)).any()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Parameter("a", 1, 2, 1), r"parameter 'a': range \[2, 1\]"),
        (lambda: Parameter("a", 3, 0, 1), "nominal 3 is outside its range"),
        (lambda: Parameter("a", 1, 0, 2, prior="loguniform"), "needs low > 0"),
        (lambda: Parameter("a", 1, 0, 2, prior="gaussian", mean=1), "needs mean and sd"),
        (lambda: Parameter("a", 1, 0, 2, prior="normal"), "'normal' is none of uniform"),
        (lambda: Parameter("a", 1, 0.1, 2, operation="plus"), "'plus' is none of scaling"),
        (lambda: Parameter("a", 1, 0, 2, attribute="mass", kind="body"), "low must be > 0"),
        (lambda: ParameterSpace([MASS, MASS]), "named twice: mass"),
        (lambda: SPACE.index("dampimg"), "did you mean damping"),
        (lambda: SPACE.vector({"m": 1}), "no parameter 'm'"),
        (lambda: SPACE.vector([1, 2]), r"3 parameters .* shape \(2,\)"),
    ],
)
def test_refusals(make, words):
    with pytest.raises(UserError, match=words):
        make()
