"""What tasks of arms and hands share: targets of joints that actions move, poses of frames, and rewards for both.

A task of an arm of one's own is a class that names a home pose and the sites of its MJCF: docs/own_task.md.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.physics import World, mjx
from bayessim_mjx.tasks._rate_control import RateControlled
from bayessim_mjx.tasks._servos import resting, servos


class Pose(NamedTuple):
    """Where a frame is: position `[3]`, m; turn `[3, 3]`, its axes as columns. World axes."""

    position: jax.Array
    turn: jax.Array


class Manipulation(RateControlled):
    """A task of position drives on joints; a subclass also gives the model, `observe` and `reward`.

    Attributes:
        home: the place of each joint at reset (rad or m), by name; joints that are left out start at qpos0.
        spread: at reset, joints with a drive start within +-spread of home (rad or m), inside their limits.
        rates: of each drive's target at the action 1, per second: targets move by dt * rate * action. None: an action
            is a place in the drive's range, from -1 (its lower end) to 1. Targets are MuJoCo's commands: with a gear,
            gear times the joint's place.
        smoothing: share of what is asked for in the new target, where actions are places; 1: all of it.

    Raises:
        UserError: where an actuator is no position drive of a hinge or slide, or home names no such joint.
    """

    home: ClassVar[Mapping[str, float]] = {}
    spread: ClassVar[float] = 0.0
    rates: ClassVar[Sequence[float] | None] = None  # type: ignore[assignment]  # None: places
    smoothing: ClassVar[float] = 1.0

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        model = self.mj_model
        self.driven = _driven(model, self.name)
        self._home = _home(model, self.home, self.name)

    def initial(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Take the home pose, joints with a drive anew within +-spread; at rest."""
        return self.near_home(key), jnp.zeros(self.mj_model.nv)

    def near_home(self, key: jax.Array) -> jax.Array:
        """qpos `[nq]` of a new episode."""
        home, (low, high) = self._home[self.driven], self.limits
        noise = jax.random.uniform(key, home.shape, minval=-self.spread, maxval=self.spread)
        return jnp.asarray(self._home).at[self.driven].set(jnp.clip(home + noise, low, high))

    def at_rest(self, qpos: jax.Array) -> jax.Array:
        """Targets at the start of an episode: those at which the drives rest where the joints are."""
        return resting(self.mj_model, self.mj_model.actuator_gear[:, 0].astype(np.float32) * qpos[self.driven])

    def actuate(self, world: World, action: jax.Array) -> tuple[World, jax.Array]:
        if self.rates is not None:
            return super().actuate(world, action)
        low, high = self.mj_model.actuator_ctrlrange.T.astype(np.float32)
        asked, last = low + 0.5 * (action + 1) * (high - low), world.task["command"]
        command = last + self.smoothing * (asked - last)
        return world.replace(task=world.task | {"command": command}), command

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper ends `[nu]` of the joints with a drive; infinite where there are none."""
        joints = self.mj_model.actuator_trnid[:, 0]
        given = self.mj_model.jnt_limited[joints].astype(bool)
        low, high = self.mj_model.jnt_range[joints].astype(np.float32).T
        return np.where(given, low, -np.inf), np.where(given, high, np.inf)

    def scaled_joints(self, qpos: jax.Array) -> jax.Array:
        """Places `[nu]` of the joints with a drive: -1 at the lower and 1 at the upper limit."""
        low, high = self.limits
        return (2 * qpos[self.driven] - high - low) / (high - low)

    def frames(self, world: World, *sites: str, measured: bool = False) -> tuple[Pose, ...]:
        """Poses of these sites in the world's state; measured: where the robot's sensors say that they are.

        Those in the `data` of a step are one timestep old.
        """
        shown = world.replace(qpos=world.measurement["qpos"]) if measured else world
        data = self.physics.kinematics(shown)
        return tuple(_frame(data, self.mj_model.site(name).id) for name in sites)


def closeness(distance: jax.Array, near: float = 0.0) -> jax.Array:
    """1 / (1 + distance^2)^2, doubled from `near` (m) on: 2 at the place itself, 1 just outside of `near`."""
    reward = 1 / (1 + distance**2) ** 2
    return jnp.where(distance <= near, 2 * reward, reward)


def alignment(one: jax.Array, two: jax.Array | np.ndarray) -> jax.Array:
    """How much two unit vectors `[3]` agree: their cosine squared, with its sign."""
    cosine = one @ two
    return jnp.sign(cosine) * cosine**2


def angle_between(one: jax.Array, two: jax.Array) -> jax.Array:
    """Angle of the rotation that takes one orientation `[3, 3]` to another, rad, 0 to pi."""
    between = one.T @ two
    axis = jnp.stack([between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1]])
    return jnp.arctan2(jnp.sqrt(jnp.sum(axis**2) + 1e-12), jnp.trace(between) - 1)


def _frame(data: mjx.Data, site: int) -> Pose:
    return Pose(data.site_xpos[site], data.site_xmat[site])


def _driven(model: mujoco.MjModel, task: str) -> np.ndarray:
    """Places in qpos `[nu]` of the joints with a drive."""
    kinds = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    joint = int(mujoco.mjtTrn.mjTRN_JOINT)
    drives = servos(model, task)
    for i in range(model.nu):
        name = model.actuator(i).name or f"#{i}"
        if model.actuator_trntype[i] != joint or model.jnt_type[model.actuator_trnid[i, 0]] not in kinds:
            raise UserError(f"{task}: actuator {name} has to drive a hinge or a slide by name: <position joint=...>")
        if not drives[i]:
            raise UserError(f"{task}: actuator {name} pulls to no place; it has to be a position drive: <position>")
    return np.asarray(model.jnt_qposadr[model.actuator_trnid[:, 0]])


def _home(model: mujoco.MjModel, places: Mapping[str, float], task: str) -> np.ndarray:
    """qpos `[nq]` of the home pose."""
    home = model.qpos0.astype(np.float32)
    known = {model.joint(i).name: int(model.jnt_qposadr[i]) for i in range(model.njnt)}
    for name, place in places.items():
        if name not in known:
            raise UserError(f"{task}: home names the joint {name!r}; there are: {', '.join(known)}")
        home[known[name]] = place
    return home
