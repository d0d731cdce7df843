"""What logs show by themselves: spectra, coverage of the state space, what excites what, periods of the rows.

Everything is bounded: long logs are decimated for pictures, and spectra are means over segments.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy import signal

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.channel_units import units_of
from bayessim_mjx.logs.files import map_of_folder
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.logs.mapping import LogMap
from bayessim_mjx.logs.overview import Overview, overview
from bayessim_mjx.logs.read import files_of, table_of

STREAMS = ("ctrl", "qpos", "qvel", "effort")
SEGMENT = 256  # rows of a segment of a spectrum: 2.6 s at 100 Hz; a rule of thumb
LEAST = 32  # rows, of the shortest segment from which coherence is computed; a rule of thumb
CELLS = 40  # of a map of coverage along each axis; a rule of thumb
REST = 0.02  # of the largest speed: below it a joint counts as at rest; a rule of thumb


@dataclass(frozen=True)
class Sheet:
    """One log, or one piece of it, as channels.

    Attributes:
        name: of the file. time: [T] s. channels: {`qpos:elbow`: [T]}, in the model's units where a model is given.
    """

    name: str
    time: Array
    channels: Mapping[str, Array]

    def names(self, stream: str) -> list[str]:
        """Names of the channels of `ctrl`, `qpos`, `qvel` or `effort`."""
        return [name.partition(":")[2] for name in self.channels if name.startswith(f"{stream}:")]


@dataclass
class View:
    """Everything that a page of logs shows.

    Attributes:
        overview: tables and notes of `logs check`. sheets: the logs. limits: {joint: (low, high)} of the model.
        pairs: {joint: actuators that drive it by the model}. units: {channel: unit}, of a model.
    """

    overview: Overview
    sheets: list[Sheet] = field(default_factory=list)
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    pairs: dict[str, list[str]] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)


def view(path: Path, model: mujoco.MjModel | None, map_file: str | None = None) -> View:
    """Read logs to be looked at; where they cannot be used, they are shown as they are written.

    Args:
        path: folder or file. model: names joints and actuators. map_file: a map, in place of the folder's own.

    Raises:
        UserError: no such file or folder, nothing in it that can be a log, a map that is wrong.
    """
    out = View(overview(path, model, map_file))
    if model is not None and not out.overview.faults:
        out.sheets = [sheet_of(log) for log in out.overview.logs]
        out.units = units_of(model)
    else:
        own = map_file or map_of_folder(path)
        out.sheets = _as_written(path, LogMap.read(own) if own is not None else _proposed(out.overview))
    if model is not None:
        out.limits, out.pairs = _limits(model), _driven(model)
    if not out.sheets:
        raise UserError(f"{path}: no file of it can be read ({'; '.join(out.overview.refused)})")
    return out


def _proposed(found: Overview) -> LogMap:
    import yaml

    return LogMap.read(yaml.safe_load(found.map_text) or {}) if found.map_text else LogMap()


def sheet_of(log: Log) -> Sheet:
    """Return the channels of a log that were measured."""
    names = log.channels
    every = {f"ctrl:{n}": c for n, c in zip(names.actuators, log.ctrl.T, strict=True)}
    every |= {f"qpos:{n}": c for n, c in zip(names.qpos, log.qpos.T, strict=True)}
    every |= {f"qvel:{n}": c for n, c in zip(names.qvel, log.qvel.T, strict=True)} if log.has_qvel else {}
    return Sheet(log.name, log.time, {n: c for n, c in (every | dict(log.streams)).items() if n not in log.absent})


def _as_written(path: Path, log_map: LogMap) -> list[Sheet]:
    """Every column of numbers, by its channel where the map or its own name says one."""
    sheets = []
    for file in files_of(path, log_map):
        try:
            table = table_of(file, log_map)
            mapped = log_map.apply(table) if log_map.names_channels else {"time": log_map.clock(table)}
        except UserError:
            continue
        time = mapped.pop("time")
        used = set(log_map.sources(table).values()) if log_map.names_channels else {"time"}
        for column in table.columns:
            if column in used:
                continue
            try:
                values = table.numbers(column)
            except UserError:
                continue
            if np.isfinite(values).any():
                mapped[column] = values
        order = np.flatnonzero(np.isfinite(time))
        order = order[np.argsort(time[order], kind="stable")]
        if len(order) > 2:
            sheets.append(Sheet(file.name, time[order], {n: v[order] for n, v in mapped.items()}))
    return sheets


def _limits(model: mujoco.MjModel) -> dict[str, tuple[float, float]]:
    """Ranges of the joints that have limits."""
    plain = int(mujoco.mjtJoint.mjJNT_SLIDE)  # and hinges, whose number is larger
    limited = [i for i in range(model.njnt) if model.jnt_limited[i] and int(model.jnt_type[i]) >= plain]
    return {model.joint(i).name: (float(model.jnt_range[i, 0]), float(model.jnt_range[i, 1])) for i in limited}


def _driven(model: mujoco.MjModel) -> dict[str, list[str]]:
    """Actuators of each joint that has some."""
    found: dict[str, list[str]] = {}
    for i in range(model.nu):
        if int(model.actuator_trntype[i]) <= int(mujoco.mjtTrn.mjTRN_JOINTINPARENT):
            joint = model.joint(int(model.actuator_trnid[i, 0])).name
            found.setdefault(joint, []).append(model.actuator(i).name or f"actuator{i}")
    return found


def joints(sheets: Sequence[Sheet]) -> list[str]:
    """Joints of which any log has a position, in order."""
    return list(dict.fromkeys(name for sheet in sheets for name in sheet.names("qpos")))


def velocity(sheet: Sheet, joint: str) -> Array | None:
    """[T] as measured, else the slope of the position; None without either, and for parts of an orientation.

    Position i of a ball or free joint is a part of its quaternion, and velocity i is none of its rates.
    """
    base, index = re.fullmatch(r"(.*?)(?:\[(\d+)\])?", joint).groups()  # type: ignore[union-attr]
    if index is not None and (int(index) > 2 or f"qpos:{base}[6]" not in sheet.channels):
        return None
    if f"qvel:{joint}" in sheet.channels:
        return sheet.channels[f"qvel:{joint}"]
    place = sheet.channels.get(f"qpos:{joint}")
    if place is None or len(place) < 3:
        return None
    return np.gradient(place, sheet.time)


def even(sheet: Sheet, values: Array) -> tuple[Array, float] | None:
    """(values at even times, their period in s); None where too little is finite."""
    good = np.isfinite(values)
    if good.sum() < LEAST:
        return None
    period = float(np.median(np.diff(sheet.time)))
    count = int((sheet.time[-1] - sheet.time[0]) / period) + 1
    # a gap of hours must not become rows of hours
    if count > 4 * len(values):
        return values[good], period
    grid = sheet.time[0] + period * np.arange(count)
    return np.interp(grid, sheet.time[good], values[good]), period


def spectrum(sheets: Sequence[Sheet], channel: str) -> tuple[Array, Array] | None:
    """(Hz, amplitude density in unit/sqrt(Hz)) of a channel, mean over the logs that have it (Welch's method)."""
    found: list[tuple[Array, Array]] = []
    for sheet in sheets:
        joint = channel.partition(":")[2]
        values = velocity(sheet, joint) if channel.startswith("qvel:") else sheet.channels.get(channel)
        sampled = None if values is None else even(sheet, values)
        if sampled is None:
            continue
        x, period = sampled
        length = min(SEGMENT, len(x))
        found.append(signal.welch(x - x.mean(), 1 / period, nperseg=length))
    if not found:
        return None
    longest = max((f for f, _ in found), key=len)
    power = np.mean([np.interp(longest, f, p, right=np.nan) for f, p in found], axis=0)
    return longest[1:], np.sqrt(power[1:])


@dataclass(frozen=True)
class Coverage:
    """Where a joint was: positions against velocities.

    Attributes:
        places, speeds: edges of the cells. counts: [speeds, places] rows in each cell. low, high, fastest: of the logs.
        range_share: of the model's range, None without one. rest: share of the rows at rest. turns: changes of sign of
            the velocity, without those at rest.
    """

    places: Array
    speeds: Array
    counts: NDArray[np.int64]
    low: float
    high: float
    fastest: float
    range_share: float | None
    rest: float
    turns: int


def coverage(sheets: Sequence[Sheet], joint: str, limits: tuple[float, float] | None) -> Coverage | None:
    """Where a joint was in all logs; None without a velocity."""
    places, speeds, turns = [], [], 0
    for sheet in sheets:
        q, w = sheet.channels.get(f"qpos:{joint}"), velocity(sheet, joint)
        if q is None or w is None or len(q) != len(w):
            continue
        good = np.isfinite(q) & np.isfinite(w)
        places.append(q[good])
        speeds.append(w[good])
    if not places or not sum(map(len, places)):
        return None
    q, w = np.concatenate(places), np.concatenate(speeds)
    fastest = float(np.abs(w).max())
    for own in speeds:
        moving = own[np.abs(own) > REST * fastest]
        turns += int(np.sum(np.diff(np.sign(moving)) != 0))
    counts, rows, columns = np.histogram2d(w, q, CELLS)
    share = None if limits is None or limits[1] <= limits[0] else float(np.ptp(q) / (limits[1] - limits[0]))
    rest = float(np.mean(np.abs(w) <= REST * fastest)) if fastest else 1.0
    return Coverage(columns, rows, counts.astype(np.int64), float(q.min()), float(q.max()), fastest, share, rest, turns)


def thinned(time: Array, values: Array, most: int) -> tuple[Array, Array]:
    """At most `most` points that keep the smallest and largest value of every stretch."""
    if len(values) <= most:
        return time, values
    edges = np.linspace(0, len(values), most // 2 + 1).astype(int)
    keep = []
    for a, b in zip(edges[:-1], edges[1:], strict=True):
        part = values[a:b]
        if np.isfinite(part).any():
            keep += sorted({a + int(np.nanargmin(part)), a + int(np.nanargmax(part))})
        else:
            keep.append(a)
    return time[keep], values[keep]
