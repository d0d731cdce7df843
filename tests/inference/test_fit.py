"""The network against posteriors known in closed form."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.inference import InferenceSettings, combine, condition, fit, infer, init, mdn
from bayessim_mjx.inference.ensemble import weigh
from bayessim_mjx.inference.state import Again, Data
from bayessim_mjx.inference.train import _Member
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter("mass", 1.0, 0.5, 2.5), Parameter("length", 1.0, -2.0, 4.0)])
MIX = np.asarray([[1.0, 0.2], [-0.4, 0.5], [0.3, 0.3], [0.0, 0.0]])  # the last feature is constant
NOISE = 0.1
ROWS = 240  # one capacity for the quick fits: they share a compiled program
SMALL = InferenceSettings(components=2, hiddenLayers=(32,), batch=128, min_steps=600, max_steps=600, ensemble=1)
QUICK = dataclasses.replace(SMALL, min_steps=20, max_steps=20, batch=32)


pytestmark = pytest.mark.usefixtures("strict")


def key(seed: int = 0) -> jax.Array:
    return jax.random.PRNGKey(seed)


def linear_gaussian(n: int, seed: int = 0, theta: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """x = MIX theta + noise: pairs (theta [n, 2], x [n, 4]), theta from the prior unless given."""
    rng = np.random.default_rng(seed)
    thetas = rng.uniform(SPACE.low, SPACE.high, (n, 2)) if theta is None else np.tile(theta, (n, 1))
    x = 5.0 + thetas @ MIX.T + NOISE * rng.normal(size=(n, 4)) * [1, 1, 1, 0]
    return thetas.astype(np.float32), x.astype(np.float32)


def exact(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Posterior mean and covariance of the linear-Gaussian problem given rows x [n, 4] (walls far away)."""
    a = MIX[:3]
    precision = len(x) * a.T @ a / NOISE**2
    return np.linalg.solve(precision, a.T @ (x[:, :3] - 5.0).sum(0) / NOISE**2), np.linalg.inv(precision)


@pytest.fixture(scope="module")
def trained():
    thetas, x = linear_gaussian(4000)
    settings = dataclasses.replace(SMALL, max_steps=2000, epochs=100)
    return fit(key(1), init(key(2), settings, SPACE, 4), thetas, x)


THETA = np.asarray([1.5, 1.0])


@pytest.mark.slow
@pytest.mark.ci
def test_the_linear_gaussian_posterior_is_recovered(trained):
    state, info = trained
    _, x = linear_gaussian(20, 5, THETA)
    for i, q in enumerate(condition(state, x).split()):
        mean, cov = exact(x[i : i + 1])
        sd = np.sqrt(np.diag(cov))
        np.testing.assert_allclose((np.asarray(q.mean()) - mean) / sd, 0.0, atol=0.25)
        np.testing.assert_allclose(np.asarray(q.sd()) / sd, 1.0, atol=0.15)
        assert q.cov()[0, 1] / (q.sd()[0] * q.sd()[1]) == pytest.approx(cov[0, 1] / sd[0] / sd[1], abs=0.1)
    entropy = 0.5 * np.log(np.linalg.det(2 * np.pi * np.e * cov))
    assert -0.1 < float(info.log_q) + entropy < 0.25  # walls make the truth a little sharper than the Gaussian


@pytest.mark.slow
def test_several_trajectories_multiply(trained):
    state, _ = trained
    _, x = linear_gaussian(9, 7, THETA)
    q = infer(state, x)
    mean, cov = exact(x)
    np.testing.assert_allclose((np.asarray(q.mean()) - mean) / np.sqrt(np.diag(cov)), 0.0, atol=1.0)
    np.testing.assert_allclose(np.asarray(q.sd()), np.sqrt(np.diag(cov)), rtol=0.25)
    assert float(q.credible_level(THETA.astype(np.float32))) < 0.99
    single = infer(state, x[:1])
    assert np.all(np.asarray(q.sd()) < 0.5 * np.asarray(single.sd()))
    assert combine(condition(state, x), 1).components == 1


