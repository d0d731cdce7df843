"""The gate: refuse a log that cannot be meant, naming file, column and row; warn where it is only odd."""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Iterable, Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array, Channels, suggest
from bayessim_mjx.logs.signals import STEPS, noise_level
from bayessim_mjx.logs.stamps import coarseness
from bayessim_mjx.logs.table import Table
from bayessim_mjx.logs.turns import placed
from bayessim_mjx.logs.units import TIMES
from bayessim_mjx.quantities import percent

LARGEST = 1e15  # of a logged number: the sum of 1e8 squares of larger ones overflows float32
SHORTEST = 1e-6  # s between rows; rule of thumb, not measured
STREAMS = ("ctrl", "qpos", "qvel", "effort", "enabled")


def needed_columns(columns: Iterable[str], channels: Channels) -> list[str]:
    """Columns without which there is no log; velocities of all joints where one is there."""
    needed = ["time", *(f"ctrl:{n}" for n in channels.actuators), *(f"qpos:{n}" for n in channels.qpos)]
    velocities = [f"qvel:{n}" for n in channels.qvel]
    return needed + velocities if set(velocities) & set(columns) else needed


def check_names(table: Table, columns: Mapping[str, Array], channels: Channels) -> None:
    """Every name is known and nothing needed is missing.

    Raises:
        UserError: a name that is no joint or actuator, a missing column.
    """
    named = {
        "ctrl": channels.actuators,
        "qpos": channels.qpos,
        "qvel": channels.qvel,
        "effort": channels.actuators,
        "enabled": channels.actuators,
    }
    for column in columns:
        prefix, _, name = column.partition(":")
        if prefix in named and name and name not in named[prefix]:
            raise UserError(f"{table.path}: column {column!r}: {_kind(prefix)}; {suggest(name, named[prefix])}")
        near = difflib.get_close_matches(prefix.strip().lower(), [*STREAMS, "time"], n=1, cutoff=0.74)
        if prefix not in named and column != "time" and near and (name or near[0] == "time") and near[0] not in columns:
            right = f"{near[0]}:{name}" if name else near[0]
            raise UserError(f"{table.path}: unknown column {column!r}; did you mean {right!r}?")
    missing = [c for c in needed_columns(columns, channels) if c not in columns]
    if missing:
        if unmapped := [c for c in missing if c in table.columns]:
            way = "name each channel, also one whose column is called like it"
            raise UserError(f"{table.path}: the map leaves out {', '.join(unmapped)}, which the file has; {way}")
        names = ", ".join(table.columns)
        constant = "a joint that was not recorded can be held constant in the map (qpos: {<joint>: {value: 0.0}})"
        way = "`bayessim-mjx logs check DIR --model FILE` proposes a map of columns with other names"
        raise UserError(f"{table.path}: missing column(s) {', '.join(missing)}; it has {names}; {constant}; {way}")


def check_finite(table: Table, columns: Mapping[str, Array], channels: Channels) -> None:
    """Refuse what is needed and not finite.

    Raises:
        UserError: NaN, infinity, or a number too large to compute with.
    """
    for column in needed_columns(columns, channels):
        bad = np.flatnonzero(~(np.abs(columns[column]) < LARGEST))
        if len(bad):
            at = f"{table.path}: column {column!r}, {table.where(int(bad[0]))}: {columns[column][bad[0]]}"
            mend = "`bad_rows: drop` in a map leaves such rows out"
            raise UserError(f"{at} ({len(bad)} such row(s)); allowed: finite numbers below {LARGEST:g}; {mend}")


def _mend_of(time: Array) -> str:
    """Name the key of the map for stamps that stand still or run back."""
    grain = coarseness(time)
    if grain:
        rate = round((len(time) - 1) / max(float(time[-1] - time[0]), 1e-9), 3)
        text = f"; the stamps are {grain:g} s apart and many rows share each, about {rate:g} rows per second"
        return f"{text}: `time: {{column: ..., rate: ROWS_PER_SECOND}}` in a map spaces them evenly"
    if len(time) and (time == time[0]).all():
        return "; the stamps stand still, as where a program rounded them: `rate: ROWS_PER_SECOND` in place of `time`"
    lost = float(np.mean(time < np.maximum.accumulate(time)))
    if lost > 0.05:
        return f"; a clock that begins anew ({percent(lost)} of the rows come after it): cut the file there into two"
    return "; `bad_rows: drop` in a map leaves such rows out"


def _kind(prefix: str) -> str:
    return "no such joint" if prefix in ("qpos", "qvel") else "no such actuator"


