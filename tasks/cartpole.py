"""Cartpole: balance a pole hinged on the side of a cart (IsaacGymEnvs' Cartpole).

Nothing can touch anything, so contacts are off; friction, restitution and the slider's mass have no effect on the
motion and stay unidentifiable, as in BayesSimIG. Joint damping is integrated implicitly (Euler with eulerdamp).
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco

from bayessim_mjx.env import Observations, Task
from bayessim_mjx.mirrors import Mirror
from bayessim_mjx.physics import World, mjx
from bayessim_mjx.tasks._terms import told

# The URDF gives no inertias: those of the boxes. The slide limit of +-4 m lies outside |x| > 3 and is left out.
XML = """
<mujoco model="cartpole">
  <compiler autolimits="true"/>
  <option timestep="0.008333333333333333" integrator="Euler" iterations="1" ls_iterations="4">
    <flag contact="disable"/>
  </option>
  <visual>
    <headlight ambient="0.4 0.4 0.4" diffuse="0.25 0.25 0.25" specular="0 0 0"/>
  </visual>
  <default>
    <geom type="box" contype="0" conaffinity="0"/>
  </default>
  <worldbody>
    <light type="directional" pos="3 0 4" dir="-1 0.3 -1" diffuse="0.45 0.45 0.45" castshadow="false"/>
    <body name="slider" pos="0 0 2">
      <inertial mass="1" pos="0 0 0" diaginertia="5.3334 0.00015 5.3334"/>
      <geom name="slider" size="0.015 4 0.015" rgba="0.6 0.6 0.6 1"/>
      <replicate count="17" offset="0 0.5 0">
        <site name="mark" type="box" pos="0 -4 0" size="0.016 0.012 0.05" rgba="0.3 0.3 0.3 1"/>
      </replicate>
      <site name="middle" type="box" size="0.017 0.016 0.08" rgba="0.75 0.2 0.15 1"/>
      <body name="cart">
        <inertial mass="1" pos="0 0 0" diaginertia="0.00854 0.00667 0.00854"/>
        <joint name="slider_to_cart" type="slide" axis="0 1 0"/>
        <camera name="side" mode="track" pos="3.2 0 0.35" xyaxes="0 1 0 0 0 1"/>
        <geom name="cart" size="0.1 0.125 0.1" rgba="0.2 0.4 0.8 1"/>
        <body name="pole" pos="0.12 0 0">
          <inertial mass="1" pos="0 0 0.47" diaginertia="0.0836 0.0835 0.00043"/>
          <joint name="cart_to_pole" type="hinge" axis="1 0 0"/>
          <geom name="pole" pos="0 0 0.47" size="0.02 0.03 0.5" rgba="0.9 0.6 0.2 1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="slider_to_cart" joint="slider_to_cart" ctrlrange="-400 400" forcerange="-1000 1000"/>
  </actuator>
</mujoco>
"""
MAX_FORCE = 400.0  # N


class Cartpole(Task):
    """Observation: cart position and velocity, pole angle (0 upright) and velocity; action: force / 400 N."""

    control_dt: ClassVar[float] = 1 / 60
    default_episode_length: ClassVar[int] = 500
    diverged_reward: ClassVar[float] = -2.0
    options: ClassVar[dict] = {"resetDist": 3.0}
    observation_names: ClassVar[tuple[str, ...]] = ("cart_position", "cart_velocity", "pole_angle", "pole_velocity")
    mirror = (
        Mirror(
            joints={"slider_to_cart": "-slider_to_cart", "cart_to_pole": "-cart_to_pole"},
            observations={name: f"-{name}" for name in observation_names},
        ),
    )

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_string(XML)

    def initial(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        sample = jax.random.uniform(key, (2, 2), minval=-1.0)
        return 0.1 * sample[0], 0.25 * sample[1]

    def command(self, action: jax.Array) -> jax.Array:
        return MAX_FORCE * action

    def observe(self, world: World, data: mjx.Data, action: jax.Array) -> Observations:
        (x, angle), (speed, spin) = world.measurement["qpos"], world.measurement["qvel"]
        return {"policy": jnp.stack([x, speed, angle, spin])}

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        (x, angle), (speed, spin) = after.qpos, after.qvel
        fallen = (jnp.abs(x) > self.settings["resetDist"]) | (jnp.abs(angle) > jnp.pi / 2)
        # 1 - theta^2 - 0.01 |x_dot| - 0.005 |theta_dot|, and -2 at the end
        reward = 1.0 - angle**2 - 0.01 * jnp.abs(speed) - 0.005 * jnp.abs(spin)
        parts = {"alive": 1.0, "angle": -(angle**2), "speed": -0.01 * jnp.abs(speed), "spin": -0.005 * jnp.abs(spin)}
        return jnp.where(fallen, -2.0, reward), fallen, {"pole_angle": jnp.abs(angle)} | told(parts, fallen, -2.0)
