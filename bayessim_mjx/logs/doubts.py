"""Units and clocks that nobody stated, where names, values or the motion say that they are others."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import units
from bayessim_mjx.logs.log import Array, Channels
from bayessim_mjx.logs.mapping import LogMap, Source
from bayessim_mjx.logs.signals import LEVELS, values_shown
from bayessim_mjx.logs.stamps import WINDOW, better_clock, coarseness
from bayessim_mjx.logs.table import Table
from bayessim_mjx.logs.turns import TURN, servos

DEGREE = units.ANGLES["deg"]
PLAIN = ("rad", "m", "rad/s", "m/s", "N m", "N", "V", units.PLAIN, None)
# Rules of thumb. Of 60 files in degrees 30 are refused and 30 warned of: benchmarks/records/log_checks.json
FAR = 3.0  # times a joint's range, which readings in the model's unit never reach, however loose the range is
ALIKE = 0.8  # correlation from which a joint follows its target; rule of thumb, see FAR
RATIO = 1.25  # within which a ratio of amplitudes is that of two units; rule of thumb, see FAR


def check_units(
    table: Table,
    columns: Mapping[str, Array],
    channels: Channels,
    model: mujoco.MjModel,
    log_map: LogMap,
    through: NDArray[np.bool_],
    declared: NDArray[np.bool_] | None = None,
) -> None:
    """Channels are in the model's units, or the map states theirs.

    Args:
        columns: channels [T] in the model's units, as far as the map states them.
        through: [nu], commands that go to the actuators as they are.
        declared: [nu], targets of a position law that the log declares.

    Raises:
        UserError: another unit in a column's name, a unit of another kind than the joint, values that fit the joint
            or its target in another unit only; names the keys of the map.
    """
    sources = {name: source for name, source, _ in log_map.channels()}
    of = {name: source.name(table, name) for name, source in sources.items() if source.value is None}
    kinds = dict(zip(channels.joints, channels.kinds, strict=True))
    followed = dict(servos(model, through, declared))
    for name, source in sources.items():
        stream, _, own = name.partition(":")
        if source.value is None and stream in ("ctrl", "qpos", "qvel"):
            _kind(log_map, name, source, kinds.get(own, ""))
            _by_name(table, log_map, name, source, followed, channels)
        if stream == "ctrl" and through[channels.actuators.index(own)]:
            _of_motor(log_map, name, source, model, channels.actuators.index(own))
    unstated = {name for name in columns if name not in sources or not sources[name].stated}
    for j, joint in enumerate(channels.joints):
        kind, name = channels.kinds[j], f"qpos:{joint}"
        if kind in ("hinge", "slide") and model.jnt_limited[j] and name in unstated:
            _by_range(table, name, columns[name], kind, [*map(float, model.jnt_range[j])], of)
        elif kind == "hinge" and name in unstated:
            _many_turns(table, name, columns[name], of)
        if kind in ("hinge", "slide") and name in unstated:
            _by_counting(table, name, columns[name], kind, of)
    for i, j in followed.items():
        pair = f"qpos:{channels.joints[j]}", f"ctrl:{channels.actuators[i]}"
        if _held_by_its_range(model, i, j, channels):
            continue
        if unstated & set(pair):
            _by_target(table, *pair, columns, of)


def _key(name: str, column: object, unit: str) -> str:
    stream, _, own = name.partition(":")
    needs = {units.COUNTS: ", resolution: COUNTS_PER_TURN", units.PERCENT: ", range: [AT_0, AT_100]"}
    more = needs.get(unit, ", torque_constant: NM_PER_A" if stream == "ctrl" and unit in units.CURRENTS else "")
    return f"`{stream}: {{{own}: {{column: {column!r}, unit: {unit}{more}}}}}`"


def _kind(log_map: LogMap, name: str, source: Source, kind: str) -> None:
    """No angles of slides and no lengths of hinges."""
    angular = {"hinge": units.LENGTHS, "slide": {**units.ANGLES, units.COUNTS: 1.0}}.get(kind, {})
    if source.unit is not None and source.unit in angular:
        key = name.replace(":", ".")
        allowed = "an angle's unit" if kind == "hinge" else "m, mm, cm or percent, or `scale` in m"
        raise UserError(f"{log_map.path}: {key}.unit = {source.unit!r} of a {kind} joint; allowed: {allowed}")


def _of_motor(log_map: LogMap, name: str, source: Source, model: mujoco.MjModel, i: int) -> None:
    """Refuse places and speeds as commands of a motor: it takes an effort, so they are targets of a controller."""
    fixed = int(model.actuator_gaintype[i]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    motor = fixed and int(model.actuator_biastype[i]) == int(mujoco.mjtBias.mjBIAS_NONE)
    place, speed = source.unit in {**units.ANGLES, **units.LENGTHS}, source.unit in {**units.TURNING, **units.MOVING}
    if motor and (place or speed):
        own, law = name.partition(":")[2], "velocity, kp: KP" if speed else "position, kp: KP, kd: KD"
        raise UserError(
            f"{log_map.path}: ctrl.{own}.unit = {source.unit!r}: the model's {own} is a motor, whose command is an "
            f"effort; for targets state the controller that follows them: `metadata: {{controller: {{law: {law}}}}}`, "
            f"or make {own} a {'velocity' if speed else 'position'} actuator in the model"
        )


def _by_name(
    table: Table, log_map: LogMap, name: str, source: Source, followed: Mapping[int, int], channels: Channels
) -> None:
    column = source.name(table, name)
    unit = units.of_name(f"[{source.suffix.strip()}]") if source.suffix.strip() else units.of_name(column)
    stream, _, own = name.partition(":")
    strange = units.foreign(column)
    if strange is not None and not source.stated and column != name and own not in strange:
        text = f"{table.path}: column {column!r}: nothing is known of {strange!r}, which may be its unit"
        key = f"`{stream}: {{{own}: {{column: {column!r}, scale: MODEL_UNITS_PER_UNIT}}}}`"
        raise UserError(f"{text}; state `unit` or `scale` in a map: {key}; `scale: 1` if it is none")
    if source.stated or column == name or unit in PLAIN or unit in units.TIMES:
        return
    if stream == "ctrl":
        target = channels.actuators.index(own) in followed
        if target is not (unit in (*units.ANGLES, units.COUNTS)) and unit == units.COUNTS:
            return
    text = f"{table.path}: column {column!r}: its name says {unit}, and the map does not state its unit"
    keep = "`scale: 1` in that place, if the values are in the model's unit all the same"
    raise UserError(f"{text}; allowed: {_key(name, column, str(unit))} in the map, or {keep}")


def _by_range(table: Table, name: str, x: Array, kind: str, limits: Sequence[float], of: Mapping[str, str]) -> None:
    """Values beyond the joint's range that another unit would bring into it."""
    low, high = limits
    outside = np.abs(x) > max(FAR * max(abs(low), abs(high)), TURN if kind == "hinge" else 0.0)
    if np.mean(outside) < 0.02:
        return
    if kind == "hinge" and np.ptp(x) < min(high - low, TURN) and not _whole(x) and _by_turns(x, low, high):
        return
    row = int(np.flatnonzero(outside)[0])
    fits = _fitting(x, kind, low, high)
    if not fits:
        return
    at = f"{table.path}: column {name!r}, {table.where(row)}: {x[row]:.6g} is far outside the model's range"
    keys = " or ".join(_key(name, of.get(name, name), unit) for unit in fits)
    own = "rad" if kind == "hinge" else "m"
    raise UserError(
        f"{at} [{low:g}, {high:g}], and values from {x.min():.6g} to {x.max():.6g} would fit as {' or '.join(fits)}; "
        f"state one in a map (docs/logs.md): {keys}, or `unit: {own}` if they are in {own} all the same"
    )


