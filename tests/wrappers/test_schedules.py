"""Schedules of noise and parameters begin with training behind every wrapper that goes on from episode to episode."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import config, registry
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.wrappers import fresh
from bayessim_mjx.wrappers.fresh import Under
from bayessim_mjx.wrappers.gymnasium import GymnasiumEnv, GymnasiumVectorEnv
from bayessim_mjx.wrappers.worlds import Worlds

N, RAMP, LENGTH = 8, 20, 5
RAMPED = {"range": [0.5, 1.5], "operation": "scaling", "distribution": "uniform"}
RAMPED |= {"schedule": "linear", "schedule_steps": RAMP}


@pytest.fixture(scope="module")
def pendulum():
    """Its mass is drawn wider and wider, over 20 control steps; episodes last 5."""
    masses = {"pendulum": {"rigid_body_properties": {"mass": RAMPED}}}
    settings = config.load("Pendulum", overrides=[f"env.episodeLength={LENGTH}"])
    kind = type(registry.make("Pendulum"))
    return kind(settings.env, {"randomize": True, "randomization_params": {"actor_params": masses}})


def of_worlds(env, domain):
    worlds = Worlds(env, domain, N)
    worlds.reset()
    found = [worlds.theta]
    for _ in range(5 * LENGTH):
        worlds.step(jnp.zeros((N, 1)))
        found.append(worlds.theta)
    return found[::LENGTH]


def of_gymnasium(mode):
    def run(env, domain):
        vector, zero = GymnasiumVectorEnv(env, N, domain, autoreset_mode=mode), np.zeros((N, 1), np.float32)
        found = [vector.reset(seed=0)[1]["theta"]]
        for _ in range(5):
            for _ in range(LENGTH + (mode == "NextStep")):
                vector.step(zero)
            if mode == "Disabled":
                vector.reset(options={"reset_mask": np.ones(N, bool)})
            found.append(np.array(vector._state.pipeline_state.theta))
        return found

    return run


def of_one_world(env, domain):
    one, worlds = GymnasiumEnv(env, domain=domain), []
    for seed in range(N):
        one._state = None  # as a new environment, with its programs
        episodes = []
        for episode in range(6):
            one.reset(seed=None if episode else seed)
            episodes.append(np.array(one._state.pipeline_state.theta))
            for _ in range(LENGTH):
                one.step(np.zeros(1, np.float32))
        worlds.append(episodes)
    return np.swapaxes(worlds, 0, 1)


def of_brax(over):
    def run(env, domain):
        wrapped = fresh.wrap(Under(env, domain, over))
        state, step = jax.jit(wrapped.reset)(jax.random.split(jax.random.PRNGKey(0), N)), jax.jit(wrapped.step)
        found = [state.pipeline_state.theta]
        for _ in range(5):
            for _ in range(LENGTH):
                state = step(state, jnp.zeros((N, 1)))
            found.append(state.pipeline_state.theta)
        return found

    return run


WRAPPERS = {
    "worlds": of_worlds, "next": of_gymnasium("NextStep"), "same": of_gymnasium("SameStep"),
    "disabled": of_gymnasium("Disabled"), "one": of_one_world, "brax": of_brax(False),
}  # fmt: skip


@pytest.mark.parametrize("name", WRAPPERS)
def test_parameters_are_drawn_wider_from_episode_to_episode(name, pendulum):
    """All have the nominal mass, 1 kg, in the first one, and any from 0.5 to 1.5 kg once the ramp is over."""
    found = np.asarray(WRAPPERS[name](pendulum, Distribution.prior(pendulum.space, 1)))[..., 0]
    assert found.shape == (6, N)
    np.testing.assert_allclose(found[0], 1.0, rtol=1e-6)
    far, steps = np.abs(found - 1.0).max(1), LENGTH + (name == "next")  # whose worlds begin anew in a step of its own
    most = 0.5 * np.minimum(1.0, np.arange(6) * steps / RAMP)
    assert far[-1] > 0.2 and (far <= most + 1e-6).all()


def test_an_evaluation_by_brax_sees_the_whole_prior(pendulum):
    found = np.asarray(of_brax(True)(pendulum, Distribution.prior(pendulum.space, 1)))[..., 0]
    assert (np.abs(found - 1.0).max(1) > 0.2).all()
