"""Mirror symmetry in PPO: copies and losses by hand, and a policy that knows what it never saw."""

import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig, SymmetryConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.mirrors import MirrorMap
from bayessim_mjx.rl import losses, networks, normalise, symmetry
from bayessim_mjx.rl.catalogue import active, learner
from bayessim_mjx.rl.extension import Learner
from bayessim_mjx.rl.train import tags
from tests.rl import probes

CONFIG = PPOConfig(
    num_envs=16, num_steps=8, num_epochs=2, num_minibatches=2, schedule="fixed", hidden_actor=(8,), hidden_critic=(8,)
)
FLIP = (np.array([0]), np.array([-1.0], np.float32))
SWAP = (np.array([1, 0, 2]), np.array([-1, -1, 1], np.float32))
TURN = (np.array([0, 1, 2]), np.array([1, 1, -1], np.float32))
BOTH = (np.array([1, 0, 2]), np.array([-1, -1, -1], np.float32))  # SWAP after TURN
PAIR, KEEP = (np.array([1, 0]), np.array([1, 1], np.float32)), (np.array([0, 1]), np.array([-1, -1], np.float32))
MIRRORS = (MirrorMap({"policy": SWAP}, PAIR), MirrorMap({"policy": TURN}, KEEP), MirrorMap({"policy": BOTH}, KEEP))


class OneSided(probes.ObservationAction):
    """As ObservationAction, but the observation is always 1: what to do at -1 is known by symmetry alone."""

    mirrors = (MirrorMap({"policy": FLIP}, FLIP),)

    def first(self, key):
        return {"policy": jnp.ones(1)}


ONE_SIDED = OneSided()


def config(augment=False, loss=False, coeff=0.0, **changes):
    return dataclasses.replace(CONFIG, symmetry=SymmetryConfig(augment, loss, coeff), **changes)


def key(seed):
    return jax.random.PRNGKey(seed)


@functools.cache
def example(size=8, mirrors=MIRRORS, activation="elu"):
    """Parameters and a batch of theirs with its copies, observation = critic's observation."""
    return jax.jit(lambda: _example(size, mirrors, activation))()


def _example(size, mirrors, activation):
    keys = jax.random.split(key(0), 4)
    params = networks.init(keys[0], networks.Sizes(3, 3, 2), dataclasses.replace(CONFIG, init_std=0.7))
    params["actor"]["layers"] = jax.tree.map(lambda x: 3 * x + 0.3, params["actor"]["layers"])  # far from symmetric
    act, log_std = networks.activation(activation), params["actor"]["log_std"]

    def rate(obs, action):
        mean = networks.mean_action(params, obs, act)
        return mean, networks.log_prob(mean, log_std, action), networks.value(params, obs, act)

    obs = jax.random.normal(keys[1], (size, 3))
    action = jax.random.normal(keys[2], (size, 2))
    mean, log_prob, value = rate(obs, action)
    advantage = jax.random.normal(keys[3], (size,))
    seen = symmetry.images(obs, [m.observation["policy"] for m in mirrors])
    done = symmetry.images(action, [m.action for m in mirrors])
    _, mirrored, values = rate(seen, done)
    weight = jnp.minimum(1, jnp.exp(mirrored - log_prob[:, None]))
    copies = symmetry.Copies(seen, seen, done, mirrored, values, weight)
    batch = losses.Batch(
        obs, obs, action, mean, log_prob, value, advantage, value + advantage, extra={"symmetry": copies}
    )
    return params, batch


def mirrored(cfg, mirrors=MIRRORS):
    """A learner whose environment has these mirrors."""
    return Learner(types.SimpleNamespace(mirrors=mirrors, observation_size={"policy": (3,)}), cfg, active(cfg))


def loss(params, batch, cfg, mirrors=MIRRORS):
    learner = mirrored(cfg, mirrors)
    total, metrics = jax.jit(lambda p, b: losses.loss(p, p["actor"]["log_std"], b, learner))(params, batch)
    return float(total), {name: float(x) for name, x in metrics.items()}


def test_images_are_signed_permutations_and_the_originals_come_first():
    x = jnp.array([[1.0, 2, 3], [4, 5, 6]])
    expected = [[[-2, -1, 3], [1, 2, -3], [-2, -1, -3]], [[-5, -4, 6], [4, 5, -6], [-5, -4, -6]]]
    np.testing.assert_array_equal(symmetry.images(x, [SWAP, TURN, BOTH]), expected)
    _, batch = example(size=5)
    both = symmetry.augmented(batch)
    assert both.observation.shape == (20, 3) and both.extra == {}
    for name in ("observation", "critic_observation", "action", "log_prob", "value", "advantage", "returns"):
        np.testing.assert_array_equal(getattr(both, name)[:5], getattr(batch, name))
    for i in range(5):  # sample i's copies, with sample i's advantage and return
        rows = slice(5 + 3 * i, 8 + 3 * i)
        np.testing.assert_array_equal(both.observation[rows], symmetry.images(batch.observation[i], [SWAP, TURN, BOTH]))
        np.testing.assert_array_equal(both.action[rows], symmetry.images(batch.action[i], [PAIR, KEEP, KEEP]))
        np.testing.assert_array_equal(both.advantage[rows], np.full(3, batch.advantage[i]))
        np.testing.assert_array_equal(both.returns[rows], np.full(3, batch.returns[i]))
        np.testing.assert_array_equal(both.log_prob[rows], batch.extra["symmetry"].log_prob[i])


