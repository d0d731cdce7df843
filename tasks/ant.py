"""Ant: a four-legged robot that runs along +x (IsaacGymEnvs' Ant; model in ant.xml).

Names are the original's: "front_right" stands at (-x, +y), so +x lies between legs 1 (front_left) and 4 (right_back).
Joint stiffness, when randomised, is a passive spring about q = 0 (springref 0), as in Isaac.
"""

from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.env import Observations, Task
from bayessim_mjx.frames import rotation, wrap
from bayessim_mjx.mirrors import Mirror
from bayessim_mjx.physics import World, mjx
from bayessim_mjx.physics.warp import wrenches

FEET = ("front_left_foot", "front_right_foot", "left_back_foot", "right_back_foot")
JOINTS = ("hip_1", "ankle_1", "hip_2", "ankle_2", "hip_3", "ankle_3", "hip_4", "ankle_4")
MAX_TORQUE = 15.0  # N m
TARGET = np.array([1000.0, 0.0], np.float32)  # m
FALLEN = 0.31  # m, height of the torso
SPEED_SCALE, FORCE_SCALE = 0.2, 0.1

_XYZ = ("x", "y", "z")
NAMES = (
    "height",
    *(f"velocity_{i}" for i in _XYZ),
    *(f"angular_velocity_{i}" for i in _XYZ),
    *("yaw", "roll", "angle_to_target", "up_projection", "heading_projection"),
    *(f"{joint}_position" for joint in JOINTS),
    *(f"{joint}_velocity" for joint in JOINTS),
    *(f"{foot}_{kind}_{i}" for foot in FEET for kind in ("force", "torque") for i in _XYZ),
    *(f"{joint}_action" for joint in JOINTS),
)


def _mirror() -> Mirror:
    """Left and right (y -> -y): legs 1 <-> 4 and 2 <-> 3; hips turn the other way, the ankles' axes take care of it."""
    turned = [f"{foot}_{part}" for foot in FEET for part in ("force_y", "torque_x", "torque_z")]
    partner = dict(zip(FEET, reversed(FEET), strict=True))
    names = [f"{foot}_{kind}_{i}" for foot in FEET for kind in ("force", "torque") for i in _XYZ]
    images = {name: partner[foot] + name[len(foot) :] for name in names for foot in FEET if name.startswith(foot)}
    odd = ("velocity_y", "angular_velocity_x", "angular_velocity_z", "yaw", "roll", "angle_to_target")
    return Mirror(
        joints={"hip_1": "-hip_4", "hip_2": "-hip_3", "ankle_1": "ankle_4", "ankle_2": "ankle_3"},
        observations={name: f"-{name}" for name in odd}
        | {name: "-" * (name in turned) + other for name, other in images.items()},
        normal="y",
    )


class Ant(Task):
    """60 observations (see NAMES; scales: joint velocity 0.2, foot forces 0.1); actions: joint torque / 15 N m."""

    control_dt: ClassVar[float] = 1 / 60
    default_episode_length: ClassVar[int] = 1000
    diverged_reward: ClassVar[float] = -2.0
    # A joint swung through its whole range by the full torque reaches 65 rad/s; one world in a few million steps
    # explodes (one solver iteration), and a single reward of 1e11 ruins the critic.
    speed_limit: ClassVar[float] = 200.0
    observation_names: ClassVar[tuple[str, ...]] = NAMES
    mirror = (_mirror(),)

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_file(str(Path(__file__).with_name("ant.xml")))

    def initial(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_q, key_v = jax.random.split(key)
        low, high = self._limits()
        noise = jax.random.uniform(key_q, (8,), minval=-0.2, maxval=0.2)
        joints = jnp.clip(jnp.clip(0.0, low, high) + noise, low, high)
        qvel = jax.random.uniform(key_v, (8,), minval=-0.1, maxval=0.1)
        root = jnp.array([0.0, 0.0, 0.44, 1.0, 0.0, 0.0, 0.0])
        return jnp.concatenate([root, joints]), jnp.concatenate([jnp.zeros(6), qvel])

    def command(self, action: jax.Array) -> jax.Array:
        return MAX_TORQUE * action

    def observe(self, world: World, data: mjx.Data, action: jax.Array) -> Observations:
        qpos, qvel = world.measurement["qpos"], world.measurement["qvel"]
        turn = rotation(qpos[3:7])
        yaw, roll = jnp.arctan2(turn[1, 0], turn[0, 0]), jnp.arctan2(turn[2, 1], turn[2, 2])
        to_target = TARGET - qpos[:2]
        bearing = jnp.arctan2(to_target[1], to_target[0])
        up, heading = _posture(qpos)
        parts = [
            qpos[2:3],
            turn.T @ qvel[:3],
            qvel[3:6],  # MuJoCo's angular velocity of a free joint is in the body frame already
            jnp.stack([wrap(yaw), wrap(roll), wrap(bearing - yaw), up, heading]),
            self._scaled_joints(qpos),
            SPEED_SCALE * qvel[6:],
            FORCE_SCALE * self._foot_wrenches(data),
            action,
        ]
        return {"policy": jnp.concatenate(parts)}

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        progress = _approach(before.qpos, after.qpos) / self.dt  # m/s towards the target
        up, heading = _posture(after.qpos)
        posture = 0.1 * (up > 0.93) + jnp.where(heading > 0.8, 0.5, 0.5 * heading / 0.8)
        energy = jnp.sum(jnp.abs(action * SPEED_SCALE * after.qvel[6:]))
        at_limit = jnp.sum(self._scaled_joints(after.qpos) > 0.99)  # the upper limit only, as in the original
        reward = progress + 0.5 + posture - 0.005 * jnp.sum(action**2) - 0.05 * energy - 0.1 * at_limit
        fallen = after.qpos[2] < FALLEN
        return jnp.where(fallen, -2.0, reward), fallen, {"forward_speed": progress, "height": after.qpos[2]}

    def _limits(self) -> tuple[np.ndarray, np.ndarray]:
        limits = self.mj_model.jnt_range[1:].astype(np.float32)
        return limits[:, 0], limits[:, 1]

    def _scaled_joints(self, qpos: jax.Array) -> jax.Array:
        low, high = self._limits()
        return (2 * qpos[7:] - high - low) / (high - low)

    def _foot_wrenches(self, data: mjx.Data) -> jax.Array:
        """`[24]`: contact force (N) and torque about the foot's origin (N m) of each foot, in the foot's frame."""
        by_body = wrenches(self.sys, data)
        feet = np.array([self.mj_model.body(name).id for name in FEET])
        # cfrc_ext: torque about the robot's centre of mass, then force; world axes
        torque, force = by_body[feet, :3], by_body[feet, 3:]
        arm = data.subtree_com[1] - data.xpos[feet]
        torque = torque + jnp.cross(arm, force)
        wrench = jnp.stack([force, torque], axis=1)
        return jnp.einsum("fji,fkj->fki", data.xmat[feet], wrench).ravel()


def _approach(before: jax.Array, after: jax.Array) -> jax.Array:
    """How much nearer the target is, m. |a| - |b| = (a - b) . (a + b) / (|a| + |b|) keeps micrometres of 1000 m."""
    a, b = TARGET - before[:2], TARGET - after[:2]
    return (after[:2] - before[:2]) @ (a + b) / (jnp.linalg.norm(a) + jnp.linalg.norm(b))


def _posture(qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(body z axis . world z, body x axis . horizontal unit vector to the target)."""
    turn, to_target = rotation(qpos[3:7]), TARGET - qpos[:2]
    return turn[2, 2], turn[:2, 0] @ to_target / jnp.linalg.norm(to_target)
