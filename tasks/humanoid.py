"""Humanoid: a body with 21 driven joints that runs along +x (IsaacGymEnvs' Humanoid; model in humanoid.xml).

Unlike the original: only the feet can touch, and only the ground. The joint forces that are observed are those of
motors, springs and dampers: the sources do not say exactly what Isaac's sensor of a joint's force shows.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.physics import World, mjx
from bayessim_mjx.tasks._running import approach, posture, posture_reward
from bayessim_mjx.tasks._terms import told
from bayessim_mjx.tasks.locomotion import Locomotion

# N m at the action 1
GEARS = np.array([67.5] * 3 + [45, 45, 135, 90, 22.5, 22.5] * 2 + [67.5, 67.5, 45] * 2, np.float32)
STRENGTH = GEARS / GEARS.max()
FALLEN = 0.8  # m, height of the torso
SPIN_SCALE, SPEED_SCALE, LOAD_SCALE = 0.25, 0.1, 0.01


class Humanoid(Locomotion):
    """108 observations (scales: turning 0.25, joint velocity 0.1, forces 0.01); actions: torque / gear."""

    control_dt: ClassVar[float] = 1 / 60
    default_episode_length: ClassVar[int] = 1000
    diverged_reward: ClassVar[float] = -1.0
    observations: ClassVar[Mapping[str, Any]] = {
        **{"height": 1.0, "velocity": 1.0, "turning": SPIN_SCALE, "heading": 1.0, "scaled_joints": 1.0},
        **{"joint_speeds": SPEED_SCALE, "joint_forces": LOAD_SCALE, "foot_loads": LOAD_SCALE, "actions": 1.0},
    }
    spread: ClassVar[float] = 0.2
    speed_spread: ClassVar[float] = 0.1
    reach = GEARS
    feet: ClassVar[Sequence[str]] = ("right_foot", "left_foot")

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_file(str(Path(__file__).with_name("humanoid.xml")))

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        progress = approach(before.qpos, after.qpos) / self.dt  # m/s towards the target
        energy = jnp.sum(jnp.abs(action * SPEED_SCALE * after.qvel[6:]) * STRENGTH)
        beyond = jnp.abs(self.scaled_joints(after.qpos)) - 0.98
        at_limits = jnp.sum(jnp.maximum(beyond, 0.0) / 0.02 * STRENGTH)
        cost = 0.01 * jnp.sum(action**2) + 0.05 * energy + 0.25 * at_limits
        reward = progress + 2.0 + posture_reward(*posture(after.qpos)) - cost
        fallen = after.qpos[2] < FALLEN
        parts = {"progress": progress, "alive": 2.0, "posture": posture_reward(*posture(after.qpos))}
        parts |= {"actions": -0.01 * jnp.sum(action**2), "energy": -0.05 * energy, "limits": -0.25 * at_limits}
        metrics = {"forward_speed": progress, "height": after.qpos[2]}
        return jnp.where(fallen, -1.0, reward), fallen, metrics | told(parts, fallen, -1.0)