def test_augmentation_is_training_on_the_copies_as_samples_of_their_own():
    """Loss and gradient are those of a batch of B (1 + K) plain samples; KL, entropy and clips those of the B."""
    params, batch = example()
    moved = jax.tree.map(lambda x: x + 0.05, params)  # ratios are not one
    both = symmetry.augmented(batch)
    plain = dataclasses.replace(both, mean=jnp.tile(batch.mean, (4, 1)))
    old = params["actor"]["log_std"]
    one = jax.jit(jax.grad(lambda p: losses.loss(p, old, batch, mirrored(config(augment=True)))[0]))(moved)
    two = jax.jit(jax.grad(lambda p: losses.loss(p, old, plain, mirrored(CONFIG))[0]))(moved)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    with_copies, without = loss(moved, batch, config(augment=True))[1], loss(moved, batch, CONFIG, ())[1]
    for name in ("Loss/kl", "Loss/entropy", "Loss/clip_fraction"):
        assert with_copies[name] == pytest.approx(without[name], rel=1e-6)
    for name in ("Loss/surrogate", "Loss/value"):
        assert with_copies[name] != pytest.approx(without[name], rel=1e-3)


def test_copies_that_the_policy_would_never_make_do_not_move_it():
    """A policy that turns left where its mirror image would turn right learns from what it did itself alone."""
    params, batch = example()
    copies = batch.extra["symmetry"]
    copies = copies.replace(log_prob=copies.log_prob - 40, weight=jnp.exp(copies.log_prob - 40))
    old = params["actor"]["log_std"]

    def gradient(batch, cfg, mirrors):
        return jax.jit(jax.grad(lambda p: losses.loss(p, old, batch, mirrored(cfg, mirrors))[0]))(params)["actor"]

    one = gradient(dataclasses.replace(batch, extra={"symmetry": copies}), config(augment=True), MIRRORS)
    two = gradient(batch, CONFIG, ())
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    assert max(float(jnp.abs(x).max()) for x in jax.tree.leaves(two)) > 1e-2


def test_copies_keep_the_standardised_advantages_of_their_samples():
    params, batch = example()
    cfg = config(augment=True, normalize_advantage_per_minibatch=True)
    standard = dataclasses.replace(batch, advantage=losses.standardise(batch.advantage))
    assert loss(params, batch, cfg)[0] == pytest.approx(loss(params, standard, config(augment=True))[0], abs=1e-5)


def test_nothing_has_moved_before_the_first_minibatch_though_the_policy_is_not_symmetric():
    """All ratios are 1: the surrogate is minus the mean weighted advantage. With their own densities it is not."""
    params, batch = example()
    copies = batch.extra["symmetry"]
    surrogate = loss(params, batch, config(augment=True))[1]["Loss/surrogate"]
    weight = 1 + np.minimum(1, np.exp(copies.log_prob - batch.log_prob[:, None])).sum(1)
    assert surrogate == pytest.approx(-float((weight * batch.advantage).sum() / weight.sum()), abs=1e-5)
    assert np.abs(copies.log_prob - batch.log_prob[:, None]).max() > 1


def test_mirror_loss_by_hand_and_without_gradient_through_its_target():
    mean = jnp.array([[1.0, 2.0]])
    copies = jnp.array([[[2.0, 4.0], [0.0, -2.0]]])  # images are (2, 1) and (-1, -2)
    parts = [PAIR, KEEP]
    assert symmetry.mirror_loss(mean, copies, parts) == pytest.approx((9 + 1) / 4)
    towards_target, towards_copies = jax.grad(symmetry.mirror_loss, argnums=(0, 1))(mean, copies, parts)
    np.testing.assert_array_equal(towards_target, np.zeros((1, 2)))
    np.testing.assert_allclose(towards_copies, [[[0, 1.5], [0.5, 0]]])


@pytest.mark.parametrize("augment", [False, True])
def test_mirror_loss_is_weighted_and_added_or_only_shown(augment):
    params, batch = example()
    shown, parts = loss(params, batch, config(augment))
    assert parts["Loss/symmetry"] > 0.1
    off, _ = loss(params, batch, config(augment, loss=False, coeff=3.0))
    if not augment:  # as if ppo.symmetry were null, bit for bit
        assert shown == loss(params, batch, CONFIG, ())[0]
    on, same = loss(params, batch, config(augment, loss=True, coeff=3.0))
    assert off == shown
    assert on - off == pytest.approx(3 * parts["Loss/symmetry"], rel=1e-4)
    assert same["Loss/symmetry"] == parts["Loss/symmetry"]
    act = networks.activation("elu")
    mean, seen = (
        networks.mean_action(params, x, act) for x in (batch.observation, batch.extra["symmetry"].observation)
    )
    expected = np.mean((seen - symmetry.images(mean, [PAIR, KEEP, KEEP])) ** 2)
    assert parts["Loss/symmetry"] == pytest.approx(float(expected), rel=1e-5)


