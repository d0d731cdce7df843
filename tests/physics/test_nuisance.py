"""Noise, gravity, schedules and the frequency of new parameters, against formulas and by hand."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import registry, rl
from bayessim_mjx.config import PPOConfig, from_dict
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.parameters.parameter import OVER, Schedule
from bayessim_mjx.physics import nuisance
from bayessim_mjx.rl import worlds
from bayessim_mjx.rl.recurrent import remembering
from bayessim_mjx.rollout import collect, rollout

WORLDS, STEPS = 2000, 40
SPEED = 8.0  # the pendulum's limit


def section(**keys: Any) -> dict:
    """`task:` with the pendulum's two parameters and more."""
    params = from_dict({"task_name": "Pendulum"}).to_dict()["task"]["randomization_params"]
    return {"randomize": True, "randomization_params": {**params, **keys}}


def pendulum(episode: int = 1000, **keys: Any) -> Any:
    config = from_dict({"task_name": "Pendulum", "env": {"episodeLength": episode}, "task": section(**keys)})
    return registry.make("Pendulum", config=config)


def noise(spread: list, lasting: list | None = None, kind: str = "gaussian", operation: str = "additive", **more: Any):
    correlated = {} if lasting is None else {"range_correlated": lasting}
    return {"range": spread, **correlated, "distribution": kind, "operation": operation, **more}


# (noise, mean and sd of the white part, mean and sd of the lasting one)
E = np.exp(1.0)
NOISES = {
    "gaussian": (noise([0.1, 0.2], [0.3, 0.5]), (0.1, 0.2), (0.3, 0.5)),
    "uniform": (noise([-1, 2], [1, 3], "uniform"), (0.5, 3 / 12**0.5), (2.0, 2 / 12**0.5)),
    "loguniform": (
        noise([1, float(E)], None, "loguniform"), (E - 1, (0.5 * (E**2 - 1) - (E - 1) ** 2) ** 0.5), (0.0, 0.0)
    ),
}  # fmt: skip


def test_distributions_have_the_moments_that_their_numbers_say() -> None:
    """d = white + lasting; x + s d, or x (1 + s (d - 1)), with s = 1 or, a quarter up the ramp, 1/4."""
    ramps = {k: v[0] | {"schedule": "linear", "schedule_steps": 100} for k, v in NOISES.items()}
    made = {
        (kind, operation): nuisance._noise({**ramps[kind], "operation": operation}, "w")
        for kind in NOISES
        for operation in ("additive", "scaling")
    }

    @jax.jit
    def draw(key: jax.Array) -> dict:
        def one(n: nuisance.Noise, key: jax.Array, clock: int) -> jax.Array:
            own, rest = jax.random.split(key)
            bias = n.bias(own, (3,))
            steps = jax.random.split(rest, STEPS)
            return jax.vmap(lambda k: n.apply(k, jnp.full(3, 2.0), bias, jnp.int32(clock)))(steps)

        keys = jax.random.split(key, WORLDS)
        return {
            (label, clock): jax.vmap(lambda k, n=n, clock=clock: one(n, k, clock))(keys)
            for label, n in made.items()
            for clock in (25, 100)
        }

    for ((kind, operation), clock), y in draw(jax.random.PRNGKey(0)).items():
        _, (mean, sd), (bias, spread) = NOISES[kind]
        s = min(clock / 100, 1.0)
        factor = s if operation == "additive" else 2.0 * s
        centre = 2.0 + s * (mean + bias) if operation == "additive" else 2.0 * (1 + s * (mean + bias - 1))
        y = np.asarray(y)  # [worlds, steps, 3]
        per_world = y.mean(1)
        assert per_world.mean() == pytest.approx(centre, abs=5 * factor * np.hypot(spread, sd / STEPS**0.5) / 6000**0.5)
        assert (y - per_world[:, None]).std() * (STEPS / (STEPS - 1)) ** 0.5 == pytest.approx(factor * sd, rel=0.02)
        assert per_world.std() == pytest.approx(factor * np.hypot(spread, sd / STEPS**0.5), rel=0.04)
        if kind == "uniform" and operation == "additive" and clock == 100:
            assert y.min() >= 2.0 and y.max() <= 2.0 + 2 + 3  # white in [-1, 2], lasting in [1, 3]


