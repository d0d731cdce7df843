"""Readings that no robot makes: jumps between calm rows, bases that fly off, inertial units in other units."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import inertial
from bayessim_mjx.logs.log import Array, Channels
from bayessim_mjx.logs.mapping import LogMap
from bayessim_mjx.logs.signals import COUNTS, STEPS, noise_level, quantum
from bayessim_mjx.logs.table import Table

G = 9.80665  # m/s^2, standard gravity: the unit g. Source: CGPM 1901
DEGREE = np.pi / 180.0
# times the largest step beside it, from which a step is a jump; benchmarks/records/log_checks.json
SUDDEN = 5.0
FAST, HIGH = 30.0, 100.0  # m/s and m of a robot's base: rules of thumb, a legged robot in mm is beyond one of them
HALF = 0.5  # share of the rows, and of a unit's size: which of two readings is the nearer one. Source: the middle


def check_plausible(
    table: Table,
    columns: Mapping[str, Array],
    channels: Channels,
    model: mujoco.MjModel,
    log_map: LogMap,
    absent: tuple[str, ...],
) -> None:
    """Jumps, bases and inertial units; `absent` are channels that were not measured.

    Raises:
        UserError: an inertial unit in another unit.
    """
    stated = frozenset(name for name, source, _ in log_map.channels() if source.stated)
    say_jumps(table, columns, channels, absent)
    check_base(table, columns, channels, model, absent)
    check_inertial(table, columns, channels, stated, absent)


def say_jumps(table: Table, columns: Mapping[str, Array], channels: Channels, absent: tuple[str, ...] = ()) -> None:
    """Warn where a hinge or slide jumps between calm rows: an encoder that begins anew, or samples that are off.

    A step counts that is `SUDDEN` times the two steps before and after it, and above the noise, at rows that are not
    further apart than usual.
    """
    time = columns["time"]
    apart = np.diff(time)
    even = apart <= 1.5 * float(np.median(apart))
    for joint, kind in zip(channels.joints, channels.kinds, strict=True):
        name = f"qpos:{joint}"
        if kind not in ("hinge", "slide") or name in absent or len(time) < 8:
            continue
        x = columns[name]
        found = np.flatnonzero(_sudden(x) & even)
        if len(found):
            row = int(found[0])
            text = (
                f"{table.path}: column {name!r}, {table.where(row + 1)}: it jumps from {x[row]:.6g} to {x[row + 1]:.6g}"
            )
            why = "between calm rows, as where an encoder begins anew or samples are lost"
            mend = "cut the file there, or leave such rows out"
            warnings.warn(f"{text} {why} ({len(found)} such step(s)); {mend}", stacklevel=3)


def _sudden(x: Array) -> NDArray[np.bool_]:
    """Say which steps [T - 1] of x are jumps; of a sample that is off it is both."""
    steps = np.abs(np.diff(x))
    across = np.abs(x[2:] - x[:-2])
    usual = max(STEPS * noise_level(x), COUNTS * quantum(x))
    large = np.pad(steps, 2)
    near = np.max([large[0:-4], large[1:-3], large[3:-1], large[4:]], axis=0)
    alone = steps > np.maximum(usual, SUDDEN * near)
    outer = np.max([large[1:-4], large[4:-1]], axis=0)  # beside a pair of steps, away and back
    calm = np.maximum(usual, SUDDEN * np.maximum(outer, across))
    pair = (steps[:-1] > calm) & (steps[1:] > calm)
    found = alone | np.r_[pair, False] | np.r_[False, pair]
    found[:2] = found[-2:] = False  # calm rows on one side alone
    return np.asarray(found)


def check_base(
    table: Table, columns: Mapping[str, Array], channels: Channels, model: mujoco.MjModel, absent: tuple[str, ...] = ()
) -> None:
    """Warn of a floating base that flies off, as in mm, or that lies below the model's ground, as with y upwards."""
    time = columns["time"]
    flat = [g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_PLANE
            and model.geom_bodyid[g] == 0 and abs(model.geom_quat[g, 0]) > 1.0 - 1e-6]  # fmt: skip
    for joint, kind in zip(channels.joints, channels.kinds, strict=True):
        if kind != "free" or f"qpos:{channels.of_joint(joint)[0]}" in absent:
            continue
        place = np.stack([columns[f"qpos:{c}"] for c in channels.of_joint(joint)[:3]], 1)
        steps = np.linalg.norm(np.diff(place, axis=0), axis=1)
        speed, height = float(np.median(steps / np.diff(time))), float(np.median(np.abs(place[:, 2])))
        text = f"{table.path}: the base {joint!r}"
        if speed > FAST or height > HIGH:
            key = f"`qpos: {{{joint}[0]: {{column: ..., unit: mm}}, ...}}`"
            text = f"{text} is at a height of {height:.4g} m and moves by {speed:.4g} m/s (medians)"
            warnings.warn(f"{text}; mm would need {key} in a map", stacklevel=3)
        elif flat and np.mean(place[:, 2] < min(model.geom_pos[g, 2] for g in flat)) > HALF:
            keys = f"`qpos: {{{joint}[1]: {{column: COLUMN_OF_Z, sign: -1}}, {joint}[2]: COLUMN_OF_Y, ...}}`"
            text = f"{text} is below the model's ground in most rows; with y upwards a map names the columns otherwise"
            warnings.warn(f"{text} ({keys}, and the quaternion likewise); with another origin `offset`", stacklevel=3)