def check_time(table: Table, time: Array, min_rows: int) -> None:
    """Time increases, in seconds, over enough rows.

    Raises:
        UserError: too few rows, time that stands or runs back, a period above one second.
    """
    if len(time) < min_rows:
        raise UserError(f"{table.path}: {len(time)} rows; allowed: at least {min_rows}")
    steps = np.diff(time)
    back = np.flatnonzero(steps <= 0)
    if len(back):
        row = int(back[0]) + 1
        at = f"{table.path}: column 'time', {table.where(row)}: {time[row]:.9g} s after {time[row - 1]:.9g} s"
        raise UserError(f"{at} ({len(back)} such row(s)); allowed: strictly increasing time{_mend_of(time)}")
    period = float(np.median(steps))
    if period < SHORTEST:
        text = f"{table.path}: column 'time': median step {period:.4g} s"
        mend = "days, h or min: `time: {column: time, unit: days}` in the map"
        raise UserError(f"{text}; allowed: seconds, at least {SHORTEST:g} s per row ({mend})")
    if period > 1.0:
        text = f"{table.path}: column 'time': median step {period:.4g} s"
        names = {"ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
        fits = [u for u in names if 1e-4 <= period * TIMES[u] <= 10.0] or ["ms"]
        mends = (f"{names[u]}: `time: {{column: time, unit: {u}}}`, the same as scale: {TIMES[u]:g}" for u in fits)
        mend = f"{' or '.join(mends)} in the map"
        raise UserError(f"{text}; allowed: seconds, up to 1 s per row ({mend})")
    local = median_filter(steps, 101, mode="nearest")  # a file may change its rate
    jitter = float(np.mean(np.abs(steps / local - 1.0) > 0.2))
    if jitter > 0.1:
        text = (
            f"{table.path}: column 'time': {percent(jitter)} of the steps are more than 20 % off the median around them"
        )
        warnings.warn(text, stacklevel=3)


def check_motion(
    table: Table,
    columns: dict[str, Array],
    channels: Channels,
    mj_model: mujoco.MjModel,
    through: NDArray[np.bool_],
    absent: tuple[str, ...] = (),
    declared: NDArray[np.bool_] | None = None,
) -> None:
    """Angles are continuous, quaternions have norm 1, commands fit the actuator. Unwraps hinges in place, warning.

    Hinges that lie whole turns away from their targets or their range are moved (`turns.placed`).

    Args:
        through: [nu], the logged command is the actuator's own and no controller's.
        absent: channels that were not measured.
        declared: [nu], the logged command is the target of a position law that the log declares.

    Raises:
        UserError: jumps no joint makes, registers read with the wrong sign or unit.
    """
    for joint, kind in zip(channels.joints, channels.kinds, strict=True):
        if kind == "hinge":
            columns[f"qpos:{joint}"] = _unwrapped(table, joint, columns[f"qpos:{joint}"])
        if kind in ("ball", "free"):
            quat = [f"qpos:{c}" for c in channels.of_joint(joint)[-4:]]
            turned = _quaternion(table, joint, np.stack([columns[c] for c in quat], 1))
            columns.update(zip(quat, turned.T, strict=True))
            _says_order(table, joint, turned, mj_model.qpos0[channels.columns(joint)][-4:])
    placed(table, columns, channels, mj_model, through, absent, declared)
    for i, (joint, kind) in enumerate(zip(channels.joints, channels.kinds, strict=True)):
        if kind in ("hinge", "slide") and mj_model.jnt_limited[i]:
            _inside(table, f"qpos:{joint}", columns[f"qpos:{joint}"], mj_model.jnt_range[i], "range", 0.5)
    for i, actuator in enumerate(channels.actuators):
        column, x = f"ctrl:{actuator}", columns[f"ctrl:{actuator}"]
        jump = np.flatnonzero(np.abs(np.abs(np.diff(x)) - 65536.0) < 2000.0)
        if len(jump):
            row = int(jump[0])
            at = f"{table.path}: column {column!r}, {table.where(row + 1)}: jump from {x[row]:g} to {x[row + 1]:g}"
            raise UserError(f"{at}: a signed 16-bit register read as unsigned; allowed: `signed: 16` in the map")
        if mj_model.actuator_ctrllimited[i] and through[i]:
            _inside(table, column, x, mj_model.actuator_ctrlrange[i], "ctrlrange", 0.01)


def _unwrapped(table: Table, joint: str, q: Array) -> Array:
    steps = np.diff(q)
    jumps = np.flatnonzero(np.abs(steps) > np.pi)
    if not len(jumps):
        return q
    turns = np.abs(np.abs(steps[jumps]) - 2 * np.pi) < 1.0
    if not turns.all():
        row = int(jumps[np.argmin(turns)])
        at = f"{table.path}: column 'qpos:{joint}', {table.where(row + 1)}"
        text = f"{at}: jump from {q[row]:.6g} to {q[row + 1]:.6g} rad in one step; allowed: below pi"
        mend = "degrees: `unit: deg`, counts: `unit: counts` with `resolution`, a wrapped encoder: `wrap`"
        raise UserError(f"{text} ({mend}, another unit: `scale` in the map)")
    _is_a_turn(table, joint, q, jumps)
    where = table.where(int(jumps[0]) + 1)
    warnings.warn(
        f"{table.path}: column 'qpos:{joint}' wraps by 2 pi {len(jumps)} time(s), first at {where}; unwrapped",
        stacklevel=4,
    )
    return np.unwrap(q)


def _is_a_turn(table: Table, joint: str, q: Array, jumps: NDArray[np.int64]) -> None:
    """Refuse angles that jump by another period than a turn, as registers that run over do."""
    steps = np.diff(q)
    beside = np.stack([steps[np.clip(jumps + k, 0, len(steps) - 1)] for k in (-1, 1)])
    plain = np.abs(beside) < np.pi
    if not plain.any(axis=0).all():
        return
    motion = np.sum(np.where(plain, beside, 0.0), axis=0) / plain.sum(axis=0)
    period = float(np.median(np.abs(steps[jumps] - motion)))
    slack = float(np.abs(np.where(plain, beside, 0.0)).max()) + STEPS * noise_level(
        q
    )  # a joint moves on by a step or so
    if abs(period - 2.0 * np.pi) > slack:
        at = f"{table.path}: column 'qpos:{joint}', {table.where(int(jumps[0]) + 1)}"
        mend = "`wrap: PERIOD` in raw units in the map lets a register go on"
        raise UserError(f"{at}: it jumps by {period:.6g}, not by 2 pi; {mend}")


def _quaternion(table: Table, joint: str, q: Array) -> Array:
    """Norm 1 and without sign flips (q and -q are the same attitude)."""
    norm = np.linalg.norm(q, axis=1)
    bad = np.flatnonzero(np.abs(norm - 1.0) > 0.01)
    if len(bad):
        at = f"{table.path}: quaternion of joint {joint!r}, {table.where(int(bad[0]))}: norm {norm[bad[0]]:.4g}"
        raise UserError(f"{at}; allowed: norm 1 within 0.01, in the order w x y z")
    flips = np.cumprod(np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0))
    return q / norm[:, None] * np.concatenate([[1.0], flips])[:, None]


