"""FrankaCabinet: an arm opens the top drawer of a cabinet (IsaacGymEnvs' FrankaCabinet; model in franka_cabinet.xml).

Unlike the original: the point that has to reach the handle lies between the fingertips, and it is these that have to
lie above and below the handle (`env.graspPoint: isaac` takes Isaac's point, which lies beside the fingers' base, and
the fingers' origins; with it the handle cannot be reached without going through the drawer's front). Doors and the
lower drawer do not open; only fingers and palm can touch, and only the top drawer; its load lies still. Joints have
an armature of 0.25 kg m^2: with less, a drive at the limit of its force, which has no damping there, would swing from
limit to limit. Fingers' drives have 2000 N/m instead of 10^6. Joints' speeds are not limited.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.env import Observations
from bayessim_mjx.errors import UserError
from bayessim_mjx.physics import World, mjx
from bayessim_mjx.tasks._terms import told
from bayessim_mjx.tasks.manipulation import Manipulation, Pose, alignment, closeness

JOINTS = (*(f"joint{i}" for i in range(1, 8)), "finger1", "finger2")
NAMES = (
    *(f"{joint}_{kind}" for kind in ("position", "velocity") for joint in JOINTS),
    *(f"to_handle_{i}" for i in "xyz"),
    "drawer_position",
    "drawer_velocity",
)
SPEED_SCALE = 0.1
NEAR = 0.02  # m, from which on being there counts twice
REACH = 0.04  # m: fingers count as close to the handle up to here, and as beyond it from here on
OPENED = 0.35  # m, of a success
INWARDS, UP = np.array([-1.0, 0.0, 0.0], np.float32), np.array([0.0, 0.0, 1.0], np.float32)  # world axes
POINTS = {  # sites: what has to reach the handle, left and right finger
    "fingertips": ("grasp", "left_tip", "right_tip"),
    "isaac": ("isaac_grasp", "left_finger", "right_finger"),
}


class FrankaCabinet(Manipulation):
    """23 observations (see NAMES; joints from -1 to 1 within their limits, their speeds x 0.1, m, m/s).

    Actions: rates of the joints' targets / (7.5 rad/s), of the fingers' / (0.75 m/s). The reward's parts are nearness
    and attitude of the hand, fingers above and below the handle, and how far the drawer is open.
    """

    control_dt: ClassVar[float] = 1 / 60
    default_episode_length: ClassVar[int] = 500
    options: ClassVar[dict[str, Any]] = {"graspPoint": "fingertips"}
    rates: ClassVar[Sequence[float]] = (7.5,) * 7 + (0.75,) * 2
    home: ClassVar[dict[str, float]] = dict(
        zip(JOINTS, (1.157, -1.066, -0.155, -2.239, -1.841, 1.003, 0.469, 0.035, 0.035), strict=True)
    )
    spread: ClassVar[float] = 0.125
    observation_clip: ClassVar[dict[str, float | None]] = {"isaacgymenvs": 5.0, "bayessim2021": 100.0}
    observation_names: ClassVar[tuple[str, ...]] = NAMES

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        point = self.settings["graspPoint"]
        if point not in POINTS:
            raise UserError(f"env.graspPoint = {point!r}: allowed are {', '.join(POINTS)}")
        self._sites = (*POINTS[point], "handle")

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_file(str(Path(__file__).with_name("franka_cabinet.xml")))

    def start(self, key: jax.Array, world: World) -> dict[str, Any]:
        return super().start(key, world) | {"opened": world.qpos[9]}

    def advance(self, before: World, world: World, data: mjx.Data, action: jax.Array) -> World:
        opened = jnp.maximum(world.task["opened"], world.qpos[9])  # how far the drawer has been in this episode, m
        return world.replace(task=world.task | {"opened": opened})

    def observe(self, world: World, data: mjx.Data, action: jax.Array) -> Observations:
        qpos, qvel = world.measurement["qpos"], world.measurement["qvel"]
        grasp, _, _, handle = self.frames(world, *self._sites, measured=True)
        to_handle = handle.position - grasp.position
        parts = [self.scaled_joints(qpos), SPEED_SCALE * qvel[:9], to_handle, qpos[9:], qvel[9:]]
        return {"policy": jnp.concatenate(parts)}

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        grasp, left, right, handle = self.frames(after, *self._sites)
        drawer, cost = after.qpos[9], 0.01 * jnp.sum(action**2)
        distance = jnp.linalg.norm(grasp.position - handle.position)
        turn = 0.5 * (alignment(grasp.turn[:, 2], INWARDS) + alignment(grasp.turn[:, 1], UP))
        around, fingers = _around(left, right, handle)
        beyond = jnp.minimum(left.position[0], right.position[0]) < handle.position[0] - REACH
        parts = {"turn": 0.5 * turn}
        if self.variant == "bayessim2021":
            parts |= {"near": 1.5 * closeness(distance, NEAR), "around": around, "fingers": 10 * fingers}
            parts |= {"drawer": 4 * drawer, "steps": _ladder(drawer)}
            ends = beyond
        else:
            parts |= {"near": 2 * closeness(distance, NEAR), "around": 0.25 * around, "fingers": 5 * fingers}
            parts |= {"drawer": 7.5 * drawer * (1 + around), "steps": _bonus(drawer, around)}
            ends = drawer > 0.39
        reward = parts["near"] + parts["turn"] + parts["around"] + parts["fingers"]
        reward = reward + parts["drawer"] + parts["steps"] - cost
        opened = (after.task["opened"] > OPENED).astype(jnp.float32)
        metrics = {"drawer": drawer, "opened": opened, "handle_distance": distance}
        return jnp.where(beyond, -1.0, reward), ends, metrics | told(parts | {"actions": -cost}, beyond, -1.0)


def _around(left: Pose, right: Pose, handle: Pose) -> tuple[jax.Array, jax.Array]:
    """(0.5 where the left finger is above and the right one below the handle, how close they are to it then, m)."""
    above, below = left.position[2] - handle.position[2], handle.position[2] - right.position[2]
    grasped = (above > 0) & (below > 0)
    return 0.5 * grasped, jnp.where(grasped, 2 * REACH - jnp.abs(above) - jnp.abs(below), 0.0)


def _bonus(drawer: jax.Array, around: jax.Array) -> jax.Array:
    """IsaacGymEnvs': for a drawer that has begun to move, is half open, is open."""
    return 0.5 * (drawer > 0.01) + around * (drawer > 0.2) + 2 * around * (drawer > 0.39)


def _ladder(drawer: jax.Array) -> jax.Array:
    """Give the reward of 2021: the highest step that the drawer has reached."""
    steps = jnp.array([0.0, 0.01, 0.05, 0.1, 0.15, 0.2, 0.38])
    pays = jnp.array([0.0, 0.15, 0.25, 0.35, 0.5, 0.65, 0.8, 1.0])
    return pays[jnp.sum(drawer > steps)]