def _many_turns(table: Table, name: str, x: Array, of: Mapping[str, str]) -> None:
    """Two turns one way and two turns back, of a joint without a range: rare in rad, usual in degrees."""
    up, down = np.max(x - np.minimum.accumulate(x)), np.max(np.maximum.accumulate(x) - x)
    if min(up, down) > 2.0 * TURN and np.abs(np.diff(x)).max() < np.pi:
        text = f"{table.path}: column {name!r} goes to and fro by {np.ptp(x) / TURN:.3g} turns in rad"
        warnings.warn(f"{text}; degrees would need {_key(name, of.get(name, name), 'deg')} in a map", stacklevel=5)


def _by_counting(table: Table, name: str, x: Array, kind: str, of: Mapping[str, str]) -> None:
    """Refuse a joint that moves from whole number to whole number: its unit is neither rad nor m."""
    if not _whole(x) or values_shown(x) < LEVELS:
        return
    own, others = ("rad", (units.COUNTS, "deg")) if kind == "hinge" else ("m", ("mm", units.PERCENT))
    keys = " or ".join(_key(name, of.get(name, name), unit) for unit in others)
    text = f"{table.path}: column {name!r} holds whole numbers alone, from {x.min():g} to {x.max():g} {own}"
    raise UserError(f"{text}; state its unit in a map: {keys}, or `unit: {own}` if they are in {own} all the same")


