"""Hinges whose readings lie whole turns away from their targets or from their range, and targets that wrap."""

from __future__ import annotations

import warnings
from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array, Channels
from bayessim_mjx.logs.table import Table

TURN = 2.0 * np.pi
HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
MOST = 0.95  # share of the rows that have to agree; rule of thumb, not measured
NEAR = 0.25 * TURN  # rad between a reading and its target, modulo a turn


def servos(
    model: mujoco.MjModel, through: NDArray[np.bool_], declared: NDArray[np.bool_] | None = None
) -> Iterator[tuple[int, int]]:
    """(actuator, joint) of the hinges whose logged command is the target of a position servo, in rad.

    Args:
        through: [nu], commands that go to the actuators as they are.
        declared: [nu], targets of a position law that the log declares.
    """
    joint_types = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    for i in range(model.nu):
        gain, bias = model.actuator_gainprm[i, 0], model.actuator_biasprm[i, 1]
        native = through[i] and model.actuator_gear[i, 0] == 1.0 and gain > 0 and np.isclose(bias, -gain)
        if int(model.actuator_trntype[i]) in joint_types and (native or (declared is not None and declared[i])):
            joint = int(model.actuator_trnid[i, 0])
            if int(model.jnt_type[joint]) == HINGE:
                yield i, joint


def placed(
    table: Table,
    columns: dict[str, Array],
    channels: Channels,
    model: mujoco.MjModel,
    through: NDArray[np.bool_],
    absent: tuple[str, ...] = (),
    declared: NDArray[np.bool_] | None = None,
) -> None:
    """Move readings and targets of hinges by whole turns in place, with a warning that says how to state it.

    Args:
        columns: channels [T]; positions are unwrapped already.
        through: [nu], commands that go to the actuators as they are.
        absent: channels that were not measured.
        declared: [nu], targets of a position law that the log declares.

    Raises:
        UserError: readings that are turns away from their targets for a part of the log only, or from their range in
            two ways.
    """
    followed = set()
    for i, j in servos(model, through, declared):
        reading, target = f"qpos:{channels.joints[j]}", f"ctrl:{channels.actuators[i]}"
        if reading in absent:
            continue
        on = columns.get(f"enabled:{channels.actuators[i]}")
        columns[target] = _unwrapped_target(table, target, columns[target], columns[reading])
        if _to_target(table, columns, reading, target, on):
            followed.add(j)
    for j, joint in enumerate(channels.joints):
        limited = model.jnt_limited[j] and int(model.jnt_type[j]) == HINGE
        if limited and j not in followed and f"qpos:{joint}" not in absent:
            _into_range(table, columns, f"qpos:{joint}", *map(float, model.jnt_range[j]))


def _unwrapped_target(table: Table, name: str, target: Array, reading: Array) -> Array:
    """Targets that jump by a turn, where the reading goes on without a jump."""
    jumps = np.abs(np.abs(np.diff(target)) - TURN) < 1.0
    if not jumps.any() or (np.abs(np.diff(reading)) > np.pi).any():
        return target
    smooth = np.unwrap(target)
    apart = [np.abs(x - TURN * np.round(np.median(x - reading) / TURN) - reading) for x in (target, smooth)]
    if np.mean(apart[1] < NEAR) < MOST or np.mean(apart[0] < NEAR) > np.mean(apart[1] < NEAR):
        return target
    where = table.where(int(np.flatnonzero(jumps)[0]) + 1)
    text = f"{table.path}: column {name!r} wraps by 2 pi {int(jumps.sum())} time(s), first at {where}"
    warnings.warn(f"{text}, and the joint turns on; unwrapped", stacklevel=5)
    return smooth


def _to_target(table: Table, columns: dict[str, Array], reading: str, target: str, on: Array | None) -> bool:
    """Move a reading to its target; return whether they are near each other now."""
    used = np.ones(len(columns[reading]), bool) if on is None else np.nan_to_num(on, nan=1.0) > 0.5
    apart = (columns[reading] - columns[target])[used]
    if not len(apart):
        return False
    turns = np.round(apart / TURN)
    near = np.abs(apart - TURN * turns) < NEAR
    by = int(np.median(turns))
    if np.mean(near) < MOST:
        return False
    if np.mean(turns == by) < MOST:
        row = int(np.flatnonzero(used)[int(np.argmax(turns != turns[0]))])
        text = f"{table.path}: column {reading!r}, {table.where(row)}: it is {turns[0]:.0f} turn(s) from {target!r} "
        more = f"before this row and {turns[turns != turns[0]][0]:.0f} after it"
        raise UserError(
            f"{text}{more}; allowed: one whole number of turns (mend it with `wrap` or `offset` in the map)"
        )
    if by:
        _move(table, columns, reading, by, f"{abs(by)} turn(s) from {target!r} throughout")
    return True


def _into_range(table: Table, columns: dict[str, Array], name: str, low: float, high: float) -> None:
    """Move a reading that lies outside its joint's range throughout, where whole turns bring all of it inside."""
    x, slack = columns[name], 0.02 * (high - low)
    if ((x >= low - slack) & (x <= high + slack)).mean() > 1.0 - MOST:
        return
    fits = [k for k in range(-16, 17) if x.min() + TURN * k >= low - slack and x.max() + TURN * k <= high + slack]
    if len(fits) > 1:
        offsets = " or ".join(f"`offset: {TURN * k:.6f}`" for k in fits)
        text = f"{table.path}: column {name!r} lies outside the model's range [{low:g}, {high:g}] throughout"
        raise UserError(f"{text}; more than one whole number of turns brings it inside: state {offsets} in the map")
    if fits:
        _move(table, columns, name, -fits[0], f"outside the model's range [{low:g}, {high:g}] throughout")


def _move(table: Table, columns: dict[str, Array], name: str, by: int, why: str) -> None:
    columns[name] = columns[name] - TURN * by
    text = f"{table.path}: column {name!r} is {why}; it is moved by {-by} turn(s)"
    stream, _, joint = name.partition(":")
    warnings.warn(f"{text} (in a map: {stream}: {{{joint}: {{..., offset: {-TURN * by:.6f}}}}})", stacklevel=6)


__all__ = ["placed", "servos"]
