"""Humanoid: a body with 21 driven joints that runs along +x (IsaacGymEnvs' Humanoid; model in humanoid.xml).

Unlike the original: only the feet can touch, and only the ground. The joint forces that are observed are those of
motors, springs and dampers: the sources do not say exactly what Isaac's sensor of a joint's force shows.
"""

from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.env import Observations, Task
from bayessim_mjx.mirrors import Mirror
from bayessim_mjx.physics import World, mjx
from bayessim_mjx.tasks._running import (
    LOADS,
    ROOT,
    TURNED,
    approach,
    foot_loads,
    limits,
    posture,
    posture_reward,
    root,
    scaled_joints,
)

FEET = ("right_foot", "left_foot")
LEG, ARM = ("hip_x", "hip_z", "hip_y", "knee", "ankle_y", "ankle_x"), ("shoulder1", "shoulder2", "elbow")
JOINTS = (
    *("abdomen_z", "abdomen_y", "abdomen_x"),
    *(f"{side}_{joint}" for part in (LEG, ARM) for side in ("right", "left") for joint in part),
)
# N m at the action 1
GEARS = np.array([67.5] * 3 + [45, 45, 135, 90, 22.5, 22.5] * 2 + [67.5, 67.5, 45] * 2, np.float32)
STRENGTH = GEARS / GEARS.max()
FALLEN = 0.8  # m, height of the torso
SPIN_SCALE, SPEED_SCALE, LOAD_SCALE = 0.25, 0.1, 0.01

NAMES = (
    *ROOT,
    *(f"{joint}_{kind}" for kind in ("position", "velocity", "force") for joint in JOINTS),
    *(f"{foot}_{load}" for foot in FEET for load in LOADS),
    *(f"{joint}_action" for joint in JOINTS),
)


def _mirror() -> Mirror:
    """Left and right (y -> -y). The axes of hips and arms are mirror images, those of ankle_x are parallel."""
    joints = {f"right_{joint}": f"left_{joint}" for joint in (*LEG, *ARM)}
    joints |= {"right_ankle_x": "-left_ankle_x", "abdomen_z": "-abdomen_z", "abdomen_x": "-abdomen_x"}
    turned = ("force_y", "torque_x", "torque_z")
    feet = {f"right_foot_{load}": "-" * (load in turned) + f"left_foot_{load}" for load in LOADS}
    return Mirror(joints=joints, observations={name: f"-{name}" for name in TURNED} | feet, normal="y")


class Humanoid(Task):
    """108 observations (see NAMES; scales: turning 0.25, joint velocity 0.1, forces 0.01); actions: torque / gear."""

    control_dt: ClassVar[float] = 1 / 60
    default_episode_length: ClassVar[int] = 1000
    diverged_reward: ClassVar[float] = -1.0
    speed_limit: ClassVar[float] = 1000.0  # what explodes must not reach the critic
    observation_names: ClassVar[tuple[str, ...]] = NAMES
    mirror = (_mirror(),)

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_file(str(Path(__file__).with_name("humanoid.xml")))

    def initial(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_q, key_v = jax.random.split(key)
        joints = jnp.clip(jax.random.uniform(key_q, (21,), minval=-0.2, maxval=0.2), *limits(self.mj_model))
        qvel = jax.random.uniform(key_v, (21,), minval=-0.1, maxval=0.1)
        pose = jnp.array([0.0, 0.0, 1.34, 1.0, 0.0, 0.0, 0.0])
        return jnp.concatenate([pose, joints]), jnp.concatenate([jnp.zeros(6), qvel])

    def command(self, action: jax.Array) -> jax.Array:
        return jnp.asarray(GEARS) * action

    def observe(self, world: World, data: mjx.Data, action: jax.Array) -> Observations:
        qpos, qvel = world.measurement["qpos"], world.measurement["qvel"]
        parts = [
            root(qpos, qvel, SPIN_SCALE),
            scaled_joints(self.mj_model, qpos),
            SPEED_SCALE * qvel[6:],
            LOAD_SCALE * (data.qfrc_actuator + data.qfrc_passive)[6:],
            LOAD_SCALE * foot_loads(self.sys, self.mj_model, data, FEET),
            action,
        ]
        return {"policy": jnp.concatenate(parts)}

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        progress = approach(before.qpos, after.qpos) / self.dt  # m/s towards the target
        energy = jnp.sum(jnp.abs(action * SPEED_SCALE * after.qvel[6:]) * STRENGTH)
        beyond = jnp.abs(scaled_joints(self.mj_model, after.qpos)) - 0.98
        at_limits = jnp.sum(jnp.maximum(beyond, 0.0) / 0.02 * STRENGTH)
        cost = 0.01 * jnp.sum(action**2) + 0.05 * energy + 0.25 * at_limits
        reward = progress + 2.0 + posture_reward(*posture(after.qpos)) - cost
        fallen = after.qpos[2] < FALLEN
        return jnp.where(fallen, -1.0, reward), fallen, {"forward_speed": progress, "height": after.qpos[2]}
