"""BallBalance: a round tray on three legs keeps a dropped ball at its middle (IsaacGymEnvs' BallBalance).

The knees are driven, hips and pinned feet turn freely; the tray can rise and tilt. Unlike the original: its drives (kp
4000 N m/rad, kd 100) would explode in MuJoCo, so kp is 400 N m/rad, kv 20 N m s/rad, and joints have an armature of
0.05 kg m^2. The ball touches a square of 1 m instead of the disc in it, as MJX meets a ball and a box exactly. Feet are
held by constraints instead of springs. Isaac's joint friction is a share of the joint's load, MuJoCo's a torque: one
unit of BayesSimIG's range is 0.01 N m here. The damping that Isaac gives assets without one is unknown: there is none.
The first action of an episode counts; the original's targets are 0 in that step.

The drives are integrated explicitly: only so do the feet's constraints see their damping (feet slip 5 mm instead of 9
under random targets), and implicitfast would factor two matrices at once, which can wait for each other for ever in
jaxlib's thread pool (see `linalg`).
"""

import math
from collections.abc import Sequence
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.env import Observations
from bayessim_mjx.mirrors import Mirror
from bayessim_mjx.physics import World, mjx
from bayessim_mjx.physics.warp import wrenches
from bayessim_mjx.tasks._rate_control import RateControlled
from bayessim_mjx.tasks._scene import FLOOR, scene
from bayessim_mjx.tasks._terms import told

LEGS = range(3)  # at 0, 120 and 240 degrees
RADIUS, LENGTH = 0.4, 0.36  # m, of hips and feet about the middle; of a link
SIDE = LENGTH / math.sqrt(2)  # links stand at 45 degrees
HEIGHT = 0.02 + 2 * SIDE + 0.03  # m, of the tray's middle at rest: foot, two links, hip below the tray
BALL_RADIUS = 0.1  # m
AIM = np.array([0.0, 0.0, 0.7], np.float32)  # m, of the ball's centre
LOAD_SCALE = 1 / 20  # of forces and torques in observations


def _leg(k: int) -> str:
    angle = 2 * math.pi * k / 3
    x, y = RADIUS * math.cos(angle), RADIUS * math.sin(angle)
    return f"""
      <body name="upper{k}" pos="{x:.9f} {y:.9f} -0.03" euler="0 0 {120 * k}">
        <joint name="upper{k}" range="-45 45"/>
        <geom name="upper{k}" class="link" fromto="0 0 0 {-SIDE:.9f} 0 {-SIDE:.9f}" rgba="0.93 0.93 0.93 1"/>
        <body name="lower{k}" pos="{-SIDE:.9f} 0 {-SIDE:.9f}">
          <joint name="lower{k}" range="-70 90"/>
          <geom name="lower{k}" class="link" fromto="0 0 0 {SIDE:.9f} 0 {-SIDE:.9f}" rgba="0.25 0.27 0.30 1"/>
          <geom name="knee{k}" type="cylinder" fromto="0 -0.03 0 0 0.03 0" size="0.03" mass="0" rgba="0.85 0.3 0.25 1"/>
        </body>
      </body>"""


XML = f"""
<mujoco model="bbot">
  <compiler angle="degree" autolimits="true"/>
  <option timestep="0.005" integrator="Euler" solver="Newton" iterations="4" ls_iterations="8">
    <flag eulerdamp="disable"/>
  </option>
  {scene()}
  <asset>
    <texture name="ball" type="cube" builtin="checker" width="64" height="64" rgb1="0.9 0.6 0.1" rgb2="0.8 0.4 0.1"/>
    <material name="ball" texture="ball"/>
  </asset>
  <default>
    <geom contype="0" conaffinity="0"/>
    <joint type="hinge" axis="0 1 0" armature="0.05" frictionloss="0.001"/>
    <position kp="400" kv="20" inheritrange="1"/>
    <equality solref="0.01 1"/>
    <default class="link"> <geom type="capsule" size="0.02" density="1000"/> </default>
  </default>
  <worldbody>
    {FLOOR}
    <light type="directional" pos="1 -1.5 4" dir="-0.25 0.35 -1" diffuse="0.5 0.5 0.5" specular="0.1 0.1 0.1"/>
    <camera name="side" pos="0 -2.6 1.5" xyaxes="1 0 0 0 0.36 1"/>
    <body name="tray" pos="0 0 {HEIGHT:.9f}">
      <freejoint name="tray"/>
      <geom name="tray" type="cylinder" size="0.5 0.01" density="100" rgba="0.55 0.70 0.80 1"/>
      <geom name="surface" type="box" size="0.5 0.5 0.01" mass="0" rgba="0 0 0 0"/>
      <site name="middle" type="cylinder" size="0.1 0.0105" rgba="0.20 0.60 0.35 1"/>{"".join(map(_leg, LEGS))}
    </body>
    <body name="ball" pos="0 0 1.5">
      <freejoint name="ball"/>
      <geom name="ball" type="sphere" size="{BALL_RADIUS}" density="200" material="ball"/>
    </body>
  </worldbody>
  <contact>
    <pair geom1="surface" geom2="ball" condim="3" friction="1 1 0.005 0.0001 0.0001" solref="0.01 1"/>
  </contact>
  <equality>
    {"".join(f'<connect name="foot{k}" body1="lower{k}" anchor="{SIDE:.9f} 0 {-SIDE:.9f}"/>' for k in LEGS)}
  </equality>
  <actuator>
    {"".join(f'<position name="lower{k}" joint="lower{k}"/>' for k in LEGS)}
  </actuator>
</mujoco>
"""
KNEES_QPOS, KNEES_QVEL = np.array([8, 10, 12]), np.array([7, 9, 11])  # hip and knee of each leg after the tray
BALL_QPOS, BALL_QVEL = slice(13, 16), slice(12, 15)
SENSORS = np.array([[0.4 * math.cos(2 * math.pi * k / 3), 0.4 * math.sin(2 * math.pi * k / 3), 0] for k in LEGS])

