"""Anymal: a quadruped follows velocity commands on flat ground (IsaacGymEnvs' Anymal; model in anymal.xml).

Unlike the original: an episode ends where a sphere around the base, the lidar, a hip's pitch joint or a knee would be
in the ground, as nothing but feet can touch. The direction of gravity is seen in the base's axes; the original turned
it the other way, so that a tilt could not be told from the yaw. Joints have an armature of 0.02 kg m^2, as MuJoCo
integrates the drives' gains explicitly; their speeds are not limited.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.env import Observations, Task
from bayessim_mjx.frames import rotation
from bayessim_mjx.mirrors import Mirror
from bayessim_mjx.physics import World, mjx

LEGS = ("LF", "LH", "RF", "RH")  # left fore, left hind, right fore, right hind
JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("HAA", "HFE", "KFE"))
HOME = np.array([0.03, 0.4, -0.8, 0.03, -0.4, 0.8, -0.03, 0.4, -0.8, -0.03, -0.4, 0.8], np.float32)  # rad
REACH = 0.5  # rad, of a joint's target from HOME at the action 1
START = (0.0, 0.0, 0.62, 1.0, 0.0, 0.0, 0.0)  # of the base, m and quaternion
COMMANDS = {"command_x": 2.0, "command_y": 1.0, "command_yaw": 1.0}  # largest, m/s and rad/s
SECONDS = 50.0  # of an episode
STEP = {"isaacgymenvs": 0.02, "bayessim2021": 1 / 60}  # s
SPEED_SCALE, SPIN_SCALE, JOINT_SPEED_SCALE = 2.0, 0.25, 0.05
TRACKING, TURNING, TORQUE = 1.0, 0.5, 2.5e-5  # weights, per second
WIDTH = 0.25  # of tracking rewards, m^2/s^2 and rad^2/s^2

NAMES = (
    *(f"{kind}_{i}" for kind in ("velocity", "angular_velocity", "gravity") for i in "xyz"),
    *COMMANDS,
    *(f"{joint}_{kind}" for kind in ("position", "velocity", "action") for joint in JOINTS),
)


def _mirror() -> Mirror:
    """Left and right (y -> -y): hips' roll joints (HAA) turn the other way."""
    turned = ("velocity_y", "angular_velocity_x", "angular_velocity_z", "gravity_y", "command_y", "command_yaw")
    return Mirror(
        joints={j: "-" * j.endswith("HAA") + j.replace("L", "R", 1) for j in JOINTS if j.startswith("L")},
        observations={name: f"-{name}" for name in turned},
        task=("command_y", "command_yaw"),
        normal="y",
    )


class Anymal(Task):
    """48 observations: NAMES, speeds x 2, turning x 0.25, joints' places from HOME (rad), their speeds x 0.05 (rad/s).

    Actions: the joints' targets from HOME / 0.5 rad. The reward, all of it times the control step and never negative:
    exp(-|velocity error|^2 / 0.25) + 0.5 exp(-(turning error)^2 / 0.25) - 2.5e-5 |torques|^2.
    """

    control_dt: ClassVar[float] = STEP["isaacgymenvs"]
    default_episode_length: ClassVar[int] = 2500
    options: ClassVar[dict[str, Any]] = {"episodeLength": None}  # 50 s
    speed_limit: ClassVar[float] = 1000.0  # what explodes must not reach the critic
    observation_clip: ClassVar[dict[str, float | None]] = {"isaacgymenvs": 5.0, "bayessim2021": 100.0}
    observation_names: ClassVar[tuple[str, ...]] = NAMES
    mirror = (_mirror(),)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        model = self.mj_model
        guards = [i for i in range(model.ngeom) if model.geom(i).name.endswith("_guard")]
        self._guards, self._reach = np.array(guards), model.geom_size[guards, 0].astype(np.float32)

    def _read(self, config: Mapping[str, Any] | Any) -> dict[str, Any]:
        settings = super()._read(config)
        self.control_dt = STEP[settings["variant"]]  # type: ignore[misc]
        return settings | {"episodeLength": settings["episodeLength"] or round(SECONDS / self.control_dt)}

    def spec(self) -> mujoco.MjSpec:
        spec = mujoco.MjSpec.from_file(str(Path(__file__).with_name("anymal.xml")))
        spec.option.timestep = self.control_dt / 4
        return spec

    def initial(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_q, key_v = jax.random.split(key)
        joints = HOME * jax.random.uniform(key_q, (12,), minval=0.5, maxval=1.5)
        qvel = jax.random.uniform(key_v, (12,), minval=-0.1, maxval=0.1)
        return jnp.concatenate([jnp.array(START), joints]), jnp.concatenate([jnp.zeros(6), qvel])

    def start(self, key: jax.Array, world: World) -> dict[str, Any]:
        share = jax.random.uniform(key, (len(COMMANDS),), minval=-1.0, maxval=1.0)
        return {name: most * share[i] for i, (name, most) in enumerate(COMMANDS.items())}

    def command(self, action: jax.Array) -> jax.Array:
        return HOME + REACH * action

    def observe(self, world: World, data: mjx.Data, action: jax.Array) -> Observations:
        qpos, qvel = world.measurement["qpos"], world.measurement["qvel"]
        turn, commands = rotation(qpos[3:7]), jnp.stack([world.task[name] for name in COMMANDS])
        parts = [
            SPEED_SCALE * (turn.T @ qvel[:3]),
            SPIN_SCALE * qvel[3:6],  # MuJoCo's angular velocity of a free joint is in the body frame already
            -turn[2],
            jnp.array([SPEED_SCALE, SPEED_SCALE, SPIN_SCALE]) * commands,
            qpos[7:] - HOME,
            JOINT_SPEED_SCALE * qvel[6:],
            action,
        ]
        return {"policy": jnp.concatenate(parts)}

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        velocity, task = rotation(after.qpos[3:7]).T @ after.qvel[:3], after.task
        error = (task["command_x"] - velocity[0]) ** 2 + (task["command_y"] - velocity[1]) ** 2
        turning = (task["command_yaw"] - after.qvel[5]) ** 2
        cost = TORQUE * jnp.sum(data.qfrc_actuator[6:] ** 2)
        reward = TRACKING * jnp.exp(-error / WIDTH) + TURNING * jnp.exp(-turning / WIDTH) - cost
        fallen = jnp.any(data.geom_xpos[self._guards, 2] < self._reach)
        metrics = {"velocity_error": jnp.sqrt(error), "turning_error": jnp.sqrt(turning), "height": after.qpos[2]}
        return self.dt * jnp.maximum(reward, 0.0), fallen, metrics
