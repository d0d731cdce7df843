"""Collection policies, the surrogate's parameters, and recorded sources."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import config, loop
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.loop import sources
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.registry import make
from bayessim_mjx.rl import networks, normalise

SPACE = ParameterSpace(
    [
        Parameter("mass", 1.0, 0.1, 2.0, kind="body"),
        Parameter("length", 1.0, 0.1, 2.0, kind="body"),
        Parameter("damping", 0.5, 0.0, 1.0, kind="body"),
    ]
)


def policy_of_size(actions: int) -> networks.Policy:
    settings = PPOConfig(hidden_actor=(4,), hidden_critic=(4,), init_std=0.5)
    actor = networks.init(jax.random.PRNGKey(0), networks.Sizes(3, 3, actions), settings)["actor"]
    return networks.Policy(actor=actor, normalizer=normalise.init(3), activation="elu", normalize=True, action_clip=1.0)


def actions_of(name: str, count: int = 4000) -> np.ndarray:
    act = sources.policy_function(name, policy_of_size(2), 2)
    keys = jax.random.split(jax.random.PRNGKey(1), count)
    return np.asarray(jax.vmap(lambda key: act(key, {"policy": jnp.ones(3)}))(keys))


def test_random_actions_are_symmetric():
    """BayesSimIG drew U[0, 1]: only positive commands."""
    actions = actions_of("policy_random")
    assert abs(actions.mean()) < 0.03
    assert actions.min() < -0.99 and actions.max() > 0.99


def test_ones_are_ones():
    np.testing.assert_array_equal(actions_of("policy_ones", 3), np.ones((3, 2)))


def test_a_tenth_of_the_randomized_actions_is_random_and_each_world_has_its_own_coin():
    plain, mixed = actions_of("policy_rl"), actions_of("policy_rl_randomized")
    # the policy's own actions have mean near 0 and sd 0.5; U[-1, 1] replaces a tenth of them
    assert np.std(plain) == pytest.approx(0.5, abs=0.05)
    expected = 0.9 * plain.var() + 0.1 / 3
    assert mixed.var() == pytest.approx(expected, rel=0.1)


def test_one_standard_deviation_stands_for_every_parameter_and_names_may_be_used():
    weights, means, sds = sources.real_parameters({"means": [[1.0, 0.5, 0.2]], "stds": [[0.01]]}, SPACE)
    np.testing.assert_allclose(weights, [1.0])
    np.testing.assert_allclose(means, [[1.0, 0.5, 0.2]])
    np.testing.assert_allclose(sds, [[0.01, 0.01, 0.01]])
    named = sources.real_parameters({"means": {"length": 0.5, "mass": 1.0, "damping": 0.2}}, SPACE)[1]
    np.testing.assert_allclose(named, [[1.0, 0.5, 0.2]])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (None, "real.logs"),
        ({"means": [[1.0, 0.5]]}, "3 parameters: mass, length, damping"),
        ({"means": [[1.0, 3.0, 0.5]]}, r"length=3 lies outside its range \[0.1, 2\]"),
        ({"means": {"mass": 1.0, "lenght": 0.5, "damping": 0.1}}, "length"),
        ({"means": {"mass": 1.0}}, "no value for length, damping"),
        ({"means": [[1.0, 1.0, 0.5]], "stds": [[-0.1]]}, "stds must be >= 0"),
        ({"means": [[1.0, 1.0, 0.5]], "weights": [0.5, 0.5]}, "2 weights, 1 means"),
    ],
)
def test_bad_real_parameters_are_refused_with_what_is_allowed(settings, words):
    with pytest.raises(UserError, match=words):
        sources.real_parameters(settings, SPACE)


def surrogate(**changes) -> sources.Surrogate:
    fields = dict(
        env=None, space=SPACE, weights=np.array([0.25, 0.75]), means=np.array([[0.5, 0.5, 0.5], [1.5, 1.0, 0.5]]),
        sds=np.full((2, 3), 0.05), policy_name="policy_random", length=5, noise=0.0, summarizer=lambda s, a: s,
    )  # fmt: skip
    return sources.Surrogate(**(fields | changes))


def test_stds_are_standard_deviations():
    """BayesSimIG used them as variances: 0.05 would have meant 0.22."""
    samples = np.asarray(surrogate().sample(jax.random.PRNGKey(0), 4000))
    heavy = samples[samples[:, 0] > 1.0]
    assert heavy[:, 0].std() == pytest.approx(0.05, rel=0.1)
    assert len(heavy) / len(samples) == pytest.approx(0.75, abs=0.03)


def test_the_truth_is_the_heaviest_component():
    np.testing.assert_allclose(surrogate().truth, [1.5, 1.0, 0.5])


def test_what_is_scored_is_what_the_real_trajectories_were_made_with():
    """Parameters vary between real trajectories; the posterior of a few can be sharper than that."""
    keys, one = list(jax.random.split(jax.random.PRNGKey(3), 3)), surrogate(sds=np.full((2, 3), 0.2))
    made = np.concatenate([np.asarray(one.sample(jax.random.split(key)[0], 8)) for key in keys])
    heavy = made[made[:, 0] > 1.0]  # the components are five deviations apart there
    assert 0 < len(heavy) < len(made)
    np.testing.assert_allclose(one.truth_of(keys, 8), heavy.mean(0), rtol=1e-6)
    none = next(k for k in jax.random.split(keys[0], 99) if one.sample(jax.random.split(k)[0], 1)[0, 0] < 1)
    np.testing.assert_allclose(one.truth_of([none], 1), one.truth)


def test_the_trajectories_are_made_with_what_is_scored():
    settings = config.load("Pendulum", overrides=["env.realParams.stds=[[0.1]]"])
    source = loop.make(settings, make("Pendulum", config=settings)).source
    keys = list(jax.random.split(jax.random.PRNGKey(3), 2))
    made = np.concatenate([np.asarray(source.real(key, 0, 2, None)[1].theta) for key in keys])
    assert made.std(0).min() > 0.01
    np.testing.assert_allclose(source.truth_of(keys, 2), made.mean(0), rtol=1e-5)


def test_samples_stay_inside_the_box():
    samples = np.asarray(surrogate(sds=np.full((2, 3), 5.0)).sample(jax.random.PRNGKey(0), 1000))
    assert np.all(samples >= SPACE.low) and np.all(samples <= SPACE.high)


@pytest.mark.slow
@pytest.mark.ci
def test_a_trajectory_measured_again_has_other_noise_and_nothing_else():
    settings = config.load("Pendulum", overrides=["bayessim.collectPolicy=policy_random", "bayessim.trainTrajLen=5"])
    source = loop.make(settings, make("Pendulum", config=settings)).source
    key, thetas = jax.random.PRNGKey(0), jnp.tile(source.truth, (200, 1))
    once = jax.jit(lambda k, t: source.simulate(k, t, None))(key, thetas)
    often = np.asarray(jax.jit(lambda k, t: source.measured(k, t, None, 3))(key, thetas))
    assert source.noisy and often.shape == (200, 3, once.shape[1])
    np.testing.assert_allclose(often[:, 0], once, atol=1e-5)
    spread = (often[:, 1:] - often[:, :1]).std((0, 1)) / np.sqrt(2)
    seen = np.array([not name.startswith("action") for name in source.channels.features("summary_start")])
    np.testing.assert_allclose(spread[spread > 0], source.noise, rtol=0.2)
    assert 0 < (spread > 0).sum() <= seen.sum()
    assert (
        np.abs(np.corrcoef((often[:, 1] - often[:, 0]).ravel(), (often[:, 2] - often[:, 0]).ravel())[0, 1] - 0.5) < 0.1
    )


def test_a_task_without_hidden_parameters_gets_them_from_the_seed():
    """In the middle half of the ranges; given ones stay, and so does a run on logs."""
    settings = config.replace(config.load("Pendulum"), env={"realParams": None})
    env = make("Pendulum")
    found = sources.with_surrogate(settings, env)
    assert config.from_dict(found.to_dict()) == found == sources.with_surrogate(settings, env)
    truth = loop.make(settings, env).source.truth
    low, high = np.asarray(env.space.low), np.asarray(env.space.high)
    assert (truth > low + 0.25 * (high - low)).all() and (truth < high - 0.25 * (high - low)).all()
    other = sources.with_surrogate(config.replace(settings, seed=1), env)
    assert other.env.realParams != found.env.realParams
    assert sources.with_surrogate(found, env) is found
    on_logs = config.replace(settings, real={"logs": "somewhere"})
    assert sources.with_surrogate(on_logs, env) is on_logs
