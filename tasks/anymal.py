"""Anymal: a quadruped follows velocity commands on flat ground (IsaacGymEnvs' Anymal; model in anymal.xml).

Unlike the original: an episode ends where a sphere around the base, the lidar, a hip's pitch joint or a knee would be
in the ground, as nothing but feet can touch. The direction of gravity is seen in the base's axes; the original turned
it the other way, so that a tilt could not be told from the yaw. Joints have an armature of 0.02 kg m^2, as MuJoCo
integrates the drives' gains explicitly; their speeds are not limited.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco

from bayessim_mjx.keys import branch
from bayessim_mjx.physics import World, mjx
from bayessim_mjx.tasks.locomotion import Locomotion

LEGS = ("LF", "LH", "RF", "RH")  # left fore, left hind, right fore, right hind
SECONDS = 50.0  # of an episode
STEP = {"isaacgymenvs": 0.02, "bayessim2021": 1 / 60}  # s


def _home(leg: str) -> dict[str, float]:
    """rad; hind legs are bent the other way, right ones are spread the other way."""
    spread, bent = (0.03 if leg[0] == "L" else -0.03), (1 if leg[1] == "F" else -1)
    return {f"{leg}_HAA": spread, f"{leg}_HFE": 0.4 * bent, f"{leg}_KFE": -0.8 * bent}


class Anymal(Locomotion):
    """48 observations: speeds x 2, turning x 0.25, joints' places from home (rad), their speeds x 0.05 (rad/s).

    Actions: the joints' targets from home / 0.5 rad. The reward, all of it times the control step and never negative:
    exp(-|velocity error|^2 / 0.25) + 0.5 exp(-(turning error)^2 / 0.25) - 2.5e-5 |torques|^2.
    """

    control_dt: ClassVar[float] = STEP["isaacgymenvs"]
    default_episode_length: ClassVar[int] = 2500
    options: ClassVar[dict[str, Any]] = {"episodeLength": None}  # 50 s
    observation_clip: ClassVar[dict[str, float | None]] = {"isaacgymenvs": 5.0, "bayessim2021": 100.0}
    observations: ClassVar[Mapping[str, Any]] = {
        **{"velocity": 2.0, "turning": 0.25, "gravity": 1.0, "commands": (2.0, 2.0, 0.25)},
        **{"joints": 1.0, "joint_speeds": 0.05, "actions": 1.0},
    }
    rewards: ClassVar[Mapping[str, float]] = {"velocity": 1.0, "turning": 0.5, "torques": -2.5e-5}  # per second
    commands: ClassVar[Mapping[str, float]] = {"command_x": 2.0, "command_y": 1.0, "command_yaw": 1.0}
    home: ClassVar[Mapping[str, float]] = {joint: place for leg in LEGS for joint, place in _home(leg).items()}
    speed_spread: ClassVar[float] = 0.1
    reach: ClassVar[float] = 0.5  # rad
    guards: ClassVar[Sequence[str]] = (
        *(f"{leg}_{place}_guard" for place in ("base", "thigh", "knee") for leg in LEGS),
        "lidar_guard",
    )
    sides: ClassVar[tuple[str, str]] = ("L", "R")

    def _read(self, config: Mapping[str, Any] | Any) -> dict[str, Any]:
        settings = super()._read(config)
        self.control_dt = STEP[settings["variant"]]  # type: ignore[misc]
        return settings | {"episodeLength": settings["episodeLength"] or round(SECONDS / self.control_dt)}

    def spec(self) -> mujoco.MjSpec:
        spec = mujoco.MjSpec.from_file(str(Path(__file__).with_name("anymal.xml")))
        spec.option.timestep = self.control_dt / 4
        return spec

    def initial(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """As the base has it, but with joints at 0.5 to 1.5 times home."""
        qpos, qvel = super().initial(key)
        share = jax.random.uniform(branch(key, 2), (12,), minval=0.5, maxval=1.5)
        return qpos.at[7:].multiply(share), qvel

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        reward, fallen, metrics = super().reward(before, after, data, action)
        metrics = {name: self.dt * part if name.startswith("reward_") else part for name, part in metrics.items()}
        metrics["reward_floor"] = self.dt * jnp.maximum(-reward, 0.0)  # what lifts a negative sum to nothing
        return self.dt * jnp.maximum(reward, 0.0), fallen, metrics