@functools.cache
def noisy() -> Any:
    return pendulum(
        observations=noise([0.0, 0.2], [0.0, 0.5]),
        actions=noise([0.1, 0.05], [0.0, 0.1]),
        sim_params={"gravity": noise([0.0, 0.4])},
    )


@functools.cache
def run() -> tuple[Any, Any]:
    """(trajectory of WORLDS worlds with the action .2, states at reset)."""
    env, key = noisy(), jax.random.PRNGKey(3)
    thetas = jnp.tile(jnp.asarray(env.space.nominal), (WORLDS, 1))
    trajectory = rollout(env, lambda key, obs: jnp.full((1,), 0.2), key, thetas, 6)
    start = jax.jit(jax.vmap(env.reset))(jax.random.split(key, WORLDS), thetas)
    return jax.tree.map(np.asarray, trajectory), jax.tree.map(np.asarray, start)


def truth(qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    return np.concatenate([np.cos(qpos), np.sin(qpos), qvel], -1)


@pytest.mark.slow
@pytest.mark.ci
def test_observations_are_the_truth_with_white_and_lasting_noise_from_the_reset_on() -> None:
    trajectory, start = run()
    error = trajectory.observation - truth(trajectory.qpos, trajectory.qvel)  # [worlds, 7, 3]
    assert (error - error.mean(1, keepdims=True)).std() * (7 / 6) ** 0.5 == pytest.approx(0.2, rel=0.03)
    assert np.corrcoef(error[:, 0, 0], error[:, -1, 0])[0, 1] == pytest.approx(0.25 / 0.29, abs=0.03)
    assert np.abs(np.corrcoef(error[:, 0].T) - np.eye(3)).max() < 0.1  # each channel has its own
    world = start.pipeline_state
    at_reset = start.obs["policy"] - truth(world.qpos, world.qvel)
    assert at_reset.std() == pytest.approx(0.29**0.5, rel=0.03)
    assert np.array_equal(start.obs["policy"], start.info["final_observation"]["policy"])


@pytest.mark.slow
@pytest.mark.ci
def test_actions_get_noise_that_is_not_in_the_recorded_command() -> None:
    """u from the motion: w' = w + dt (3 / (2 l) (gx cos q - gz sin q) + 3 u / (m l^2)); u = 2 (.2 + noise)."""
    trajectory, start = run()
    assert np.all(trajectory.command == np.float32(0.4))
    gravity = gravities()
    q, w = trajectory.qpos[..., 0], trajectory.qvel[..., 0]
    pull = 1.5 * (gravity[:, None, 0] * np.cos(q) - gravity[:, None, 2] * np.sin(q))[:, :-1]
    u = ((w[:, 1:] - w[:, :-1]) / 0.05 - pull) / 3
    free = (np.abs(w[:, 1:]) < SPEED - 0.1) & (np.abs(w[:, :-1]) < SPEED - 0.1)
    added = np.where(free, u / 2 - 0.2, np.nan)
    kept = added[free.all(1)]
    assert len(kept) > WORLDS / 2
    assert kept.mean() == pytest.approx(0.1, abs=0.01)
    assert (kept - kept.mean(1, keepdims=True)).std() * (6 / 5) ** 0.5 == pytest.approx(0.05, rel=0.05)
    assert kept.mean(1).std() == pytest.approx(np.hypot(0.1, 0.05 / 6**0.5), rel=0.05)


@functools.cache
def gravities() -> np.ndarray:
    """Gravity in the worlds of `run`: the rollout resets them with the first half of its key."""
    env = noisy()
    keys = jax.random.split(jax.random.split(jax.random.PRNGKey(3))[0], WORLDS)
    thetas = jnp.tile(jnp.asarray(env.space.nominal), (WORLDS, 1))
    return np.asarray(jax.jit(jax.vmap(env.reset))(keys, thetas).pipeline_state.fields["opt.gravity"])


def test_gravity_is_drawn_on_every_axis() -> None:
    gravity = gravities()
    assert gravity.mean(0) == pytest.approx([0, 0, -10], abs=0.05)
    assert gravity.std(0) == pytest.approx([0.4] * 3, rel=0.05)


def test_schedules_by_hand() -> None:
    clock = jnp.arange(6)
    assert Schedule("linear", 4).strength(clock).tolist() == [0, 0.25, 0.5, 0.75, 1, 1]
    assert Schedule("constant", 4).strength(clock).tolist() == [0, 0, 0, 0, 1, 1]
    assert Schedule().strength(clock).tolist() == [1] * 6


SMALL = PPOConfig(
    num_envs=32, num_steps=5, num_epochs=1, num_minibatches=1, hidden_actor=(4,), hidden_critic=(4,), log_interval=1
)


def ramped(**more: Any) -> Any:
    """The mass ramps up over 20 steps, episodes last 3."""
    keys = section()["randomization_params"]["actor_params"]
    keys["pendulum"]["rigid_body_properties"]["mass"] |= {"schedule": "linear", "schedule_steps": 20}
    return pendulum(3, actor_params=keys, **more)


@pytest.mark.slow
def test_training_draws_parameters_wider_and_wider() -> None:
    """theta = 1 + min(clock / 20, 1) (draw - 1)."""
    env = ramped()
    domain, key = Distribution.prior(env.space, 1), jax.random.PRNGKey(0)
    draw = jax.jit(lambda clock: worlds.reset(env, key, domain, 32, clock=clock))
    full = np.asarray(draw(OVER).pipeline_state.theta)
    assert np.ptp(full[:, 0]) > 1.5
    for clock, s in ((0, 0.0), (5, 0.25), (19, 0.95), (20, 1.0)):
        state = draw(clock)
        np.testing.assert_allclose(state.pipeline_state.theta[:, 0], 1 + s * (full[:, 0] - 1), rtol=1e-6)
        assert np.array_equal(state.pipeline_state.theta[:, 1], full[:, 1])  # the length has no schedule
        assert np.all(state.info["nuisance"].course.clock == clock)
    assert draw._cache_size() == 1  # clocks are arguments
    plain = jax.jit(jax.vmap(env.reset))(jax.random.split(key, 32), full)
    assert np.array_equal(plain.pipeline_state.theta, full)  # inference and evaluation see the whole prior


@pytest.mark.slow
@pytest.mark.parametrize("wrapped", [False, pytest.param(True, marks=pytest.mark.ci)])
def test_updates_carry_the_clock_on(wrapped: bool) -> None:
    """Over episodes, updates and policies that begin later; the pool of resets is drawn at its update's clock.

    Also with parameters that last, a memory and a critic that sees theta.
    """
    env = remembering(ramped(frequency=4), 3) if wrapped else ramped()
    saved: Any = None
    config = dataclasses.replace(SMALL, memory=3, critic_theta=True) if wrapped else SMALL
    domain, key = Distribution.prior(env.space, 1), jax.random.PRNGKey(0)
    state, seen = rl.init(env, config, key, domain, clock=5), []
    assert np.ptp(state.env_states.pipeline_state.theta[:, 0]) < 0.5
    step = rl.make_update(env, config)
    for i in range(4):
        state, metrics = step(state, domain)
        seen.append(np.asarray(state.env_states.info["nuisance"].course.clock))
        saved = jax.tree.map(np.array, jax.device_get(state)) if i == 1 else saved
    assert np.array_equal(seen, np.repeat(np.arange(10, 26, 5)[:, None], 32, 1))
    assert step._cache_size() == 1 and np.isfinite(metrics["Loss/value"])
    assert np.ptp(state.env_states.pipeline_state.theta[:, 0]) > 1.5
    resumed = step(step(saved, domain)[0], domain)[0]  # as from a checkpoint
    assert jax.tree.all(jax.tree.map(lambda a, b: np.array_equal(a, b), state, resumed))


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize(("frequency", "draws"), [(1, [0, 4, 8, 12, 16, 20]), (8, [0, 8, 16]), (9, [0, 12])])
def test_new_parameters_come_at_the_first_reset_after_so_many_steps(frequency: int, draws: list[int]) -> None:
    """Episodes of 4 steps; parameters, gravity and lasting noise change together, at these steps only."""
    env = pendulum(
        4, frequency=frequency, observations=noise([0, 0.0], [0, 1.0]), sim_params={"gravity": noise([0, 1])}
    )
    thetas, gravity, bias, start = history(env)
    for values in (thetas, gravity, bias):
        changes = [0, *(1 + t for t in range(23) if np.abs(values[t] - values[t + 1]).max() > 1e-4)]
        assert changes == draws
        each = values[draws]  # [draws, worlds, .]
        assert len(np.unique(each.reshape(-1, each.shape[-1]), axis=0)) == each.shape[0] * each.shape[1]
    assert len(np.unique(start[::4], axis=0)) == 6  # episodes begin anew all the same


def history(env: Any) -> tuple[np.ndarray, ...]:
    """theta, gravity, bias and angle [24, 8, .] of 8 worlds that collect 24 steps, four in an update."""
    domain, zero = Distribution.prior(env.space, 1), jnp.zeros((8, 1))
    reset = lambda key, count: worlds.reset(env, key, domain, count)  # noqa: E731

    @jax.jit
    def updates(key: jax.Array) -> tuple:
        def one(state: Any, key: jax.Array) -> Any:
            seen = (
                state.pipeline_state.theta,
                state.pipeline_state.fields["opt.gravity"],
                state.info["nuisance"].observation,
            )
            draws = jnp.zeros((1,))
            after, _ = collect(env, lambda draw, obs: (zero, {}), draws, state, reset(key, 8))
            return after, (*seen, state.pipeline_state.qpos)

        return jax.lax.scan(one, reset(jax.random.fold_in(key, 1), 8), jax.random.split(key, 24))[1]

    return tuple(np.asarray(x) for x in updates(jax.random.PRNGKey(5)))


def test_nothing_is_drawn_where_nothing_is_asked_for() -> None:
    env = pendulum()
    assert env.nuisance is None and "nuisance" not in jax.eval_shape(env.reset, jax.random.PRNGKey(0)).info
    task = section(observations=noise([0, 1])) | {"randomize": False}
    off = registry.make("Pendulum", config=from_dict({"task_name": "Pendulum", "task": task}))
    assert off.nuisance is None  # nominal physics


BAD = {
    "observations: 3": ({"observations": 3}, r"params\.observations = 3: expected a section"),
    "range missing": ({"actions": {"operation": "additive"}}, r"actions\.range = None: a gaussian .* takes \[mean"),
    "negative sd": ({"actions": noise([0, -1])}, r"actions\.range = \[0, -1\]: the standard deviation is negative"),
    "loguniform 0": ({"actions": noise([0, 1], kind="loguniform")}, "loguniform needs low > 0"),
    "ends": ({"observations": noise([2, 1], kind="uniform")}, "low must not be more than high"),
    "word": ({"observations": noise([0, 1], kind="normal")}, r"observations\.distribution: 'normal' is none of"),
    "key": ({"observations": noise([0, 1], rnage=1)}, r"observations\.rnage: unknown key"),
    "operation": ({"actions": noise([0, 1], operation="absolute")}, "'absolute' is none of additive, scaling"),
    "schedule": ({"actions": noise([0, 1], schedule="step")}, r"actions\.schedule: 'step' is none of constant"),
    "steps": ({"actions": noise([0, 1], schedule="linear")}, "a linear schedule needs the number of steps"),
    "half a step": ({"actions": noise([0, 1], schedule_steps=1.5)}, "schedule_steps = 1.5: expected"),
    "frequency 0.5": ({"frequency": 0.5}, r"frequency = 0\.5: expected a whole number of control steps from 1"),
    "frequency inf": ({"frequency": float("inf")}, "is not finite"),
    "sim": ({"sim_params": {"gravty": noise([0, 1])}}, r"sim_params\.gravty: unknown key; did you mean gravity"),
    "gravity": ({"sim_params": {"gravity": noise([0, 1], [0, 1])}}, r"gravity\.range_correlated: unknown key"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_meant_is_refused_by_name(case: str) -> None:
    keys, words = BAD[case]
    with pytest.raises(UserError, match=words):
        nuisance.read(keys, ParameterSpace())