def test_posteriors_stay_in_the_box_even_far_off_the_data(trained):
    state, _ = trained
    x = 5.0 + 30.0 * np.random.default_rng(0).normal(size=(6, 4)).astype(np.float32)
    batch = condition(state, x.astype(np.float32))
    draws = np.asarray(jax.vmap(lambda q, k: q.sample(k, 200))(batch, jax.random.split(key(), 6)))
    np.testing.assert_allclose(batch.prior_weight, state.settings.defensive)  # none can veto the others
    assert np.all(draws >= SPACE.low) and np.all(draws <= SPACE.high)
    assert np.all(np.isfinite(jax.vmap(lambda q, t: q.log_prob(t))(batch, jnp.asarray(draws))))


def test_a_posterior_that_leaves_the_box_by_far_tells_nothing_and_cannot_veto_the_others(trained):
    """float32 tells nothing of a density whose mass inside the box is exp(-1e10): as a factor it used to win."""
    state, _ = trained
    _, x = linear_gaussian(1, 5, THETA)
    outer = state.params["layers"][-1]
    k, d = state.settings.components, 2
    far = {**outer, "b": outer["b"].at[..., k : k + k * d].add(1e6)}
    lost = dataclasses.replace(state, params={**state.params, "layers": [*state.params["layers"][:-1], far]})
    wild, good = condition(lost, x), condition(state, x)
    assert float(wild.log_inside[0]) < -1e8
    thetas = jnp.asarray([THETA, [0.6, 2.5]], jnp.float32)
    np.testing.assert_allclose(wild.split()[0].log_gain(thetas), 0.0, atol=1e-5)  # the prior
    both, alone = combine([*good.split(), *wild.split()]), good.split()[0]
    np.testing.assert_allclose(both.log_gain(thetas[:1]), alone.log_gain(thetas[:1]), atol=0.05)
    np.testing.assert_allclose(both.sd(), alone.sd(), rtol=0.05)


def test_a_constant_column_is_dropped_and_cannot_speak_later(trained):
    state, _ = trained
    assert float(state.x_rate[3]) == 0.0
    _, x = linear_gaussian(1, 5, THETA)
    moved = x + np.asarray([[0, 0, 0, 100]], np.float32)
    np.testing.assert_array_equal(condition(state, x).means, condition(state, moved).means)


@pytest.mark.slow
@pytest.mark.ci
def test_a_growing_data_set_does_not_retrace(monkeypatch):
    traces, density = [], mdn.density
    monkeypatch.setattr(mdn, "density", lambda *a: traces.append(1) or density(*a))
    settings = dataclasses.replace(QUICK, lr=1e-3)  # a program of its own
    thetas, x = linear_gaussian(ROWS)
    state = init(key(), settings, SPACE, 4)
    state, first = fit(key(1), state, thetas, x, 100)
    n = len(traces)
    state, second = fit(key(2), state, thetas, x, 230)
    assert n > 0 and len(traces) == n
    assert int(first.n_train + first.n_val) == 100 and int(second.n_train + second.n_val) == 230
    assert int(state.fits) == 2 and second.train_loss.shape == second.val_loss.shape


@pytest.mark.slow
@pytest.mark.ci
def test_padding_is_not_seen():
    thetas, x = linear_gaussian(ROWS)
    state = init(key(), QUICK, SPACE, 4)
    results = []
    for fill in (0.0, np.nan, 1e6):
        t, y = thetas.copy(), x.copy()
        t[80:], y[80:] = fill, fill
        results.append(fit(key(1), state, t, y, 80)[0])
    for other in results[1:]:
        jax.tree.map(np.testing.assert_array_equal, results[0], other)


def test_diverged_simulations_are_left_out_and_counted():
    thetas, x = linear_gaussian(ROWS)
    x[7, 1], x[50], thetas[60, 0] = np.nan, np.inf, 99.0
    state, info = fit(key(1), init(key(), QUICK, SPACE, 4), thetas, x)
    assert int(info.n_invalid) == 3 and int(info.n_train + info.n_val) == ROWS - 3
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(state))
    assert int(info.skipped) == 0 and np.all(np.isfinite(info.val_loss))
    with pytest.raises(ValueError, match="none of the 240 rows"):
        fit(key(1), state, thetas, np.full_like(x, np.nan))