def check_inertial(
    table: Table, columns: Mapping[str, Array], channels: Channels, stated: frozenset[str], absent: tuple[str, ...] = ()
) -> None:
    """Accelerometers are in m/s^2 and gyroscopes in rad/s, as far as gravity and the base's own turning show it.

    Args:
        columns: channels [T]. stated: those whose unit a map states. absent: channels that were not measured.

    Raises:
        UserError: an accelerometer whose median is one g as a number, or a gyroscope that turns as the base in degrees.
    """
    for kind, names in _units(columns):
        if stated & set(names):
            continue
        size = np.linalg.norm(np.stack([columns[n] for n in names], 1), axis=1)
        size = size[np.isfinite(size)]
        if not len(size):
            continue
        if kind == "accel" and HALF < float(np.median(size)) < 1.0 / HALF:
            _other_unit(table, names, f"a median of {np.median(size):.3g}, which gravity makes in g", f"scale: {G}")
        turning = _turning(columns, channels, absent)
        if kind == "gyro" and turning is not None:
            ratio = float(np.sqrt(np.mean(size**2))) / max(turning, 1e-9)
            if turning > 10.0 * DEGREE and HALF < ratio * DEGREE < 1.0 / HALF:
                _other_unit(table, names, f"{ratio:.3g} times the turning of the base", "unit: deg/s")


def _units(columns: Mapping[str, Array]) -> Iterator[tuple[str, list[str]]]:
    """(kind, its three columns) of each gyroscope and accelerometer."""
    found: dict[tuple[str, str], list[str]] = {}
    for name in columns:
        own = inertial.column(name)
        if own is not None and own[0] in ("gyro", "accel"):
            found.setdefault(own[:2], []).append(name)
    yield from ((kind, names) for (kind, _), names in found.items() if len(names) == inertial.SIZES[kind])


def _turning(columns: Mapping[str, Array], channels: Channels, absent: tuple[str, ...]) -> float | None:
    """Root mean square of the turning rate [rad/s] of the only floating base whose pose was measured, or None."""
    free = [j for j, kind in zip(channels.joints, channels.kinds, strict=True) if kind == "free"]
    names = [f"qpos:{c}" for c in channels.of_joint(free[0])[-4:]] if len(free) == 1 else []
    if not names or set(names) & set(absent):
        return None
    quat = np.stack([columns[n] for n in names], 1)
    angle = 2.0 * np.arccos(np.clip(np.abs(np.sum(quat[1:] * quat[:-1], axis=1)), 0.0, 1.0))
    return float(np.sqrt(np.mean((angle / np.diff(columns["time"])) ** 2)))


def _other_unit(table: Table, names: list[str], why: str, key: str) -> None:
    text = f"{table.path}: columns {names[0]!r} ... have {why}; allowed: {inertial.UNITS[names[0].split(':')[0]]}"
    entry = f"`streams: {{'{names[0]}': {{column: ..., {key}}}, ...}}`"
    raise UserError(f"{text}; {entry} in a map converts them, and `scale: 1` keeps them")


__all__ = ["check_base", "check_inertial", "check_plausible", "say_jumps"]
