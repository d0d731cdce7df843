"""Ant: a four-legged robot that runs along +x (IsaacGymEnvs' Ant; model in ant.xml).

Names are the original's: "front_right" stands at (-x, +y), so +x lies between legs 1 (front_left) and 4 (right_back).
Joint stiffness, when randomised, is a passive spring about q = 0 (springref 0), as in Isaac.
"""

from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import mujoco

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

FEET = ("front_left_foot", "front_right_foot", "left_back_foot", "right_back_foot")
JOINTS = ("hip_1", "ankle_1", "hip_2", "ankle_2", "hip_3", "ankle_3", "hip_4", "ankle_4")
MAX_TORQUE = 15.0  # N m
FALLEN = 0.31  # m, height of the torso
SPEED_SCALE, FORCE_SCALE = 0.2, 0.1

NAMES = (
    *ROOT,
    *(f"{joint}_position" for joint in JOINTS),
    *(f"{joint}_velocity" for joint in JOINTS),
    *(f"{foot}_{load}" for foot in FEET for load in LOADS),
    *(f"{joint}_action" for joint in JOINTS),
)


def _mirror() -> Mirror:
    """Left and right (y -> -y): legs 1 <-> 4 and 2 <-> 3; hips turn the other way, the ankles' axes take care of it."""
    turned = [f"{foot}_{part}" for foot in FEET for part in ("force_y", "torque_x", "torque_z")]
    partner = dict(zip(FEET, reversed(FEET), strict=True))
    images = {f"{foot}_{load}": f"{partner[foot]}_{load}" for foot in FEET for load in LOADS}
    return Mirror(
        joints={"hip_1": "-hip_4", "hip_2": "-hip_3", "ankle_1": "ankle_4", "ankle_2": "ankle_3"},
        observations={name: f"-{name}" for name in TURNED}
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
        low, high = limits(self.mj_model)
        noise = jax.random.uniform(key_q, (8,), minval=-0.2, maxval=0.2)
        joints = jnp.clip(jnp.clip(0.0, low, high) + noise, low, high)
        qvel = jax.random.uniform(key_v, (8,), minval=-0.1, maxval=0.1)
        pose = jnp.array([0.0, 0.0, 0.44, 1.0, 0.0, 0.0, 0.0])
        return jnp.concatenate([pose, joints]), jnp.concatenate([jnp.zeros(6), qvel])

    def command(self, action: jax.Array) -> jax.Array:
        return MAX_TORQUE * action

    def observe(self, world: World, data: mjx.Data, action: jax.Array) -> Observations:
        qpos, qvel = world.measurement["qpos"], world.measurement["qvel"]
        parts = [
            root(qpos, qvel),
            scaled_joints(self.mj_model, qpos),
            SPEED_SCALE * qvel[6:],
            FORCE_SCALE * foot_loads(self.sys, self.mj_model, data, FEET),
            action,
        ]
        return {"policy": jnp.concatenate(parts)}

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        progress = approach(before.qpos, after.qpos) / self.dt  # m/s towards the target
        up, heading = posture(after.qpos)
        energy = jnp.sum(jnp.abs(action * SPEED_SCALE * after.qvel[6:]))
        at_limit = jnp.sum(scaled_joints(self.mj_model, after.qpos) > 0.99)  # the upper limit only, as in the original
        reward = (
            progress + 0.5 + posture_reward(up, heading) - 0.005 * jnp.sum(action**2) - 0.05 * energy - 0.1 * at_limit
        )
        fallen = after.qpos[2] < FALLEN
        return jnp.where(fallen, -2.0, reward), fallen, {"forward_speed": progress, "height": after.qpos[2]}
