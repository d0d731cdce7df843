"""What walking robots see and what they are paid for: blocks of observations and parts of rewards, by name."""

import functools
from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.env import Task
from bayessim_mjx.errors import UserError
from bayessim_mjx.physics import World, mjx
from bayessim_mjx.tasks import _running

WIDTH = 0.25  # of the rewards for following commands, m^2/s^2 and rad^2/s^2


class View(NamedTuple):
    """What blocks of observations and parts of rewards are made of.

    Attributes:
        world: the world; its `task` has the commands.
        qpos, qvel: the state `[nq]`, `[nv]`: as sensors show it in observations, as it is in rewards.
        turn: axes of the base as columns `[3, 3]`, by qpos.
        data: of the step's last timestep.
        action: `[nu]`.
        start: qpos at the beginning of the step (in observations: at its end).
    """

    world: World
    qpos: jax.Array
    qvel: jax.Array
    turn: jax.Array
    data: mjx.Data
    action: jax.Array
    start: jax.Array

    @property
    def velocity(self) -> jax.Array:
        """Of the base, in its own axes `[3]`, m/s."""
        return self.turn.T @ self.qvel[:3]

    @property
    def turning(self) -> jax.Array:
        """Of the base, about its own axes `[3]`, rad/s."""
        return self.qvel[3:6]  # MuJoCo has a free joint's angular velocity in them already

    def asked(self, command: str) -> jax.Array:
        """Return this command, m/s or rad/s; 0 where the task has none."""
        return self.world.task.get(command, jnp.zeros(()))


class Parts(Task):
    """A task with a floating base whose observations and rewards are put together; see `locomotion.Locomotion`."""

    commands: ClassVar[Mapping[str, float]] = {}
    home: ClassVar[Mapping[str, float]] = {}
    feet: ClassVar[Sequence[str]] = ()

    @functools.cached_property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints behind the floating base."""
        model = self.mj_model
        floats = model.njnt > 0 and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
        if not floats or model.nq != model.njnt + 6:
            raise UserError(f"{self.name}: the first joint has to be a <freejoint>, all others hinges or slides")
        return tuple(model.joint(i).name for i in range(1, model.njnt))

    @functools.cached_property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper ends `[nq - 7]` of the joints; infinite where there are none."""
        given, (low, high) = self.mj_model.jnt_limited[1:].astype(bool), self.mj_model.jnt_range[1:].T
        return np.where(given, low, -np.inf).astype(np.float32), np.where(given, high, np.inf).astype(np.float32)

    @functools.cached_property
    def home_joints(self) -> np.ndarray:
        """Places `[nq - 7]` of the joints at home, rad or m."""
        if unknown := sorted(set(self.home) - set(self.joints)):
            known = ", ".join(self.joints)
            raise UserError(f"{self.name}: home names the joint {unknown[0]!r}; there are: {known}")
        return np.clip(np.array([self.home.get(name, 0.0) for name in self.joints], np.float32), *self.limits)

    def scaled_joints(self, qpos: jax.Array) -> jax.Array:
        """Joint positions `[nq - 7]`, -1 at the lower and 1 at the upper limit; all joints need limits."""
        low, high = self.limits
        return (2 * qpos[7:] - high - low) / (high - low)

    def observe_height(self, view: View) -> jax.Array:
        """Of the base, m."""
        return view.qpos[2:3]

    def observe_velocity(self, view: View) -> jax.Array:
        """Of the base in its own axes, m/s."""
        return view.velocity

    def observe_turning(self, view: View) -> jax.Array:
        """Of the base in its own axes, rad/s."""
        return view.turning

    def observe_gravity(self, view: View) -> jax.Array:
        """Which way is down: a unit vector in the base's axes."""
        return -view.turn[2]

    def observe_heading(self, view: View) -> jax.Array:
        """Yaw, roll and the angle to a target far away along +x (rad); cosines of the tilt and of that angle."""
        return _running.heading(view.qpos)

    def observe_commands(self, view: View) -> jax.Array:
        """As drawn at reset, m/s and rad/s."""
        return jnp.stack([view.asked(name) for name in self.commands])

    def observe_joints(self, view: View) -> jax.Array:
        """From home, rad or m."""
        return view.qpos[7:] - self.home_joints

    def observe_scaled_joints(self, view: View) -> jax.Array:
        """From -1 to 1 between their limits."""
        return self.scaled_joints(view.qpos)

    def observe_joint_speeds(self, view: View) -> jax.Array:
        """Of the joints, rad/s or m/s."""
        return view.qvel[6:]

    def observe_joint_forces(self, view: View) -> jax.Array:
        """Of motors, springs and dampers, N m or N."""
        return (view.data.qfrc_actuator + view.data.qfrc_passive)[6:]

    def observe_foot_loads(self, view: View) -> jax.Array:
        """Force and torque of the contacts of each foot, in its axes, N and N m."""
        return _running.foot_loads(self.sys, self.mj_model, view.data, self.feet)

    def observe_actions(self, view: View) -> jax.Array:
        """Actions of the last step."""
        return view.action

    def reward_alive(self, view: View) -> jax.Array:
        """1 in every step."""
        return jnp.ones(())

    def reward_progress(self, view: View) -> jax.Array:
        """Speed towards a target far away along +x, m/s."""
        return _running.approach(view.start, view.qpos) / self.dt

    def reward_posture(self, view: View) -> jax.Array:
        """0.1 for standing upright and up to 0.5 for facing +x."""
        return _running.posture_reward(*_running.posture(view.qpos))

    def reward_upright(self, view: View) -> jax.Array:
        """Cosine of the tilt."""
        return view.turn[2, 2]

    def reward_velocity(self, view: View) -> jax.Array:
        """1 where the base moves as command_x and command_y say, falling off with the squared error."""
        error = (view.asked("command_x") - view.velocity[0]) ** 2 + (view.asked("command_y") - view.velocity[1]) ** 2
        return jnp.exp(-error / WIDTH)

    def reward_turning(self, view: View) -> jax.Array:
        """1 where the base turns as command_yaw says, falling off with the squared error."""
        return jnp.exp(-((view.asked("command_yaw") - view.turning[2]) ** 2) / WIDTH)

    def reward_torques(self, view: View) -> jax.Array:
        """Sum of squares of the actuators' forces on joints."""
        return jnp.sum(view.data.qfrc_actuator[6:] ** 2)

    def reward_power(self, view: View) -> jax.Array:
        """Sum of what each joint's actuators put in or take out, W."""
        return jnp.sum(jnp.abs(view.data.qfrc_actuator * view.qvel)[6:])

    def reward_actions(self, view: View) -> jax.Array:
        """Sum of squares."""
        return jnp.sum(view.action**2)

    def reward_bounce(self, view: View) -> jax.Array:
        """Square of the base's vertical speed, m^2/s^2."""
        return view.qvel[2] ** 2

    def reward_wobble(self, view: View) -> jax.Array:
        """Square of the base's turning about its horizontal axes, rad^2/s^2."""
        return jnp.sum(view.turning[:2] ** 2)
