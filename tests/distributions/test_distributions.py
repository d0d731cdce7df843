"""Distributions checked against grids, scipy and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from bayessim_mjx.distributions import Distribution, Gaussian, GaussianMixture, Uniform, evaluate
from bayessim_mjx.parameters import Parameter, ParameterSpace

pytestmark = pytest.mark.usefixtures("strict")


def key(seed: int = 0) -> jax.Array:
    return jax.random.PRNGKey(seed)


MASS = Parameter("mass", 1.0, 0.5, 2.5)
LENGTH = Parameter("length", 1.0, 0.2, 4.0)
FRICTION = Parameter("friction", 0.1, 0.01, 1.0, prior="loguniform")
GRAVITY = Parameter("gravity", 9.8, 9.0, 10.5, prior="gaussian", mean=9.8, sd=0.3)


def grid(space: ParameterSpace, n: int) -> tuple[np.ndarray, float]:
    """Cell centres [n^d, d] and the volume of a cell."""
    axes = [lo + (hi - lo) * (np.arange(n) + 0.5) / n for lo, hi in zip(space.low, space.high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(space))
    return points.astype(np.float32), float(np.prod((space.high - space.low) / n))


def leaking(space: ParameterSpace, prior_weight: float = 0.0, seed: int = 3, components: int = 3) -> Distribution:
    """Correlated, partly outside the box."""
    rng, d = np.random.default_rng(seed), len(space)
    scales = np.tril(0.15 * rng.normal(size=(components, d, d)), -1) + np.eye(d) * rng.uniform(
        0.08, 0.3, (components, d, 1)
    )
    return Distribution.from_unit(
        space, rng.normal(size=components), rng.uniform(-0.1, 1.1, (components, d)), scales, prior_weight
    )


@pytest.mark.parametrize("prior_weight", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("parameters", [[MASS], [FRICTION], [MASS, LENGTH], [FRICTION, GRAVITY]])
def test_the_density_integrates_to_one(parameters, prior_weight):
    space = ParameterSpace(parameters)
    points, cell = grid(space, 4000 if len(space) == 1 else 300)
    total = np.exp(np.asarray(leaking(space, prior_weight).log_prob(points))).sum() * cell
    assert total == pytest.approx(1.0, abs=5e-3)


def test_the_density_is_zero_outside_and_the_gain_of_the_prior_is_zero():
    space = ParameterSpace([MASS, FRICTION])
    q = leaking(space, 0.5)
    assert np.all(np.isneginf(q.log_prob(np.asarray([[0.4, 0.1], [1.0, 1.1]], np.float32))))
    assert float(q.log_prob(space.nominal)) > -10
    np.testing.assert_allclose(Uniform(space).log_gain(space.nominal), 0.0, atol=1e-6)
    np.testing.assert_allclose(Uniform(space).log_prob(space.nominal), space.log_prior(space.nominal), rtol=1e-6)


def test_moments_of_one_truncated_gaussian_are_those_of_scipy():
    space = ParameterSpace([MASS])
    q = Gaussian(space, [0.7], 0.5)
    truth = stats.truncnorm((0.5 - 0.7) / 0.5, (2.5 - 0.7) / 0.5, 0.7, 0.5)
    assert float(q.mean()[0]) == pytest.approx(truth.mean(), abs=2e-3)
    assert float(q.sd()[0]) == pytest.approx(truth.std(), abs=2e-3)
    assert float(q.log_prob(np.asarray([1.3], np.float32))) == pytest.approx(truth.logpdf(1.3), abs=1e-4)
    assert float(q.mode()[0]) == pytest.approx(0.7, abs=1e-4)


def test_the_covariance_has_its_between_component_part():
    space = ParameterSpace([MASS, LENGTH])
    q = GaussianMixture(space, [0.5, 0.5], [[1.0, 1.0], [2.0, 3.0]], [0.01, 0.01])
    np.testing.assert_allclose(q.mean(), [1.5, 2.0], atol=1e-3)
    np.testing.assert_allclose(q.cov(), [[0.2501, 0.5], [0.5, 1.0001]], atol=2e-3)


def test_moments_of_a_correlated_truncated_mixture_agree_with_a_grid_and_with_samples():
    space = ParameterSpace([MASS, LENGTH])
    q = leaking(space, 0.2)
    points, cell = grid(space, 300)
    weight = np.exp(np.asarray(q.log_prob(points), np.float64)) * cell
    mean, cov = weight @ points, np.cov(points.T, aweights=weight / weight.sum(), ddof=0)
    np.testing.assert_allclose(q.mean(), mean, atol=5e-3)
    np.testing.assert_allclose(q.cov(), cov, atol=1e-2)
    draws = np.asarray(q.sample(key(), 20000))
    np.testing.assert_allclose(draws.mean(0), mean, atol=0.03)
    np.testing.assert_allclose(np.cov(draws.T), cov, atol=0.04)


@pytest.mark.parametrize("centre", [0.5, 1.4, 3.0, -40.0])
def test_no_draw_leaves_the_box_however_little_mass_is_inside(centre):
    space = ParameterSpace([MASS, FRICTION, GRAVITY])
    scales = np.tile(0.2 * np.eye(3), (2, 1, 1)) + np.tril(np.full((3, 3), 0.1), -1)
    q = Distribution.from_unit(space, np.zeros(2), np.full((2, 3), centre), scales)
    draws = np.asarray(q.sample(key(1), 500))
    assert np.all(np.isfinite(draws)) and np.all(draws >= space.low) and np.all(draws <= space.high)
    assert np.all(np.isfinite(q.log_prob(draws)))


def test_draws_from_a_far_tail_have_the_right_mean():
    space = ParameterSpace([Parameter("x", 0.5, 0.0, 1.0)])
    q = Distribution.from_unit(space, np.zeros(1), np.full((1, 1), -1.0), np.full((1, 1, 1), 0.2))  # mass 3e-7 inside
    truth = stats.truncnorm(5.0, 10.0, -1.0, 0.2)
    assert float(q.log_inside) == pytest.approx(np.log(stats.norm.sf(5.0)), abs=0.02)
    assert float(q.mean()[0]) == pytest.approx(truth.mean(), rel=0.05)
    assert np.asarray(q.sample(key(), 4000)).mean() == pytest.approx(truth.mean(), rel=0.05)


def test_candidates_of_a_flat_gaussian_are_draws_nearly_all_and_of_a_leaking_mixture_follow_it():
    space = ParameterSpace([Parameter(f"p{i}", 0.5, 0.0, 1.0) for i in range(30)])
    flat = Distribution.from_unit(space, jnp.zeros(1), jnp.full((1, 30), 0.5), 3.0 * jnp.eye(30)[None])
    u, drawn = (np.asarray(x) for x in evaluate.candidates(flat, key(), 2000))
    assert drawn.mean() > 0.75 and u[drawn].std(0) == pytest.approx(np.full(30, 12**-0.5), rel=0.08)
    # a Gaussian is in the box with (2 Phi(1 / 6) - 1)^30 = 1e-27
    assert float(flat.log_inside) == pytest.approx(30 * np.log(2 * stats.norm.cdf(1 / 6) - 1), rel=1e-3)

    q = leaking(ParameterSpace([MASS, LENGTH]), 0.3)
    u, drawn = (np.asarray(x) for x in evaluate.candidates(q, key(1), 40_000))
    points, cell = grid(q.space, 300)
    density = np.exp(np.asarray(q.log_prob(points))) * cell
    mean = density @ points
    theta = np.asarray(jax.vmap(q.space.from_unit)(jnp.asarray(u[drawn])))
    assert drawn.mean() > 0.2
    np.testing.assert_allclose(theta.mean(0), mean, atol=4 * theta.std(0).max() / drawn.sum() ** 0.5)
    np.testing.assert_allclose(np.cov(theta.T), (points - mean).T @ ((points - mean) * density[:, None]), atol=0.012)


def test_prior_and_posterior_share_one_compiled_program():
    space, traces = ParameterSpace([MASS, FRICTION]), []

    @jax.jit
    def consumer(q, key):
        traces.append(1)
        return q.sample(key, 8), q.log_prob(q.sample(key, 8))

    for q in (Uniform(space, 3), leaking(space), Gaussian(space, [1.0, 0.1], 0.05, components=3), leaking(space, 0.5)):
        theta, log_prob = consumer(q, key())
        assert theta.shape == (8, 2) and np.all(np.isfinite(log_prob))
    assert len(traces) == 1


def test_a_batch_of_distributions_maps_and_splits():
    space = ParameterSpace([MASS, LENGTH])
    rows = [leaking(space, seed=s) for s in range(3)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)
    draws = jax.vmap(lambda q, k: q.sample(k, 5))(batch, jax.random.split(key(), 3))
    assert draws.shape == (3, 5, 2)
    np.testing.assert_allclose(batch.split()[1].mean(), rows[1].mean(), rtol=1e-6)


def test_the_prior_contracts_nothing_and_a_spike_everything():
    space = ParameterSpace([MASS, FRICTION])
    np.testing.assert_allclose(Uniform(space, 4).contraction(), 0.0, atol=4e-5)  # 1.8e-5 on a GPU
    np.testing.assert_allclose(Gaussian(space, [1.0, 0.1], 1e-4).contraction(), 1.0, atol=1e-4)
    table = Gaussian(space, {"mass": 1.25, "friction": 0.2}, [0.05, 0.01]).describe()
    assert table["mass"]["mean"] == pytest.approx(1.25, abs=1e-3) and table["mass"]["sd"] == pytest.approx(
        0.05, rel=0.02
    )
    assert table["friction"]["sd"] == pytest.approx(0.01, rel=0.05)  # first order in the log


def test_credible_level_of_a_gaussian():
    space = ParameterSpace([Parameter("x", 0.0, -1.0, 1.0)])
    q = Gaussian(space, [0.0], 0.1)
    z = np.asarray([[0.0], [0.0674], [-0.164], [0.196], [0.5]], np.float32)
    np.testing.assert_allclose(q.credible_level(z), [0.0, 0.5, 0.9, 0.95, 1.0], atol=0.01)


def test_regions_of_a_flat_density_hold_their_share_of_it():
    """Not all of it or nothing, as rounding has it."""
    q = Distribution.prior(ParameterSpace([MASS, LENGTH]), 3)
    levels = np.asarray(q.credible_level(q.sample(key(), 4000)))
    for share in (0.5, 0.8, 0.95):
        np.testing.assert_allclose(np.mean(levels < share), share, atol=0.03)


def test_a_marginal_is_the_integral_over_the_others():
    space = ParameterSpace([MASS, LENGTH])
    scales = np.asarray([np.diag([0.1, 0.3]), np.diag([0.2, 0.05])])
    q = Distribution.from_unit(space, np.log([0.3, 0.7]), np.asarray([[0.3, 0.95], [0.9, 0.4]]), scales, 0.1)
    points, _ = grid(space, 300)
    density = np.exp(np.asarray(q.log_prob(points))).reshape(300, 300)
    for axis, name in enumerate(("mass", "length")):
        marginal = q.marginal([name])
        assert marginal.names == (name,)
        x = np.unique(points[:, axis])
        other = np.ptp([space.low[1 - axis], space.high[1 - axis]]) / 300
        expected = density.sum(1 - axis) * other
        np.testing.assert_allclose(np.exp(marginal.log_prob(x[:, None])), expected, atol=0.02)


def test_n_gaussian_posteriors_contract_as_one_over_root_n():
    space = ParameterSpace([MASS, LENGTH])
    cov = np.asarray([[0.01, 0.004], [0.004, 0.02]])
    means = [[1.4, 2.0], [1.5, 2.2], [1.6, 1.9], [1.5, 2.3]]
    q, *others = [Gaussian(space, m, cov, components=5) for m in means]
    product = q.product(*others)
    np.testing.assert_allclose(product.mean(), np.mean(means, axis=0), atol=2e-3)
    np.testing.assert_allclose(product.cov(), cov / 4, atol=5e-5)
    assert product.components == 5


@pytest.mark.parametrize("weights", [(0.0, 0.0), (0.3, 0.0), (0.4, 0.2), (1.0, 0.0)])
@pytest.mark.parametrize("parameters", [[FRICTION], [MASS, FRICTION]])
def test_a_product_equals_the_normalised_product_on_a_grid(parameters, weights):
    space = ParameterSpace(parameters)
    a, b = leaking(space, weights[0], seed=1), leaking(space, weights[1], seed=2)
    product = a.product(b, components=16)  # (3 + 1)^2 - 1 components: no merging
    points, cell = grid(space, 4000 if len(space) == 1 else 250)
    log_exact = np.asarray(a.log_gain(points) + b.log_prob(points), np.float64)
    exact = np.exp(log_exact) / (np.exp(log_exact).sum() * cell)
    got = np.exp(np.asarray(product.log_prob(points), np.float64))
    assert 0.5 * np.abs(got - exact).sum() * cell < 5e-3  # total variation
    assert float(product.prior_weight) == pytest.approx(_flat_weight(a, b, points, cell), abs=5e-3)


def _flat_weight(a, b, points, cell):
    both = np.exp(np.asarray(a.log_gain(points) + b.log_prob(points), np.float64)).sum() * cell
    return float(a.prior_weight) * float(b.prior_weight) / both


def test_reducing_keeps_mean_and_covariance():
    space = ParameterSpace([MASS, LENGTH])
    rng = np.random.default_rng(0)
    means = np.asarray([1.5, 2.0]) + 0.1 * rng.normal(size=(8, 2))
    q = GaussianMixture(space, rng.uniform(0.1, 1, 8), means, [0.05] * 8)
    small = q.reduce(2)
    assert small.components == 2
    np.testing.assert_allclose(small.mean(), q.mean(), atol=2e-3)
    np.testing.assert_allclose(small.cov(), q.cov(), atol=1e-3)


def test_one_merge_has_the_moments_of_the_pair():
    space = ParameterSpace([Parameter("x", 0.5, 0.0, 1.0)])
    q = GaussianMixture(space, [0.25, 0.75], [[0.4], [0.6]], [0.02, 0.03]).reduce(1)
    assert float(q.means[0, 0]) == pytest.approx(0.55, abs=1e-6)
    assert float(q.scales[0, 0, 0]) ** 2 == pytest.approx(0.25 * 4e-4 + 0.75 * 9e-4 + 0.1875 * 0.04, rel=1e-4)


def test_many_sharp_and_conflicting_posteriors_stay_finite():
    space = ParameterSpace([MASS, LENGTH])
    rows = [Gaussian(space, [m, 1.0], 1e-3, components=3) for m in (0.6, 1.4, 2.4)] * 4
    product = rows[0].product(*rows[1:])
    assert np.all(np.isfinite(product.mean())) and np.all(np.isfinite(product.sample(key(), 10)))
    assert float(product.mean()[0]) == pytest.approx(4.4 / 3, abs=1e-3)


def test_no_parameters_is_a_distribution_too():
    q = Uniform(ParameterSpace([]), 2)
    assert q.sample(key(), 3).shape == (3, 0)
    assert float(q.log_prob(jnp.zeros(0))) == 0.0


def test_save_and_load(tmp_path):
    space = ParameterSpace([MASS, FRICTION])
    q = leaking(space, 0.25)
    path = q.save(tmp_path / "rounds" / "posterior.npz")
    again = Distribution.load(path, space)
    jax.tree.map(np.testing.assert_array_equal, again, q)
    assert [p.name for p in path.parent.iterdir()] == ["posterior.npz"]  # nothing half-written stays
    with pytest.raises(ValueError, match="length"):
        Distribution.load(path, ParameterSpace([MASS, LENGTH]))
    with pytest.raises(ValueError, match="mass.*range here"):
        Distribution.load(path, ParameterSpace([Parameter("mass", 1.0, 0.5, 3.0), FRICTION]))
    np.savez(tmp_path / "other.npz", a=np.zeros(2))
    with pytest.raises(ValueError, match="holds no distribution"):
        Distribution.load(tmp_path / "other.npz", space)


def test_refusals_name_the_parameter():
    space = ParameterSpace([MASS, LENGTH])
    with pytest.raises(ValueError, match="length is 9"):
        Gaussian(space, [1.0, 9.0], 0.1)
    with pytest.raises(ValueError, match="spread of shape"):
        Gaussian(space, [1.0, 1.0], [0.1, 0.1, 0.1])
    with pytest.raises(ValueError, match="do not match"):
        GaussianMixture(space, [0.5, 0.5], [[1.0, 1.0]], [0.1])
    with pytest.raises(ValueError, match="different parameters"):
        Uniform(space).product(Uniform(ParameterSpace([MASS])))
    with pytest.raises(ValueError, match="mas"):
        Uniform(space).marginal(["mas"])


def test_a_summary_has_a_line_for_each_parameter_in_its_unit():
    space = ParameterSpace([Parameter("mass", 1.0, 0.5, 2.0, unit="kg"), Parameter("length_mult", 1.0, 0.5, 2.0)])
    first, second = Distribution.gaussian(space, [1.0, 1.25], 0.1, 3).summary().splitlines()
    assert first == "mass         1.00 ± 0.10 kg  posterior/prior sd 0.23"
    assert second == "length_mult  1.25 ± 0.10     posterior/prior sd 0.23"
