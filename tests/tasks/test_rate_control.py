"""Commands that actions move at a rate: on a pendulum, whose torque is the command."""

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.rl import export
from bayessim_mjx.rollout import rollout
from bayessim_mjx.tasks._rate_control import RateControlled
from bayessim_mjx.tasks.pendulum import Pendulum


class Ramp(RateControlled, Pendulum):
    """The action moves the torque at up to 10 N m/s, within +-2 N m."""

    rates = (10.0,)

    def at_rest(self, qpos):
        return jnp.full(1, -0.5)


def test_a_rollout_records_the_commands_that_acted():
    env = Ramp({}, randomization={"randomize": False})
    motion = rollout(env, lambda key, obs: jnp.full(1, 7.0), jax.random.PRNGKey(0), jnp.zeros((2, 0)), 8)
    torque = [0.0, 0.5, 1.0, 1.5, 2.0, 2.0, 2.0, 2.0]
    np.testing.assert_allclose(motion.command[:, :, 0], [torque, torque], atol=1e-6)
    speed, angle = np.asarray(motion.qvel[0, :, 0]), np.asarray(motion.qpos[0, :, 0])
    change = 0.05 * (15 * np.sin(angle[:-1]) + 3 * np.array(torque))  # m = l = 1, g = 10
    np.testing.assert_allclose(speed[1:], np.clip(speed[:-1] + change, -8, 8), atol=1e-4)


def test_an_exported_policy_has_no_scale_of_commands_with_a_memory():
    assert export.command_scale(Ramp(), 1) is None
    assert export.command_scale(Pendulum(), 1)[0] == 2.0
