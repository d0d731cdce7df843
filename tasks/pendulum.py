"""Pendulum: swing up a uniform rod with a weak motor (BayesSimIG's PendulumB; gym's Pendulum-v1).

MuJoCo's semi-implicit Euler step of one hinge is the published update exactly:
theta_dd = 3 g / (2 l) sin(theta) + 3 u / (m l^2), velocity first, then position, then the velocity clipped to +-8.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco

from bayessim_mjx.env import Observations, Task
from bayessim_mjx.frames import wrap
from bayessim_mjx.mirrors import Mirror
from bayessim_mjx.physics import World, mjx
from bayessim_mjx.tasks._terms import told

# Rod of mass 1 kg and length 1 m: com at l/2, inertia m l^2 / 12 about it (and a negligible one along the rod).
XML = """
<mujoco model="pendulum">
  <compiler autolimits="true"/>
  <option timestep="0.05" gravity="0 0 -10" integrator="Euler" iterations="1" ls_iterations="4">
    <flag contact="disable" constraint="disable"/>
  </option>
  <visual>
    <headlight ambient="0.4 0.4 0.4" diffuse="0.25 0.25 0.25" specular="0 0 0"/>
  </visual>
  <worldbody>
    <light type="directional" pos="0 -2 3" dir="0.3 1 -1" diffuse="0.5 0.5 0.5" castshadow="false"/>
    <site name="axle" type="cylinder" fromto="0 -0.07 0 0 0.07 0" size="0.03" rgba="0.2 0.2 0.2 1"/>
    <body name="pendulum">
      <inertial mass="1" pos="0 0 0.5" diaginertia="0.08333333333 0.08333333333 1e-8"/>
      <joint name="hinge" type="hinge" axis="0 1 0" armature="0" damping="0"/>
      <geom name="pendulum" type="capsule" fromto="0 0 0 0 0 1" size="0.05" rgba="0.8 0.3 0.25 1" contype="0"
            conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="torque" joint="hinge" ctrlrange="-2 2"/>
  </actuator>
</mujoco>
"""
MAX_TORQUE = 2.0  # N m
MAX_SPEED = 8.0  # rad/s


class Pendulum(Task):
    """Observation: cos, sin, angular velocity; action: torque / 2 N m; the angle is 0 upright."""

    control_dt: ClassVar[float] = 0.05
    default_episode_length: ClassVar[int] = 200
    max_qvel: ClassVar[float | None] = MAX_SPEED
    diverged_reward: ClassVar[float] = -16.3
    observation_names: ClassVar[tuple[str, ...]] = ("cos_theta", "sin_theta", "theta_dot")
    mirror = (Mirror(joints={"hinge": "-hinge"}, observations={"sin_theta": "-sin_theta", "theta_dot": "-theta_dot"}),)

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_string(XML)

    def initial(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        angle, speed = jax.random.uniform(key, (2, 1), minval=-1.0) * jnp.array([[jnp.pi], [1.0]])
        return angle, speed

    def command(self, action: jax.Array) -> jax.Array:
        return MAX_TORQUE * action

    def observe(self, world: World, data: mjx.Data, action: jax.Array) -> Observations:
        angle, speed = world.measurement["qpos"], world.measurement["qvel"]
        return {"policy": jnp.concatenate([jnp.cos(angle), jnp.sin(angle), speed])}

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        # of the state before the step: -(angle^2 + 0.1 speed^2 + 0.001 u^2), angle in (-pi, pi]
        angle, speed, torque = wrap(before.qpos[0]), before.qvel[0], self.command(action)[0]
        reward = -(angle**2 + 0.1 * speed**2 + 0.001 * torque**2)
        parts = told({"angle": -(angle**2), "speed": -0.1 * speed**2, "torque": -0.001 * torque**2})
        return reward, jnp.zeros((), bool), {"upright": jnp.cos(angle)} | parts
