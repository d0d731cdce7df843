"""Controllers between a logged command and the actuators: firmware loops that a log's metadata declares."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters.attributes import suggest

ALIASES = {
    "direct": "direct", "torque": "direct", "force": "direct", "effort": "direct", "voltage": "direct",
    "duty": "direct", "position": "position", "pd": "position", "p": "position", "velocity": "velocity",
}  # fmt: skip
_ALLOWED = {
    "kp": "a finite number > 0",
    "kd": "a finite number >= 0",
    "limit": "a number > 0",
    "scale": "a finite number, not 0",
}
KEYS = ("law", "kp", "kd", "limit", "scale", "note")  # note: for people
NO_INTEGRAL = (
    "allowed: 0 (no integral term is simulated), or the output of the loop in the columns `ctrl:`, with law: direct"
)


class Law(struct.PyTreeNode):
    """One controller per actuator, `[nu]` each; vmapped worlds may have different gains.

    direct:   u = scale c
    position: u = clip(scale (kp (c - q) - kd w), +-limit)
    velocity: u = clip(scale kp (c - w), +-limit)
    q, w are as the joint's own encoder shows them, `Physics.encoders`.
    """

    on_position: jax.Array
    on_velocity: jax.Array
    kp: jax.Array
    kd: jax.Array
    limit: jax.Array
    scale: jax.Array
    qadr: tuple[int, ...] = struct.field(pytree_node=False)
    dadr: tuple[int, ...] = struct.field(pytree_node=False)

    @property
    def through(self) -> jax.Array:
        """`[nu]` bool, the command is the actuator's own ctrl."""
        return (self.on_position + self.on_velocity == 0) & (self.scale == 1)

    def __call__(self, command: jax.Array, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        """Command `[nu]` -> ctrl `[nu]`; qpos `[nq]`, qvel `[nv]` as shown."""
        q, w = qpos[jnp.asarray(self.qadr)], qvel[jnp.asarray(self.dadr)]
        position = self.kp * (command - q) - self.kd * w
        velocity = self.kp * (command - w)
        loop = jnp.where(self.on_position > 0, position, velocity) * self.scale
        closed = (self.on_position + self.on_velocity) > 0
        return jnp.where(closed, jnp.clip(loop, -self.limit, self.limit), command * self.scale)


def declared(metadata: Mapping[str, Any]) -> bool:
    """Whether a log's metadata declares a controller that is not simply direct."""
    given = metadata.get("controller")
    if not isinstance(given, Mapping):
        return False
    blocks = [b for b in given.values() if isinstance(b, Mapping)] or [given]
    return any(ALIASES.get(str(b.get("law", "direct")).lower()) != "direct" or "scale" in b for b in blocks)


def read(metadata: Mapping[str, Any], model: mujoco.MjModel, actuators: Sequence[str], source: str) -> Law:
    """Return the law of one log: `controller: {law, kp, kd, limit, scale}`, numbers or one per actuator by name.

    Args:
        metadata: of the log.
        model: its actuators drive the joints whose angles the loops close on.
        actuators: the model's, by name.
        source: the log's file, for errors.

    Raises:
        UserError: unknown key, law or actuator; a position law without kp; an actuator that drives no joint.
    """
    given = metadata.get("controller") or {}
    if not isinstance(given, Mapping):
        raise UserError(f"{source}: controller = {given!r}; allowed: a mapping with {', '.join(KEYS)}")
    rows = [_of_actuator(given, name, actuators, source) for name in actuators]
    on_joint = model.actuator_trntype <= int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    joint_of = np.where(on_joint, model.actuator_trnid[:, 0], -1)
    for row, name, joint in zip(rows, actuators, joint_of, strict=True):
        if row["law"] != "direct" and joint < 0:
            raise UserError(f"{source}: controller.law = {row['law']} of actuator {name!r}, which drives no joint")
    joint_of = np.maximum(joint_of, 0)

    def column(key: str) -> jax.Array:
        return jnp.asarray([float(row[key]) for row in rows], jnp.float32)

    return Law(
        on_position=jnp.asarray([float(r["law"] == "position") for r in rows], jnp.float32),
        on_velocity=jnp.asarray([float(r["law"] == "velocity") for r in rows], jnp.float32),
        kp=column("kp"),
        kd=column("kd"),
        limit=column("limit"),
        scale=column("scale"),
        qadr=tuple(int(i) for i in model.jnt_qposadr[joint_of]),
        dadr=tuple(int(i) for i in model.jnt_dofadr[joint_of]),
    )


def of_logs(logs: Sequence[Any], model: mujoco.MjModel) -> Law | None:
    """Return the laws of several logs, leaves `[logs, nu]`; None where all commands go to the actuators as they are.

    Raises:
        UserError: as `read`.
    """
    if not any(declared(log.metadata) for log in logs):
        return None
    each = [read(log.metadata, model, log.actuators, str(log.metadata.get("source", log.name))) for log in logs]
    return jax.tree.map(lambda *x: jnp.stack(x), *each)


def _of_actuator(given: Mapping[str, Any], name: str, actuators: Sequence[str], source: str) -> dict[str, Any]:
    blocks = {k: v for k, v in given.items() if isinstance(v, Mapping)}
    for key in blocks:
        if key not in actuators:
            raise UserError(f"{source}: controller.{key}: no such actuator; {suggest(str(key), actuators)}")
    own = {**{k: v for k, v in given.items() if k not in blocks}, **blocks.get(name, {})}
    if own.get("ki") not in (None, 0):
        raise UserError(f"{source}: controller.ki = {own['ki']!r}; {NO_INTEGRAL}")
    for key in own:
        if key not in (*KEYS, "ki"):
            raise UserError(f"{source}: controller.{key}: {suggest(str(key), [*KEYS, *actuators])}")
    law = str(own.get("law", "direct")).lower()
    if law not in ALIASES:
        hint = f"{suggest(law, ALIASES)} (words for people belong in controller.note)"
        raise UserError(f"{source}: controller.law = {own['law']!r}: {hint}")
    row: dict[str, Any] = {"law": ALIASES[law], "kp": 0.0, "kd": 0.0, "limit": np.inf, "scale": 1.0}
    for key in ("kp", "kd", "limit", "scale"):
        if own.get(key) is None:
            continue
        if ALIASES[law] == "direct" and key != "scale":
            raise UserError(
                f"{source}: controller.{key} = {own[key]!r} without a loop; allowed: law: position or velocity"
            )
        try:
            row[key] = float(own[key])
        except (TypeError, ValueError):
            raise UserError(f"{source}: controller.{key} = {own[key]!r}; allowed: a number") from None
        good = {"kp": row["kp"] > 0, "kd": row["kd"] >= 0, "limit": row["limit"] > 0, "scale": row["scale"] != 0}[key]
        if isinstance(own[key], bool) or not good or (key != "limit" and not np.isfinite(row[key])):
            raise UserError(f"{source}: controller.{key} = {own[key]!r}; allowed: {_ALLOWED[key]}")
    if row["law"] != "direct" and not row["kp"] > 0:
        raise UserError(f"{source}: controller.law = {row['law']} of actuator {name!r} needs kp > 0, has {row['kp']:g}")
    return row


# What acts on a world besides its command and its effects


class Drive(struct.PyTreeNode):
    """What acts on a world besides its command, all optional.

    Attributes:
        force: `[nv]`, a generalised force of unknown origin.
        enabled: `[nu]`, 1 where the drive is on; 0: the actuator exerts no force at all (open leads), and a joint whose
            actuators are all off has no gravity compensation from them either (`actuatorgravcomp`).
        law: a controller between the command and the actuators; what it asks for is held over a timestep.
        active: `[effects]`, False where an effect is neutral in every world of the call, so that its hooks need not be
            computed (`physics.model.gated`).
    """

    force: jax.Array | None = None
    enabled: jax.Array | None = None
    law: Law | None = None
    active: jax.Array | None = None