_TORQUES = tuple(f"torque_{i}" for i in "xyz")
NAMES = (
    *(f"lower{k}_position" for k in LEGS),
    *(f"lower{k}_velocity" for k in LEGS),
    *(f"ball_{i}" for i in "xyz"),
    *(f"ball_velocity_{i}" for i in "xyz"),
    *(f"{load}_{k}" for load in ("force_x", *_TORQUES) for k in LEGS),
)


def _mirror() -> Mirror:
    """Left and right (y -> -y): legs 1 <-> 2; of the loads, torques about x and z turn their sign."""
    swapped = {0: 0, 1: 2, 2: 1}
    signs = {"force_x": "", "torque_x": "-", "torque_y": "", "torque_z": "-"}
    loads = {f"{load}_{k}": f"{sign}{load}_{swapped[k]}" for load, sign in signs.items() for k in LEGS}
    ball = {name: f"-{name}" for name in ("ball_y", "ball_velocity_y")}
    return Mirror(joints={"upper1": "upper2", "lower1": "lower2"}, observations=loads | ball, normal="y")


class BallBalance(RateControlled):
    """24 observations: knees, the ball's place and velocity (m, m/s), loads of three sensors on the tray / 20 (N, N m).

    The sensors lie 0.4 m from the middle, above the legs. Each shows the force of the ball on the tray (its x alone, in
    the tray's frame) and its torque about the sensor's own point. Actions: rates of the knees' targets / (20 rad/s).
    """

    control_dt: ClassVar[float] = 0.01
    default_episode_length: ClassVar[int] = 500
    rates: ClassVar[Sequence[float]] = (20.0,) * 3  # rad/s
    observation_clip: ClassVar[dict[str, float | None]] = {"isaacgymenvs": 5.0, "bayessim2021": 100.0}
    observation_names: ClassVar[tuple[str, ...]] = NAMES
    mirror = (_mirror(),)

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_string(XML)

    def initial(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_way, key_drop = jax.random.split(key)
        angle = jax.random.uniform(key_way, (), minval=-jnp.pi, maxval=jnp.pi)
        share, height, speed = jax.random.uniform(key_drop, (3,))
        outwards = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        place = jnp.append((0.001 + 0.499 * share) * outwards, 1 + height)
        velocity = jnp.append(-share * 5 * speed * outwards, -5.0)  # towards the middle, the faster the farther out
        home = jnp.asarray(self.mj_model.qpos0, jnp.float32)
        return home.at[BALL_QPOS].set(place), jnp.zeros(18).at[BALL_QVEL].set(velocity)

    def observe(self, world: World, data: mjx.Data, action: jax.Array) -> Observations:
        qpos, qvel = world.measurement["qpos"], world.measurement["qvel"]
        parts = [qpos[KNEES_QPOS], qvel[KNEES_QVEL], qpos[BALL_QPOS], qvel[BALL_QVEL], LOAD_SCALE * self._loads(data)]
        return {"policy": jnp.concatenate(parts)}

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        ball, velocity = after.qpos[BALL_QPOS], after.qvel[BALL_QVEL]
        distance = jnp.linalg.norm(ball - AIM)
        reward = 1 / (1 + distance) / (1 + jnp.linalg.norm(velocity))
        return reward, ball[2] < 1.5 * BALL_RADIUS, {"ball_distance": distance} | told({"ball": reward})

    def _loads(self, data: mjx.Data) -> jax.Array:
        """`[12]`: of the three sensors the force along x, then torques about x, about y and about z (N, N m)."""
        tray = self.mj_model.body("tray").id
        wrench, turn = (
            wrenches(self.sys, data)[tray],
            data.xmat[tray],
        )  # about the robot's centre of mass; body to world
        force, arm = wrench[3:] @ turn, (data.subtree_com[tray] - data.xpos[tray]) @ turn  # in the tray's frame
        torque = wrench[:3] @ turn + jnp.cross(arm - SENSORS.astype(np.float32), force)
        return jnp.concatenate([jnp.tile(force[0], 3), torque.T.ravel()])
