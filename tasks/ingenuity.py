"""Ingenuity: a Mars helicopter with two coaxial rotors flies to way-points (IsaacGymEnvs' Ingenuity).

Each rotor pushes along and across its axis; there is no drag and no reaction torque, so that nothing controls the yaw.
The rotors that push are locked to the chassis. Here an armature of 1e6 kg m^2 holds their joints, and keeps the
turning of the two rotors that are only seen; neither reaches the chassis. BayesSimIG infers the stiffness of these four
joints, which therefore cannot be identified. Unlike the original: the largest angular velocity of 4 pi rad/s holds for
each axis of the chassis, and the rotors that are only seen weigh 0.1 g each, as the sources do not say what they weigh.
"""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.env import Observations, Task
from bayessim_mjx.physics import World, mjx
from bayessim_mjx.tasks._flight import MAX_SPIN, NAMES, WAY, flight, hovering, left_right
from bayessim_mjx.tasks._scene import FLOOR, scene

ROTORS = (0, 1)
HEIGHTS = (0.0, 0.025)  # m, of the rotors above the chassis' middle
THRUST, SIDEWAYS = 20.0, 0.2  # N at the action 1; largest share of the thrust across the axis
BLADES = 50.0  # rad/s, turning of the rotors that are seen
MAX_DISTANCE, LOWEST = 8.0, 0.5  # m
STEPS_PER_TARGET = 500
REACH = {"isaacgymenvs": 5.0, "bayessim2021": 1.0}  # m, of targets along x and y
UPRIGHT = {"isaacgymenvs": 5.0, "bayessim2021": 1.0}  # weight of being level


def _rotor(k: int) -> str:
    height, seen = HEIGHTS[k], 0.115 + 0.05 * k
    return f"""
      <body name="rotor_physics_{k}" pos="0 0 {height}">
        <joint name="rotor_physics_{k}"/>
        <geom name="rotor_physics_{k}" type="cylinder" size="0.15 0.005" density="1000" rgba="0 0 0 0"/>
        <site name="rotor_{k}"/>
      </body>
      <body name="rotor_visual_{k}" pos="0 0 {seen}">
        <inertial mass="0.0001" pos="0 0 0" diaginertia="1e-6 1e-6 2e-6"/>
        <joint name="rotor_visual_{k}"/>
        <geom name="blade_{k}" type="box" size="0.3 0.022 0.002" euler="6 0 {90 * k}" mass="0" rgba="0.13 0.13 0.14 1"/>
        <geom name="disc_{k}" type="cylinder" size="0.3 0.001" mass="0" rgba="0.2 0.2 0.22 0.18"/>
      </body>"""


def _leg(k: int) -> str:
    x, y = (math.cos(math.pi / 4 + k * math.pi / 2), math.sin(math.pi / 4 + k * math.pi / 2))
    fromto = f"{0.06 * x:.6f} {0.06 * y:.6f} -0.05 {0.21 * x:.6f} {0.21 * y:.6f} -0.2"
    return f'<geom name="leg_{k}" type="capsule" fromto="{fromto}" size="0.004" mass="0" rgba="0.2 0.2 0.2 1"/>'


XML = f"""
<mujoco model="ingenuity">
  <compiler angle="degree" autolimits="true"/>
  <option timestep="0.005" gravity="0 0 -3.721" integrator="Euler" iterations="1" ls_iterations="4">
    <flag contact="disable" eulerdamp="disable"/>
  </option>{scene(("0.72 0.46 0.32", "0.64 0.39 0.27"), "0.80 0.68 0.55")}
  <default>
    <geom contype="0" conaffinity="0"/>
    <joint type="hinge" axis="0 0 1" armature="1e6"/>
  </default>
  <worldbody>
    {FLOOR}
    <light type="directional" pos="1 -1.5 4" dir="-0.25 0.35 -1" diffuse="0.5 0.5 0.5" specular="0.1 0.1 0.1"/>
    <body name="chassis" pos="0 0 1">
      <freejoint name="root"/>
      <camera name="track" mode="track" pos="0 -1.6 0.55" xyaxes="1 0 0 0 0.3 0.95"/>
      <geom name="chassis" type="box" size="0.06 0.06 0.06" density="50" rgba="0.78 0.68 0.42 1"/>
      <geom name="mast" type="capsule" fromto="0 0 0.06 0 0 0.2" size="0.008" mass="0" rgba="0.25 0.25 0.27 1"/>
      <geom name="panel" type="box" size="0.08 0.055 0.003" pos="0 0 0.205" mass="0" rgba="0.12 0.16 0.30 1"/>
      {"".join(map(_leg, range(4)))}{"".join(map(_rotor, ROTORS))}
    </body>
    <body name="target" mocap="true" pos="0 0 1.5">
      <geom name="target" type="sphere" size="0.06" mass="0" rgba="0.20 0.60 0.35 0.7"/>
    </body>
  </worldbody>
  <actuator>
    {
    "".join(
        f'''<motor name="rotor_{k}_x" site="rotor_{k}" gear="1 0 0 0 0 0" ctrlrange="-4 4"/>
    <motor name="rotor_{k}_y" site="rotor_{k}" gear="0 1 0 0 0 0" ctrlrange="-4 4"/>
    <motor name="rotor_{k}_z" site="rotor_{k}" gear="0 0 1 0 0 0" ctrlrange="-20 20"/>'''
        for k in ROTORS
    )
}
  </actuator>
</mujoco>
"""


