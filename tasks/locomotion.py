"""Base of tasks of robots that walk, run or roll: starts, commands, observations, rewards, falls and mirrors by name.

A task of a robot of one's own is a class that names what its policy sees and what is paid: docs/own_walker.md.
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.env import Observations
from bayessim_mjx.errors import UserError
from bayessim_mjx.frames import rotation
from bayessim_mjx.mirrors import Mirror, joints_by_side
from bayessim_mjx.physics import World, mjx
from bayessim_mjx.tasks._parts import Parts, View
from bayessim_mjx.tasks._running import HEADING, LOADS, mirrored_loads
from bayessim_mjx.tasks._servos import resting, servos

__all__ = ["Locomotion", "View"]

COMMANDS = ("command_x", "command_y", "command_yaw")
NAMES = {  # of blocks that are not one number for each joint or foot
    "velocity": tuple(f"velocity_{i}" for i in "xyz"),
    "turning": tuple(f"angular_velocity_{i}" for i in "xyz"),
    "gravity": tuple(f"gravity_{i}" for i in "xyz"),
    "heading": HEADING,
}
OF_JOINTS = {"joints": "position", "scaled_joints": "position", "joint_speeds": "velocity", "joint_forces": "force"}
TURNED = {  # observations that change their sign in a mirror of left and right
    *("velocity_y", "angular_velocity_x", "angular_velocity_z", "gravity_y", "command_y", "command_yaw"),
    *("yaw", "roll", "angle_to_target"),
}


class Locomotion(Parts):
    """A task of a robot with a floating base; a subclass gives the model (`spec`) and these class variables.

    A block of observations is a method `observe_<block>(view)`, a part of the reward is a method `reward_<part>(view)`:
    those of this class, and those that a subclass adds.

    Attributes:
        observations: block -> the number (or one for each of its values) that multiplies it; in this order.
        rewards: part -> weight; the reward is their weighted sum.
        fallen_reward: the reward of the step in which the robot falls; None: as of any other.
        commands: command_x, command_y (m/s, in the base's axes), command_yaw (rad/s) -> the largest; each is drawn
            within +- this at reset.
        home: places of joints at reset (rad or m) by name; the others' is 0, or the nearest that their limits allow.
        spread, speed_spread: at reset, joints are within +- this of home (rad or m), and as fast (per second).
        reach: the command at the action 1, for all actuators or each: of a motor its control; of a position drive how
            far the target is from home (with a gear: gear times how far, as in MuJoCo's commands).
        lowest: height of the base (m), least_upright: cosine of its tilt, below which the robot has fallen.
        guards: geoms (spheres) of which none is in the ground z = 0 unless the robot has fallen; they need not collide.
        feet: bodies whose loads are observed.
        sides: what tells names of joints and feet of the left from those of the right; None: no mirror symmetry.
        own_names: block -> names of its values, for blocks of one's own with several.
        own_turned: which of these change their sign in the mirror.

    Raises:
        UserError: where the first joint does not float freely, no such joint, geom, block or part exists, or the
            command of a drive that pulls to a place is none (`<intvelocity>`).
    """

    observations: ClassVar[Mapping[str, float | Sequence[float]]]
    rewards: ClassVar[Mapping[str, float]] = {}
    fallen_reward: ClassVar[float | None] = None
    spread: ClassVar[float] = 0.0
    speed_spread: ClassVar[float] = 0.0
    reach: ClassVar[Any] = 1.0
    lowest: ClassVar[float | None] = None
    least_upright: ClassVar[float | None] = None
    guards: ClassVar[Sequence[str]] = ()
    sides: ClassVar[tuple[str, str] | None] = ("left", "right")
    own_names: ClassVar[Mapping[str, Sequence[str]]] = {}
    own_turned: ClassVar[Sequence[str]] = ()
    speed_limit: ClassVar[float] = 1000.0  # what explodes must not reach the critic

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        _check(self.name, "commands", self.commands, COMMANDS)
        _check(self.name, "rewards", self.rewards, _methods(self, "reward_"))
        _check(self.name, "guards", self.guards, [self.mj_model.geom(i).name for i in range(self.mj_model.ngeom)])
        geoms = [self.mj_model.geom(name).id for name in self.guards]
        self._guards, self._radii = np.array(geoms, int), self.mj_model.geom_size[geoms, 0].astype(np.float32)
        self._rest = self._targets_at_home()

    @functools.cached_property
    def observation_names(self) -> tuple[str, ...]:  # type: ignore[override]
        """Of all blocks."""
        _check(self.name, "observations", self.observations, _methods(self, "observe_"))
        return tuple(name for block in self.observations for name in self._names_of(block))

    def _names_of(self, block: str) -> Sequence[str]:
        if block in OF_JOINTS:
            return [f"{joint}_{OF_JOINTS[block]}" for joint in self.joints]
        if block == "actions":
            return [f"{actuator}_action" for actuator in self.actuator_names]
        if block == "foot_loads":
            return [f"{foot}_{load}" for foot in self.feet for load in LOADS]
        if block == "commands":
            return list(self.commands)
        return self.own_names.get(block) or NAMES.get(block) or (block,)

    @functools.cached_property
    def mirror(self) -> tuple[Mirror, ...]:  # type: ignore[override]
        """Left and right (y -> -y), by the names of joints and feet and by the axes of joints."""
        if self.sides is None:
            return ()
        turned = TURNED | {*self.own_turned}
        images = {name: f"-{name}" for name in self.observation_names if name in turned}
        if "foot_loads" in self.observations:
            images |= mirrored_loads(
                {foot: foot.replace(*self.sides, 1) for foot in self.feet if self.sides[0] in foot}
            )
        commands = tuple(name for name in self.commands if name in turned)
        return (Mirror(joints_by_side(self.mj_model, self.sides), images, normal="y", task=commands),)

    def _targets_at_home(self) -> np.ndarray | None:
        """Commands `[nu]` at the action 0 where an actuator is a position drive: those that hold it at home."""
        model, drives = self.mj_model, servos(self.mj_model, self.name)
        if not drives.any():
            return None
        data = mujoco.MjData(model)
        data.qpos[:] = np.concatenate([model.qpos0[:7], self.home_joints])
        mujoco.mj_fwdPosition(model, data)
        return np.where(drives, resting(model, data.actuator_length), 0).astype(np.float32)

    def initial(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Put the base where the model has it and at rest, joints near home."""
        key_q, key_v = jax.random.split(key)
        noise, speed = self.noise(key_q, self.spread), self.noise(key_v, self.speed_spread)
        base = jnp.asarray(self.mj_model.qpos0[:7], jnp.float32)
        joints = jnp.clip(self.home_joints + noise, *self.limits)
        return jnp.concatenate([base, joints]), jnp.concatenate([jnp.zeros(6), speed])

    def noise(self, key: jax.Array, spread: float) -> jax.Array:
        """One number within +- spread for each joint."""
        return jax.random.uniform(key, (len(self.joints),), minval=-spread, maxval=spread)

    def start(self, key: jax.Array, world: World) -> dict[str, Any]:
        share = jax.random.uniform(key, (len(self.commands),), minval=-1.0, maxval=1.0)
        return {name: most * share[i] for i, (name, most) in enumerate(self.commands.items())}

    def command(self, action: jax.Array) -> jax.Array:
        asked = np.asarray(self.reach, np.float32) * action
        return jnp.asarray(asked if self._rest is None else self._rest + asked)

    def observe(self, world: World, data: mjx.Data, action: jax.Array) -> Observations:
        qpos, qvel = world.measurement["qpos"], world.measurement["qvel"]
        view = View(world, qpos, qvel, rotation(qpos[3:7]), data, action, qpos)
        parts = [np.asarray(by, np.float32) * self._seen(block, view) for block, by in self.observations.items()]
        return {"policy": jnp.concatenate(parts)}

    def _seen(self, block: str, view: View) -> jax.Array:
        return jnp.atleast_1d(getattr(self, f"observe_{block}")(view))

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        """Sum the weighted parts, each a metric too."""
        view = View(after, after.qpos, after.qvel, rotation(after.qpos[3:7]), data, action, before.qpos)
        parts = {part: weight * getattr(self, f"reward_{part}")(view) for part, weight in self.rewards.items()}
        total, fallen = sum(parts.values(), jnp.zeros(())), self.fallen(view)
        if self.fallen_reward is not None:
            total = jnp.where(fallen, self.fallen_reward, total)
        return total, fallen, {f"reward_{part}": x for part, x in parts.items()} | {"height": after.qpos[2]}

    def fallen(self, view: View) -> jax.Array:
        """Whether the robot has fallen, which ends the episode."""
        found = jnp.zeros((), bool)
        if self.lowest is not None:
            found |= view.qpos[2] < self.lowest
        if self.least_upright is not None:
            found |= view.turn[2, 2] < self.least_upright
        if len(self._guards):
            found |= jnp.any(view.data.geom_xpos[self._guards, 2] < self._radii)
        return found


def _methods(task: Locomotion, prefix: str) -> list[str]:
    return sorted(name.removeprefix(prefix) for name in dir(type(task)) if name.startswith(prefix))


def _check(task: str, what: str, given: Mapping[str, Any] | Sequence[str], known: Sequence[str]) -> None:
    for name in given:
        if name not in known:
            raise UserError(f"{task}: {what} names {name!r}; there are: {', '.join(filter(None, known))}")