def _whole(x: Array) -> bool:
    return bool((x == np.round(x)).all())


def _by_turns(x: Array, low: float, high: float) -> bool:
    slack = 0.02 * (high - low)
    return any(x.min() + TURN * k >= low - slack and x.max() + TURN * k <= high + slack for k in range(-16, 17))


def _fitting(x: Array, kind: str, low: float, high: float) -> list[str]:
    slack = 0.05 * (high - low)
    found = []
    scales = {"deg": DEGREE} if kind == "hinge" else {"mm": 1e-3, "cm": 1e-2}
    for unit, scale in scales.items():
        fits = x.min() * scale >= low - slack and x.max() * scale <= high + slack
        wraps = unit == "deg" and x.min() >= -180.5 and x.max() <= 360.5 and np.abs(np.diff(x)).max() > 180.0
        if fits or wraps:
            found.append(unit)
    if x.min() >= -0.5 and x.max() <= 100.5:
        found.append(units.PERCENT)
    if _whole(x) and kind == "hinge" and np.abs(x).max() > 200.0:
        found.append(units.COUNTS)
    return found


def _held_by_its_range(model: mujoco.MjModel, i: int, j: int, channels: Channels) -> bool:
    """Warn of a hinge whose range beside its servo's commands is nearer to rad read as degrees than to their equal."""
    gear = abs(float(model.actuator_gear[i, 0])) or 1.0
    (low, high), (least, most) = model.jnt_range[j], model.actuator_ctrlrange[i] / gear
    limited = model.jnt_limited[j] and model.actuator_ctrllimited[i] and channels.kinds[j] == "hinge"
    if not limited or high - low > np.sqrt(DEGREE) * (most - least):
        return False
    text = f"the model lets {channels.joints[j]} turn from {low:.3g} to {high:.3g} rad, and commands of "
    text += f"{channels.actuators[i]} reach from {least:.3g} to {most:.3g} rad"
    warnings.warn(f'{text}; angles in an MJCF are degrees unless it has `<compiler angle="radian"/>`', stacklevel=4)
    return True


