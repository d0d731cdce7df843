"""Ant: a four-legged robot that runs along +x (IsaacGymEnvs' Ant; model in ant.xml).

Names are the original's: "front_right" stands at (-x, +y), so +x lies between legs 1 (front_left) and 4 (right_back).
Joint stiffness, when randomised, is a passive spring about q = 0 (springref 0), as in Isaac.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco

from bayessim_mjx.mirrors import Mirror
from bayessim_mjx.physics import World, mjx
from bayessim_mjx.tasks._running import approach, mirrored_loads, posture, posture_reward
from bayessim_mjx.tasks._terms import told
from bayessim_mjx.tasks.locomotion import Locomotion

FEET = ("front_left_foot", "front_right_foot", "left_back_foot", "right_back_foot")
MAX_TORQUE = 15.0  # N m
FALLEN = 0.31  # m, height of the torso
SPEED_SCALE, FORCE_SCALE = 0.2, 0.1


def _mirror() -> Mirror:
    """Left and right (y -> -y): legs 1 <-> 4 and 2 <-> 3; hips turn the other way, the ankles' axes take care of it."""
    seen = ("velocity_y", "angular_velocity_x", "angular_velocity_z", "yaw", "roll", "angle_to_target")
    return Mirror(
        joints={"hip_1": "-hip_4", "hip_2": "-hip_3", "ankle_1": "ankle_4", "ankle_2": "ankle_3"},
        observations={name: f"-{name}" for name in seen} | mirrored_loads(dict(zip(FEET, reversed(FEET), strict=True))),
        normal="y",
    )


class Ant(Locomotion):
    """60 observations (scales: joint velocity 0.2, foot forces 0.1); actions: joint torque / 15 N m."""

    control_dt: ClassVar[float] = 1 / 60
    default_episode_length: ClassVar[int] = 1000
    diverged_reward: ClassVar[float] = -2.0
    # A joint swung through its whole range by the full torque reaches 65 rad/s; one world in a few million steps
    # explodes (one solver iteration), and a single reward of 1e11 ruins the critic.
    speed_limit: ClassVar[float] = 200.0
    observations: ClassVar[Mapping[str, Any]] = {
        **{"height": 1.0, "velocity": 1.0, "turning": 1.0, "heading": 1.0, "scaled_joints": 1.0},
        **{"joint_speeds": SPEED_SCALE, "foot_loads": FORCE_SCALE, "actions": 1.0},
    }
    spread: ClassVar[float] = 0.2
    speed_spread: ClassVar[float] = 0.1
    reach: ClassVar[float] = MAX_TORQUE
    feet: ClassVar[Sequence[str]] = FEET
    mirror = (_mirror(),)

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_file(str(Path(__file__).with_name("ant.xml")))

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        progress = approach(before.qpos, after.qpos) / self.dt  # m/s towards the target
        up, heading = posture(after.qpos)
        energy = jnp.sum(jnp.abs(action * SPEED_SCALE * after.qvel[6:]))
        at_limit = jnp.sum(self.scaled_joints(after.qpos) > 0.99)  # the upper limit only, as in the original
        reward = (
            progress + 0.5 + posture_reward(up, heading) - 0.005 * jnp.sum(action**2) - 0.05 * energy - 0.1 * at_limit
        )
        fallen = after.qpos[2] < FALLEN
        parts = {"progress": progress, "alive": 0.5, "posture": posture_reward(up, heading)}
        parts |= {"actions": -0.005 * jnp.sum(action**2), "energy": -0.05 * energy, "limits": -0.1 * at_limit}
        metrics = {"forward_speed": progress, "height": after.qpos[2]}
        return jnp.where(fallen, -2.0, reward), fallen, metrics | told(parts, fallen, -2.0)