class Ingenuity(Task):
    """13 observations, those of `_flight.flight`. A new target every 500 steps: z in 1 to 2 m, x and y in +-5 (or 1) m.

    Actions: for each rotor the forces across its axis as shares of the thrust (cut off at 0.2), and the thrust / 20 N.
    There is no force in the first step of an episode, as in the original.
    """

    control_dt: ClassVar[float] = 0.01
    default_episode_length: ClassVar[int] = 2000
    observation_clip: ClassVar[dict[str, float | None]] = {"isaacgymenvs": 5.0, "bayessim2021": 100.0}
    max_qvel: ClassVar[Sequence[float]] = (*(np.inf,) * 3, *(MAX_SPIN,) * 3, *(np.inf,) * 4)
    observation_names: ClassVar[tuple[str, ...]] = NAMES
    mirror = (
        left_right(
            {f"rotor_{kind}_{k}": f"-rotor_{kind}_{k}" for kind in ("physics", "visual") for k in ROTORS},
            task=("target_y",),
        ),
    )

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_string(XML)

    def initial(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        low, high = np.array([[-1.5, -1.5, 0.8], [1.5, 1.5, 2.5]], np.float32)
        position = jax.random.uniform(key, (3,), minval=low, maxval=high)
        qvel = jnp.zeros(10).at[7].set(-BLADES).at[9].set(BLADES)
        return jnp.concatenate([position, jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(4)]), qvel

    def start(self, key: jax.Array, world: World) -> dict[str, Any]:
        count = -(-self.episode_length // STEPS_PER_TARGET)
        unit, reach = jax.random.uniform(key, (3, count), minval=-1.0), REACH[self.variant]
        return {"target_x": reach * unit[0], "target_y": reach * unit[1], "target_z": 1.5 + 0.5 * unit[2]}

    def command(self, action: jax.Array) -> jax.Array:
        x, y, z = action.reshape(2, 3).T
        thrust = THRUST * z
        across = jnp.clip(jnp.stack([x, y]), -SIDEWAYS, SIDEWAYS) * thrust
        return jnp.stack([*across, thrust]).T.ravel()

    def actuate(self, world: World, action: jax.Array) -> tuple[World, jax.Array]:
        return world, jnp.where(world.task["steps"] == 0, 0.0, self.command(action))

    def marks(self, qpos: np.ndarray, observation: np.ndarray) -> np.ndarray:
        """Mark the target of each row, from where it is seen."""
        place = qpos[:, :3] + WAY * observation[:, :3]
        return np.concatenate([place, np.tile([1.0, 0, 0, 0], (len(qpos), 1))], axis=1)[:, None]

    def observe(self, world: World, data: mjx.Data, action: jax.Array) -> Observations:
        return {"policy": flight(self._target(world), world.measurement["qpos"], world.measurement["qvel"])}

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        reward, distance, metrics = hovering(self._target(after), after.qpos, after.qvel, UPRIGHT[self.variant])
        lost = (distance > MAX_DISTANCE) | (after.qpos[2] < LOWEST)
        return reward, lost, metrics

    def _target(self, world: World) -> jax.Array:
        """Return the target `[3]` (m) of the step that led to this world; the second one begins with step 501."""
        which = jnp.maximum(world.task["steps"] - 1, 0) // STEPS_PER_TARGET
        return jnp.stack([jnp.take(world.task[f"target_{i}"], which, mode="clip") for i in "xyz"])