@pytest.mark.slow
@pytest.mark.ci
def test_further_draws_of_noise_that_are_no_other_change_nothing():
    thetas, x = linear_gaussian(ROWS)
    own = jnp.asarray(np.where(np.arange(ROWS) < 80, np.arange(ROWS), -1), jnp.int32)
    found = []
    for change in (0.0, 0.1):
        again = Again(jnp.asarray(np.repeat(x[:80, None], 3, axis=1) + change), own)
        found.append(fit(key(1), init(key(), QUICK, SPACE, 4), thetas, x, again=again)[0])
    plain, _ = fit(key(1), init(key(), QUICK, SPACE, 4), thetas, x)
    same, other = ([np.asarray(leaf, float) for leaf in jax.tree.leaves(state.params)] for state in found)
    before = [np.asarray(leaf, float) for leaf in jax.tree.leaves(plain.params)]
    away = [max(np.abs(a - b).max() for a, b in zip(leaves, before, strict=True)) for leaves in (same, other)]
    assert away[0] < 1e-4 < away[1]


def test_each_turn_a_row_is_seen_with_the_next_of_its_draws():
    own = jnp.asarray([-1, 0, 1, -1], jnp.int32)
    data = Data(jnp.zeros((1, 4 + 2 * 2, 3)), None, None, jnp.ones(4, bool), None, None, None, None, own, 3)
    member = types.SimpleNamespace(data=data)
    rows = jnp.arange(4, dtype=jnp.int32)
    seen = np.stack([_Member.seen(member, rows, jnp.full(4, turn, jnp.uint32)) for turn in range(6)])
    assert {tuple(sorted(set(column.tolist()))) for column in seen.T} == {(0,), (1, 4, 6), (2, 5, 7), (3,)}
    assert np.all((seen[1:, 1] != seen[:-1, 1]) & (seen[1:, 2] != seen[:-1, 2]))


@pytest.mark.slow
@pytest.mark.ci
def test_fine_tuning_never_ends_worse_on_the_held_out_rows(trained):
    state, info = trained
    thetas, x = linear_gaussian(4000)
    again = dataclasses.replace(state, settings=dataclasses.replace(state.settings, lr=1e3, max_steps=40, min_steps=40))
    state, worse = fit(key(3), again, thetas, x)  # a learning rate that ruins everything
    assert float(worse.gain) == pytest.approx(float(info.gain), abs=1e-4) and int(worse.best) == -1
    assert info.best >= 0 and int(state.fits) == 2


def test_each_member_has_the_sharpness_that_held_out_rows_ask_for():
    """Truths are half the time 0.2, half the time 0.6 off; both members say 0.35."""
    settings = dataclasses.replace(SMALL, components=1, hiddenLayers=(1,), ensemble=2)
    one = jax.tree.map(jnp.zeros_like, mdn.init(key(), settings, 1, 1))
    one["layers"][-1]["b"] = one["layers"][-1]["b"].at[2].set(8 * np.arctanh(np.log(1 / 0.35) / 8))
    params = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), one)
    n = 20_000
    y = np.where(np.arange(n) % 2, 0.2, 0.6) * np.random.default_rng(0).normal(size=n)
    y, rows = jnp.asarray(y[:, None], jnp.float32), jnp.arange(n)
    data = Data(jnp.zeros((n, 1)), y, jnp.zeros(n), rows < 0, rows, jnp.ones(n), None, None)
    found = jax.jit(lambda p: weigh(p, data, settings))(params)
    order = np.argsort(found["sharpness"])
    np.testing.assert_allclose(np.asarray(found["sharpness"])[order], [0.35 / 0.6, 0.35 / 0.2], rtol=0.15)
    np.testing.assert_allclose(np.exp(found["share"]), 0.5, atol=0.12)