def _by_target(table: Table, reading: str, target: str, columns: Mapping[str, Array], of: Mapping[str, str]) -> None:
    """Find a joint that follows its target with the amplitude of another unit, of a gear, or mirrored."""
    q, c = columns[reading], columns[target]
    if not (np.ptp(q) > 0 and np.ptp(c) > 0):
        return
    alike, unwrapped = (float(np.corrcoef(a, b)[0, 1]) for a, b in ((q, c), (np.unwrap(q), np.unwrap(c))))
    if max(alike, unwrapped) < -ALIKE:
        stream, _, own = reading.partition(":")
        text = f"{table.path}: {reading!r} goes against {target!r} (correlation {alike:.3f}), as if it were mirrored"
        key = f"`{stream}: {{{own}: {{column: {of.get(reading, reading)!r}, sign: -1}}}}`"
        raise UserError(f"{text}; state {key} in a map, or `unit: rad` of both if they are right")
    if alike < ALIKE:
        return
    ratio = float(np.std(q) / np.std(c))
    text = f"{table.path}: {reading!r} follows {target!r} with {ratio:.4g} times its amplitude"
    for unit, scale in units.ANGLES.items():
        for name, factor in ((reading, ratio * scale), (target, scale / ratio)):
            if unit != "rad" and 1.0 / RATIO < factor < RATIO:
                text = f"{text}: {name!r} may be in {unit}; state {_key(name, of.get(name, name), unit)} in a map"
                raise UserError(f"{text}, or `unit: rad` if not")
    if not 1.0 / FAR < ratio < FAR:
        warnings.warn(f"{text}; `scale` of one of them in a map takes out a gear or another unit", stacklevel=4)


# benchmarks/records/log_checks.json
SURE = 1.2  # ratio of the residuals of both clocks, from which one is named
UNEVEN = 0.1  # share of the steps that are off by more than a fifth; records/log_checks.json


def say_better_clock(table: Table, columns: Mapping[str, Array], channels: Channels, log_map: LogMap) -> None:
    """Warns where the motion fits a clock better than the one that is used: stamps, or an even rate."""
    time = columns["time"]
    kinds = zip(channels.joints, channels.kinds, strict=True)
    moved = [columns[f"qpos:{j}"] for j, kind in kinds if kind in ("hinge", "slide")]
    if len(time) < 4 * WINDOW or not moved:
        return
    positions = np.stack(moved, 1)
    stated = log_map.time.rate
    if stated is not None:
        _against_stated(table, time, positions, log_map, stated)
        return
    steps = np.diff(time)
    if np.mean(np.abs(steps / np.median(steps) - 1.0) > 0.2) <= UNEVEN or steps.max() > 5.0 * np.median(steps):
        return
    rate = (len(time) - 1) / float(time[-1] - time[0])
    better, ratio = better_clock(time, rate, positions)
    if better == "rate" and ratio > SURE:
        text = f"{table.path}: the motion fits an even rate of {rate:.6g} rows per second better than the stamps"
        key = f"`time: {{column: ..., rate: {rate:.6g}}}` in a map takes it"
        warnings.warn(f"{text} (the residual of the stamps is {ratio:.2g} times as large); {key}", stacklevel=3)


def _against_stated(table: Table, time: Array, positions: Array, log_map: LogMap, rate: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # said when the table was read
        raw = dataclasses.replace(log_map.time, rate=None).read(table, "time")
    if len(raw) != len(time) or coarseness(raw) or not (np.diff(raw) > 0).all():
        return
    late = raw - time
    better, ratio = better_clock(raw, rate, positions)
    text = f"{table.path}: stamps are up to {1e3 * float(np.ptp(late)):.3g} ms apart from `rate: {rate:g}` of the map"
    if ratio < SURE:
        verdict = "the motion fits both about as well; the rate is used"
    elif better == "rate":
        verdict = (
            f"the motion fits the rate better (the residual of the stamps is {ratio:.2g} times as large); it is used"
        )
    else:
        verdict = f"the motion fits the stamps better (the residual of the rate is {ratio:.2g} times as large)"
        verdict += ": leave the rate out"
    if np.ptp(late) > 0.2 / rate:
        warnings.warn(f"{text}; {verdict}", stacklevel=4)


__all__ = ["check_units", "say_better_clock"]
