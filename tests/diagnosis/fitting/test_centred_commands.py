"""Centred by the physics, commands are what windows would have centred; a rate limit acts on what was sent."""

import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.diagnosis.fitting.simulator import Simulator, physics_of
from bayessim_mjx.effects import make
from tests.diagnosis.pendulums import PERIOD, nominal, recorded

LENGTH, LIMIT = 10, 4


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return nominal(tmp_path_factory.mktemp("robot"))


def errors(physics, logs, theta=None, **more):
    cut = windows.cut(logs, physics.mj_model, PERIOD, physics.substeps, LENGTH, limit=LIMIT, use_qvel=False, **more)
    theta = physics.space.nominal if theta is None else theta
    return Simulator(physics, cut, lanes=LIMIT).run(theta[None])[0, ..., :1]


@pytest.mark.slow
@pytest.mark.ci
def test_without_effects_both_ways_agree(robot):
    logs = recorded(count=2, seconds=2.0)
    by_windows = errors(robot.physics(PERIOD, ()), logs)
    by_physics = errors(physics_of(robot, PERIOD, []), logs, centred=False)
    np.testing.assert_allclose(by_physics, by_windows, atol=2e-6)
    plain = errors(robot.physics(PERIOD, ()), logs, centred=False)
    assert np.abs(plain - by_windows).max() > 20e-6  # half a sub-step does matter


def test_a_limited_command_is_centred_after_the_limit(robot):
    physics = physics_of(robot, PERIOD, [make("rate_limit", where="motor")])
    limit, centred = physics.effects
    command = jnp.array([[0.0], [1.0], [1.0], [1.0]])
    slow = jnp.array([1.5 * physics.mj_model.opt.timestep])  # s per unit: a step of 1 takes 1.5 sub-steps
    at, last = physics.sites
    memory, _ = limit.on_command(at, limit.init(at), command[:1], slow)
    _, limited = limit.on_command(at, memory, command, slow)
    memory, _ = centred.on_command(last, centred.init(last), command[:1], slow[:0])
    _, seen = centred.on_command(last, memory, limited, slow[:0])
    # means of the ramp over each sub-step: 0, 1/3, 11/12, 1; then means of neighbours
    np.testing.assert_allclose(limited[:, 0], [0, 1 / 3, 11 / 12, 1], atol=1e-6)
    np.testing.assert_allclose(seen[:, 0], [0, 1 / 6, 15 / 24, 23 / 24], atol=1e-6)
