"""ServoPendulum: a Dynamixel XL330 servo with 0.49 kg on a 0.10 m arm; move it to an angle and keep it there.

The rig of Rhoban's BAM (Duclusaud et al., ICRA 2025, arXiv 2410.08650), whose logs `examples/adapt_servo.py` adapts to.
The command is the motor voltage: torque = kt/R V - (kt^2/R + viscous) w - Coulomb friction. The angle is 0 hanging.
"""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco

from bayessim_mjx.env import Observations, Task
from bayessim_mjx.frames import wrap
from bayessim_mjx.mirrors import Mirror
from bayessim_mjx.physics import World, mjx
from bayessim_mjx.tasks._terms import told

VOLTAGE = 7.4  # V, supply of the rig; command = duty * VOLTAGE
# Nominal motor: the data sheet's stall (0.52 N m, 1.47 A at 5 V): kt = 0.354 N m/A, R = 3.40 Ohm; the rest is a guess.
TORQUE_CONSTANT, RESISTANCE = 0.354, 3.40
GAIN = TORQUE_CONSTANT / RESISTANCE  # N m/V
DAMPING = TORQUE_CONSTANT**2 / RESISTANCE + 0.005  # N m s/rad, back-EMF and viscous friction
ARMATURE = 0.002  # kg m^2, rotor inertia seen at the output
COULOMB = 0.05  # N m

# Fewer line-search iterations leave the solver unconverged where Coulomb friction sets in: the arm creeps.
# The weight is nearly a point (its own inertia is 1 % of m l^2); the arm weighs nothing.
XML = f"""
<mujoco model="servo_pendulum">
  <compiler autolimits="true"/>
  <option timestep="0.0025" integrator="Euler" iterations="6" ls_iterations="20">
    <flag contact="disable"/>
  </option>
  <visual>
    <headlight ambient="0.4 0.4 0.4" diffuse="0.25 0.25 0.25" specular="0 0 0"/>
  </visual>
  <worldbody>
    <light type="directional" pos="0 -1 1" dir="0.3 1 -1" diffuse="0.45 0.45 0.45" castshadow="false"/>
    <camera name="side" pos="0 -0.42 0" xyaxes="1 0 0 0 0 1"/>
    <geom name="housing" type="box" size="0.012 0.013 0.017" pos="0 0.02 0" rgba="0.2 0.2 0.2 1" contype="0"
          conaffinity="0"/>
    <body name="load">
      <inertial mass="0.49" pos="0 0 -0.1" diaginertia="5e-5 5e-5 5e-5"/>
      <joint name="servo" type="hinge" axis="0 -1 0" damping="{DAMPING:.6g}" armature="{ARMATURE:g}"
             frictionloss="{COULOMB:g}" solreffriction="0.006 1"/>
      <geom name="arm" type="capsule" fromto="0 0 0 0 0 -0.1" size="0.004" rgba="0.7 0.7 0.7 1" contype="0"
            conaffinity="0" mass="0"/>
      <geom name="weight" type="cylinder" fromto="0 -0.01 -0.1 0 0.01 -0.1" size="0.03" rgba="0.75 0.3 0.25 1"
            contype="0" conaffinity="0" mass="0"/>
    </body>
  </worldbody>
  <actuator>
    <general name="motor" joint="servo" gainprm="{GAIN:.6g}" ctrlrange="-{VOLTAGE} {VOLTAGE}"/>
  </actuator>
</mujoco>
"""


class ServoPendulum(Task):
    """Observation: cos, sin of the angle, speed / 10, cos and sin of (target - angle); action: voltage / 7.4 V.

    Reward per step, at most 1, with e = target - angle, speed w and action a:
    0.25 (1 + cos e) + 0.5 exp(-(e / 0.1)^2) - 0.02 (w / 10)^2 - 0.01 a^2.
    The target is uniform in +-`target` rad and stays for the episode (200 steps = 1 s); nothing ends it early.

    Without a torque sensor only ratios are observable: all five parameters times one number move alike. The weighed
    mass (a Gaussian prior) sets the scale.
    """

    control_dt: ClassVar[float] = 0.005
    default_episode_length: ClassVar[int] = 200
    options: ClassVar[dict[str, Any]] = {"target": 1.2}
    diverged_reward: ClassVar[float] = 0.0
    observation_names: ClassVar[tuple[str, ...]] = ("cos_q", "sin_q", "speed", "cos_error", "sin_error")
    mirror = (
        Mirror(
            joints={"servo": "-servo"},
            observations={"sin_q": "-sin_q", "speed": "-speed", "sin_error": "-sin_error"},
            task=("target",),
        ),
    )

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_string(XML)

    def initial(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        angle, speed = jax.random.uniform(key, (2, 1), minval=-1.0) * jnp.array([[1.2], [1.0]])
        return angle, speed

    def start(self, key: jax.Array, world: World) -> dict[str, Any]:
        reach = self.settings["target"]
        return {"target": jax.random.uniform(key, (), minval=-reach, maxval=reach)}

    def command(self, action: jax.Array) -> jax.Array:
        return VOLTAGE * action

    def observe(self, world: World, data: mjx.Data, action: jax.Array) -> Observations:
        angle, speed = world.measurement["qpos"], world.measurement["qvel"]
        error = world.task["target"] - angle
        parts = [jnp.cos(angle), jnp.sin(angle), speed / 10.0, jnp.cos(error), jnp.sin(error)]
        return {"policy": jnp.concatenate(parts)}

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        error, speed = after.task["target"] - after.qpos[0], after.qvel[0]
        near = jnp.exp(-((wrap(error) / 0.1) ** 2))
        # 0.25 (1 + cos e) + 0.5 exp(-(e/0.1)^2) - 0.02 (w/10)^2 - 0.01 a^2
        reward = 0.25 * (1.0 + jnp.cos(error)) + 0.5 * near - 0.02 * (speed / 10.0) ** 2 - 0.01 * action[0] ** 2
        parts = {"towards": 0.25 * (1.0 + jnp.cos(error)), "near": 0.5 * near}
        parts |= {"speed": -0.02 * (speed / 10.0) ** 2, "action": -0.01 * action[0] ** 2}
        return reward, jnp.zeros((), bool), {"error": jnp.abs(wrap(error)), "near": near} | told(parts)