def _says_order(table: Table, joint: str, q: Array, home: Array) -> None:
    """Warn of quaternions more than a quarter turn from the model's pose throughout, but not in the order x y z w."""
    here, other = (2.0 * np.arccos(np.clip(np.abs(x @ home), 0.0, 1.0)) for x in (q, q[:, [3, 0, 1, 2]]))
    if (here > 0.5 * np.pi).all() and (other < 0.5 * np.pi).all():
        least = f"{np.degrees(here).min():.0f} degrees or more"
        text = f"{table.path}: quaternion of joint {joint!r} is {least} from the model's"
        key = f"`qpos: {{{joint}[3]: COLUMN_OF_W, {joint}[4]: COLUMN_OF_X, ...}}`"
        warnings.warn(f"{text} pose; it may be in the order x y z w: {key} in a map names its columns", stacklevel=4)


def _inside(table: Table, column: str, x: Array, bounds: Array, what: str, tolerance: float) -> None:
    """Warn where x leaves the model's range; refuse where it is a hundred times too large (a unit)."""
    low, high = map(float, bounds)
    outside = np.flatnonzero((x < low - tolerance * (high - low)) | (x > high + tolerance * (high - low)))
    if not len(outside):
        return
    worst = int(outside[np.argmax(np.abs(x[outside]))])
    at = f"{table.path}: column {column!r}, {table.where(worst)}"
    text = f"{at}: {x[worst]:.6g} is outside the model's {what} [{low:g}, {high:g}]"
    if abs(x[worst]) > 20.0 * max(abs(low), abs(high)):
        raise UserError(f"{text} by far; allowed: the model's unit (mend it with `unit` or `scale` in the map)")
    warnings.warn(
        f"{text} ({len(outside)} row(s)); the simulation will clamp it" if what == "ctrlrange" else text, stacklevel=4
    )
