"""Quadcopter: a chassis with four tiltable rotors hovers at (0, 0, 1) (IsaacGymEnvs' Quadcopter).

Every rotor's mount turns about two axes, so that thrust points where the servos turn it; there is no drag, and rotors
exert no torque. Unlike the original: its drives (kp 1000 N m/rad, integrated implicitly) would explode in MuJoCo, so
kp is 5 N m/rad with kv 0.1 N m s/rad and an armature of 5e-4 kg m^2; joints have no limits of their own, as their
targets have; the largest angular velocity of 4 pi rad/s holds for each axis of the chassis; and the first action of
an episode counts, where the original's rotors are off and its joints held in that step. BayesSimIG's true masses are
too heavy to fly with: 18 N against 8 N of thrust.

The drives are integrated explicitly. They are stable at any mass (kv h / armature = 1), and implicitfast would factor
two matrices at once, which can wait for each other for ever in jaxlib's thread pool (see `linalg`).
"""

import math
from collections.abc import Sequence
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.env import Observations
from bayessim_mjx.physics import World, mjx
from bayessim_mjx.tasks._flight import MAX_SPIN, NAMES, flight, hovering, left_right
from bayessim_mjx.tasks._rate_control import RateControlled
from bayessim_mjx.tasks._scene import FLOOR, scene

ROTORS = range(4)  # at 45, 135, 225 and 315 degrees
JOINTS = tuple(f"rotor_{axis}{k}" for k in ROTORS for axis in ("pitch", "roll"))
TARGET = np.array([0.0, 0.0, 1.0], np.float32)  # m
MAX_DISTANCE, LOWEST = 3.0, 0.3  # m
RED, DARK = "0.85 0.30 0.25", "0.25 0.27 0.30"
TILT = math.pi / 6  # rad, largest target of the mounts' joints


def _rotor(k: int) -> str:
    angle = math.pi / 4 + k * math.pi / 2
    x, y = 0.1025 * math.cos(angle), 0.1025 * math.sin(angle)
    colour = RED if k in (0, 3) else DARK  # red is in front
    return f"""
      <geom name="boom{k}" type="capsule" fromto="0 0 0 {x:.9f} {y:.9f} 0" size="0.007" mass="0" rgba="{DARK} 1"/>
      <body name="rotor_arm{k}" pos="{x:.9f} {y:.9f} 0" euler="0 0 {math.degrees(angle):g}">
        <joint name="rotor_pitch{k}" axis="0 1 0"/>
        <geom name="rotor_arm{k}" type="sphere" size="0.01" density="200" rgba="0.6 0.6 0.6 1"/>
        <geom name="mount{k}" type="capsule" fromto="0 0 0 0.0425 0 0" size="0.004" mass="0" rgba="0.6 0.6 0.6 1"/>
        <body name="rotor{k}" pos="0.0425 0 0">
          <joint name="rotor_roll{k}" axis="1 0 0"/>
          <geom name="rotor{k}" type="cylinder" size="0.04 0.005" density="1000" rgba="{colour} 1"/>
          <geom name="hub{k}" type="cylinder" size="0.008 0.012" mass="0" rgba="0.15 0.15 0.15 1"/>
          <site name="thrust{k}"/>
        </body>
      </body>"""


XML = f"""
<mujoco model="quadcopter">
  <compiler angle="degree" autolimits="true"/>
  <option timestep="0.005" integrator="Euler" iterations="1" ls_iterations="4">
    <flag contact="disable" eulerdamp="disable"/>
  </option>{scene()}
  <default>
    <geom contype="0" conaffinity="0"/>
    <joint type="hinge" armature="0.0005"/>
    <default class="servo"> <position kp="5" kv="0.1" ctrlrange="{-TILT} {TILT}"/> </default>
    <default class="thrust"> <motor gear="0 0 1 0 0 0" ctrlrange="0 2"/> </default>
  </default>
  <worldbody>
    {FLOOR}
    <light type="directional" pos="1 -1.5 4" dir="-0.25 0.35 -1" diffuse="0.5 0.5 0.5" specular="0.1 0.1 0.1"/>
    <site name="target" pos="0 0 1" size="0.03" rgba="0.20 0.60 0.35 0.7"/>
    <body name="chassis" pos="0 0 1">
      <freejoint name="root"/>
      <camera name="track" mode="track" pos="0 -0.9 0.45" xyaxes="1 0 0 0 0.45 0.9"/>
      <geom name="chassis" type="cylinder" size="0.1 0.015" density="50" rgba="0.93 0.93 0.93 1"/>
      <geom name="nose" type="sphere" size="0.014" pos="0.09 0 0.012" mass="0" rgba="{RED} 1"/>
      {"".join(map(_rotor, ROTORS))}
    </body>
  </worldbody>
  <actuator>
    {"".join(f'<position class="servo" name="{joint}" joint="{joint}"/>' for joint in JOINTS)}
    {"".join(f'<motor class="thrust" name="thrust{k}" site="thrust{k}"/>' for k in ROTORS)}
  </actuator>
</mujoco>
"""


class Quadcopter(RateControlled):
    """21 observations: those of `_flight.flight`, then the eight joint angles (rad).

    Actions: rates of the joints' targets / (8 pi rad/s), within +-30 degrees; then of the thrusts / (200 N/s), within 0
    and 2 N.
    """

    control_dt: ClassVar[float] = 0.01
    default_episode_length: ClassVar[int] = 500
    rates: ClassVar[Sequence[float]] = (*(8 * math.pi,) * 8, *(200.0,) * 4)  # rad/s, N/s
    observation_clip: ClassVar[dict[str, float | None]] = {"isaacgymenvs": 5.0, "bayessim2021": 100.0}
    max_qvel: ClassVar[Sequence[float]] = (*(np.inf,) * 3, *(MAX_SPIN,) * 3, *(np.inf,) * 8)
    observation_names: ClassVar[tuple[str, ...]] = (*NAMES, *(f"{joint}_position" for joint in JOINTS))
    mirror = (
        left_right(
            {
                "rotor_pitch0": "rotor_pitch3",
                "rotor_pitch1": "rotor_pitch2",
                "rotor_roll0": "-rotor_roll3",
                "rotor_roll1": "-rotor_roll2",
            }
        ),
    )

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_string(XML)

    def initial(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        low = np.array([-1.5, -1.5, 0.8, *(-0.2,) * 8], np.float32)
        high = np.array([1.5, 1.5, 2.5, *(0.2,) * 8], np.float32)
        drawn = jax.random.uniform(key, (11,), minval=low, maxval=high)
        return jnp.concatenate([drawn[:3], jnp.array([1.0, 0.0, 0.0, 0.0]), drawn[3:]]), jnp.zeros(14)

    def at_rest(self, qpos: jax.Array) -> jax.Array:
        return jnp.concatenate([qpos[7:], jnp.zeros(4)])  # servos where they are, rotors off

    def observe(self, world: World, data: mjx.Data, action: jax.Array) -> Observations:
        qpos, qvel = world.measurement["qpos"], world.measurement["qvel"]
        return {"policy": jnp.concatenate([flight(TARGET, qpos, qvel), qpos[7:]])}

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        reward, distance, metrics = hovering(TARGET, after.qpos, after.qvel)
        lost = (distance > MAX_DISTANCE) | (after.qpos[2] < LOWEST)
        return reward, lost, metrics
