"""Channels that were not measured: which of them a log may lack, and what stands in their place."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import mujoco
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array, Channels
from bayessim_mjx.logs.proposal import hint
from bayessim_mjx.logs.table import Table


def filled(
    table: Table, columns: Mapping[str, Array], channels: Channels, mj_model: mujoco.MjModel
) -> tuple[dict[str, Array], tuple[str, ...]]:
    """(columns with the model's own position where none was measured, names of what was not measured).

    Velocities count as not measured only where some others were; without any they are derived from the positions.

    Raises:
        UserError: nothing was measured, a joint that the model lacks, only a part of a joint with several numbers, or
            no position of a free or ball joint.
    """
    absent = [f"qpos:{n}" for n in channels.qpos if f"qpos:{n}" not in columns]
    slow = [f"qvel:{n}" for n in channels.qvel if f"qvel:{n}" not in columns]
    absent += slow if len(slow) < len(channels.qvel) else []
    if not absent:
        return dict(columns), ()
    _known(table, channels)
    _whole_joints(table, absent, channels)
    if len(absent) == len(channels.qpos) and len(slow) == len(channels.qvel):
        raise UserError(
            f"{table.path}: no column qpos:<joint> or qvel:<joint>, so there is no motion to compare; it has "
            f"{', '.join(table.columns)}{hint(list(table.columns), mj_model)}"
        )
    home = dict(zip((f"qpos:{n}" for n in channels.qpos), mj_model.qpos0, strict=True))
    blank = {name: np.full(table.rows, home.get(name, 0.0)) for name in absent}
    positions = [name for name in absent if name.startswith("qpos:")]
    if positions:
        text = f"{table.path}: no column {', '.join(positions)}: this motion is estimated from what was measured"
        warnings.warn(text, stacklevel=4)
    return {**columns, **blank}, tuple(absent)


def _known(table: Table, channels: Channels) -> None:
    """Refuse columns of joints that the model lacks: a wrong name, not a joint without an encoder."""
    for stream, allowed in (("qpos", channels.qpos), ("qvel", channels.qvel)):
        for column in table.columns:
            if column.startswith(f"{stream}:") and column.partition(":")[2] not in allowed:
                names = ", ".join(f"{stream}:{n}" for n in allowed)
                raise UserError(f"{table.path}: column {column}: the model has no such joint; allowed: {names}")


def _whole_joints(table: Table, absent: list[str], channels: Channels) -> None:
    """Several numbers of one joint (a quaternion) are measured together, and its position is measured."""
    for joint, kind in zip(channels.joints, channels.kinds, strict=True):
        for stream in ("qpos", "qvel"):
            own = [f"{stream}:{n}" for n in channels.of_joint(joint, stream)]
            lost = [name for name in own if name in absent]
            needed = kind in ("free", "ball") and stream == "qpos"  # no such motion is estimated
            if lost and (needed or len(lost) < len(own)):
                text = f"{table.path}: missing column(s) {', '.join(lost)}"
                none = " (only hinges and slides may be without)" if needed else ", or none"
                raise UserError(f"{text}; allowed: all {len(own)} of joint {joint!r}{none}")