@pytest.mark.slow
@pytest.mark.ci
def test_one_parameter_and_few_rows():
    space = ParameterSpace([Parameter("friction", 0.1, 0.01, 1.0, prior="loguniform")])
    rng = np.random.default_rng(0)
    u = rng.uniform(size=(500, 1))
    thetas = (0.01 * 100**u).astype(np.float32)
    x = (u + 0.05 * rng.normal(size=u.shape)).astype(np.float32)
    settings = dataclasses.replace(SMALL, fullCovariance=False)
    state, info = fit(key(1), init(key(), settings, space, 1), thetas, x)
    q = infer(state, np.asarray([[0.5]], np.float32))
    assert float(q.mean()[0]) == pytest.approx(0.1, rel=0.15)
    assert float(space.to_unit(q.mean())[0]) == pytest.approx(0.5, abs=0.04)
    assert float(info.gain_truncated) == pytest.approx(-np.log(0.05 * np.sqrt(2 * np.pi * np.e)), abs=0.25)
    state, info = fit(key(1), init(key(), settings, space, 1), thetas, x, 3)  # hardly a data set, but no crash
    assert np.isfinite(info.gain)


def test_the_density_of_the_network_is_that_of_its_mixture():
    settings = dataclasses.replace(SMALL, components=3)
    params = mdn.init(key(), settings, 4, 2)
    params["layers"][-1]["w"] = 0.1 * jax.random.normal(key(1), params["layers"][-1]["w"].shape)
    x, u = jax.random.normal(key(2), (1, 4)), jax.random.uniform(key(3), (1, 2))
    logits, means, scales = (np.asarray(v[0], np.float64) for v in mdn.mixture(params, x, 2, settings))
    weights = np.exp(logits - np.logaddexp.reduce(logits))
    density = 0.0
    for w, m, s in zip(weights, means, scales, strict=True):
        cov, gap = s @ s.T, np.asarray(u[0]) - m
        density += w * np.exp(-0.5 * gap @ np.linalg.solve(cov, gap)) / np.sqrt(np.linalg.det(2 * np.pi * cov))
    got = float(mdn.log_prob(params, x, mdn.to_y(u), settings)[0]) + np.log(12)  # y = (u - 1/2) sqrt(12)
    assert got == pytest.approx(np.log(density), abs=1e-3)


def test_the_state_is_a_pytree_of_arrays(trained):
    state, _ = trained
    leaves, structure = jax.tree.flatten(state)
    assert all(isinstance(leaf, jax.Array) for leaf in leaves)
    again = jax.tree.unflatten(structure, [jnp.asarray(np.asarray(leaf)) for leaf in leaves])
    x = linear_gaussian(2, 5)[1]
    np.testing.assert_array_equal(condition(again, x).means, condition(state, x).means)


def test_wrong_input_is_refused(trained):
    state, _ = trained
    thetas, x = linear_gaussian(10)
    with pytest.raises(ValueError, match=r"x \[N, 4\]"):
        fit(key(), state, thetas, x[:, :3])
    with pytest.raises(ValueError, match="count = 11"):
        fit(key(), state, thetas, x, 11)
    with pytest.raises(ValueError, match=r"summaries \[n, 4\]"):
        condition(state, x[0])
    with pytest.raises(ValueError, match="real trajectory 1"):
        infer(state, np.asarray([[0, 0, 0, 0], [0, np.nan, 0, 0]], np.float32))
    with pytest.raises(ValueError, match="at least one"):
        combine([])
    with pytest.raises(ValueError, match="MDNX"):
        InferenceSettings(modelClass="MDNX")
    with pytest.raises(ValueError, match="components"):
        InferenceSettings(components=0)


def test_coordinates_are_probit_where_every_prior_is_gaussian():
    """There a linear simulator's posterior is one Gaussian; other priors, and what is asked for, stay as they are."""
    gaussian = [Parameter(name, 0.0, -2.0, 2.0, prior="gaussian", mean=0.0, sd=0.3) for name in "ab"]
    spaces = ParameterSpace(gaussian), ParameterSpace([*gaussian, *SPACE.parameters]), SPACE
    settings = dataclasses.replace(SMALL, coordinates="auto")
    assert [init(key(), settings, space, 4).settings.coordinates for space in spaces] == ["probit", "plain", "plain"]
    assert dataclasses.replace(SMALL, coordinates="logit").at(spaces[0]).chart == "logit"


def test_settings_are_taken_from_a_configuration_section():
    @dataclasses.dataclass
    class Section:
        components: int = 4
        hiddenLayers: tuple = (16, 16)
        realIters: int = 3

    settings = InferenceSettings.of(Section(), lr=1e-3)
    assert (settings.components, settings.hiddenLayers, settings.lr) == (4, (16, 16), 1e-3)
    hash(settings)