def test_a_symmetric_policy_has_no_mirror_loss():
    """Without biases and with tanh the policy is odd, and the mirror turns all signs."""
    odd = (MirrorMap({"policy": (np.arange(3), -np.ones(3))}, (np.arange(2), -np.ones(2))),)
    cfg = config(activation="tanh")
    params, batch = example(mirrors=odd, activation="tanh")
    assert loss(params, batch, cfg, odd)[1]["Loss/symmetry"] > 1e-3
    layers = [{"w": x["w"], "b": 0 * x["b"]} for x in params["actor"]["layers"]]
    params = {**params, "actor": {**params["actor"], "layers": layers}}
    assert loss(params, batch, cfg, odd)[1]["Loss/symmetry"] < 1e-12


def test_copies_are_seen_and_rated_as_the_collecting_policy_would():
    """Mirrored before they are normalised, with statistics that are not symmetric; densities by the policy itself.

    They are learnt with later statistics.
    """
    cfg = config(augment=True)
    state = rl.init(ONE_SIDED, cfg, key(0))
    moments = normalise.Moments(jnp.array([0.4]), jnp.array([2.0]), jnp.float32(10))
    actor = {**state.params["actor"], "layers": jax.tree.map(lambda x: x + 0.3, state.params["actor"]["layers"])}
    params = {**state.params, "actor": actor}
    state = state.replace(normalizer={"policy": moments}, params=params)
    raw = {"policy": jnp.array([[[1.0], [-2.0], [1.0]]])}
    action = jnp.array([[[0.3], [1.7], [-1.7]]])  # of the last one the copy is likelier than itself
    data = {"observation": raw, "extras": {"action": action}}
    later = {"policy": normalise.Moments(jnp.array([0.6]), jnp.array([3.0]), jnp.float32(20))}
    policy = rl.policy_of(state)
    own = policy.log_prob(raw, action)
    copies = symmetry.Symmetry(cfg.symmetry).attach(state, data, later, own, learner(ONE_SIDED, cfg))
    seen = normalise.normalise(later["policy"], -raw["policy"][0])
    np.testing.assert_allclose(copies.observation[0, :, 0], seen, rtol=1e-6)
    np.testing.assert_allclose(copies.weight[..., 0], np.minimum(1, np.exp(copies.log_prob[..., 0] - own)), rtol=1e-5)
    assert copies.weight.min() < 0.9 and copies.weight.max() == 1 and (copies.log_prob[..., 0] - own).max() > 0.1
    np.testing.assert_array_equal(copies.action[0, :, 0], -action[0])
    np.testing.assert_allclose(copies.log_prob[0, :, 0], policy.log_prob(-raw["policy"][0], -action[0]), rtol=1e-5)
    value = networks.value(state.params, copies.observation, networks.activation(cfg.activation))
    np.testing.assert_allclose(copies.value, value, rtol=1e-6)
    assert active(CONFIG) == ()


@pytest.mark.parametrize(
    "how",
    [{"augment": True}, {}, pytest.param({"loss": True, "coeff": 3.0}, marks=pytest.mark.slow)],
    ids=["copies", "shown", "loss"],
)
def test_what_is_learnt_on_one_side_is_known_on_the_other(how):
    cfg = config(
        **how, num_envs=64, num_epochs=4, num_minibatches=4, learning_rate=3e-3, gamma=0.9, hidden_actor=(16,),
        hidden_critic=(16,), use_clipped_value_loss=False, log_interval=60, normalize_observations=False,
    )  # fmt: skip
    state, metrics = rl.run(ONE_SIDED, cfg, rl.init(ONE_SIDED, cfg, key(0)), iterations=60)
    right, left = rl.policy_of(state).act(None, jnp.array([[1.0], [-1.0]]))[:, 0]
    assert right == pytest.approx(0.5, abs=0.08)
    if how:
        assert left == pytest.approx(-0.5, abs=0.12)
        assert metrics["Loss/symmetry"] < 0.2
    else:
        assert abs(left + 0.5) > 0.2
    assert set(metrics) - {"Perf/total_fps", "Perf/iteration_time"} == set(tags(cfg))
    assert set(tags(cfg)) - set(tags(CONFIG)) == {"Loss/symmetry"}


def test_a_robot_without_a_mirror_is_refused():
    with pytest.raises(UserError, match="Walk declares no mirror; set ppo.symmetry=null"):
        rl.init(probes.Walk(), config(), key(0))

    class Asymmetric(probes.Clock):
        mirrors = ONE_SIDED.mirrors

    with pytest.raises(UserError, match="no mirror of the observation group 'critic'; it has policy"):
        rl.init(Asymmetric(), config(), key(0))
