"""Logs of a deployed policy: what it saw, what it did, and the robot's state, in the steps of the policy."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.contract.manifest import Manifest
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.check import check_time
from bayessim_mjx.logs.files import distinct, files_of, map_of_folder
from bayessim_mjx.logs.log import Channels
from bayessim_mjx.logs.mapping import LogMap
from bayessim_mjx.logs.read import table_of
from bayessim_mjx.logs.table import Table

Array = NDArray[np.float64]
ROWS = 20  # rows of a file at least: with fewer no relation stands out; a rule of thumb
ALIASES = {"obs": "observation", "act": "action", "actions": "action", "observations": "observation", "command": "ctrl"}
HELD = 0.7  # of the rows change where each row is a step of the policy; a rule of thumb
FINER = 0.75  # of the control period: the largest row period of a log with several rows per step; a rule of thumb


@dataclass(frozen=True)
class Run:
    """One recording.

    Attributes:
        name: of the file. time: [K] s, steps of the policy. observation: [K, S]; action: [K, A]; NaN where not logged.
        ctrl: [K, nu] commands of the steps, NaN where not logged.
        rows: [T] s, of the log. channels: {`qpos:<joint>`, `qvel:<joint>`, `task:<number>`: [T]}.
    """

    name: str
    time: Array
    observation: Array
    action: Array
    ctrl: Array
    rows: Array
    channels: Mapping[str, Array]

    @property
    def period(self) -> float:
        """Median period of the policy's steps, s."""
        return float(np.median(np.diff(self.time)))


def read_runs(path: Path, manifest: Manifest, model: Channels | None) -> list[Run]:
    """Read every log of a folder, or one file.

    Args:
        path: folder or file; a `map.yaml` in the folder names columns. manifest: of the policy. model: names joints of
            arrays (`qpos[0]`) in the robot's order.

    Raises:
        UserError: a file without observations and actions, or with a name that the manifest has not.
    """
    own = map_of_folder(path)
    log_map = LogMap.read(own) if own is not None else LogMap()
    files = distinct(files_of(path, log_map if own is not None else None))
    return [_run(table_of(file, log_map), log_map, manifest, model) for file in files]


def _run(table: Table, log_map: LogMap, manifest: Manifest, model: Channels | None) -> Run:
    columns = _columns(table, log_map, manifest, model)
    time = columns.pop("time", None)
    if time is None:
        raise UserError(f"{table.path}: no column time; allowed: time, or `rate: ROWS_PER_SECOND` in a map.yaml")
    check_time(table, time, ROWS)
    names = [e.name for e in manifest.observations]
    seen, acted, ctrl = (
        _block(columns, stream, own, len(time))
        for stream, own in (("observation", names), ("action", manifest.actions), ("ctrl", manifest.actions))
    )
    if not np.isfinite(seen).any() and not np.isfinite(acted).any() and not np.isfinite(ctrl).any():
        have = ", ".join(list(table.columns)[:12])
        raise UserError(
            f"{table.path}: neither observations nor actions of the policy; it has {have}; allowed: the columns "
            f"observation:<name> ({', '.join(names[:3])} ...) and action:<actuator>, or observation[0], action[0] ..., "
            "or a map.yaml with them under `streams`"
        )
    starts, ends = _steps(time, seen, acted, ctrl, manifest.dt)
    return Run(table.path.name, time[starts], seen[starts], acted[ends], ctrl[ends], time, columns)


def _columns(table: Table, log_map: LogMap, manifest: Manifest, model: Channels | None) -> dict[str, Array]:
    """Return the columns by the names of the contract."""
    if log_map.names_channels:
        return _named(table, log_map.apply(table), manifest, model)
    found = {"time": log_map.clock(table)} if "time" in table.columns or log_map.rate is not None else {}
    for column in table.columns:
        stream = ALIASES.get(re.split(r"[:\[]", column)[0], re.split(r"[:\[]", column)[0])
        if column != "time" and stream in ("observation", "action", "ctrl", "qpos", "qvel", "task"):
            found[column] = table.numbers(column)
    return _named(table, found, manifest, model)


def _named(table: Table, found: Mapping[str, Array], manifest: Manifest, model: Channels | None) -> dict[str, Array]:
    known: dict[str, Sequence[str]] = {
        "observation": [e.name for e in manifest.observations], "action": manifest.actions, "ctrl": manifest.actions,
    }  # fmt: skip
    if model is not None:
        known |= {"qpos": model.qpos, "qvel": model.qvel}
    out: dict[str, Array] = {}
    for column, values in found.items():
        match = re.fullmatch(r"(\w+)\[(\d+)\]", column)
        stream, _, name = column.partition(":")
        stream = ALIASES.get(match[1] if match else stream, match[1] if match else stream)
        if match and stream in known:
            if int(match[2]) >= len(known[stream]):
                raise UserError(f"{table.path}: column {column}: {stream} has {len(known[stream])} entries")
            name = known[stream][int(match[2])]
        elif match and stream in ("qpos", "qvel"):
            raise UserError(
                f"{table.path}: column {column}: --model FILE says which joint it is; or name it qpos:<joint>"
            )
        elif name and stream in ("observation", "action", "ctrl") and name not in known[stream]:
            raise UserError(f"{table.path}: column {column}: not in the manifest; allowed: {', '.join(known[stream])}")
        out[f"{stream}:{name}" if name else stream] = values
    return out


def _block(columns: dict[str, Array], stream: str, names: Sequence[str], rows: int) -> Array:
    """[T, n] of a stream, taken out of the columns; NaN where there is none."""
    blank = np.full(rows, np.nan)
    return np.stack([columns.pop(f"{stream}:{name}", blank) for name in names], 1)


def _steps(time: Array, seen: Array, acted: Array, ctrl: Array, dt: float) -> tuple[NDArray, NDArray]:
    """First and last row of every step of the policy.

    A log may have several rows for each step: the observation is held between steps, or NaN.
    """
    leading = seen if np.isfinite(seen).any() else acted if np.isfinite(acted).any() else ctrl
    present = np.flatnonzero(np.isfinite(leading).any(1))
    finer = np.median(np.diff(time)) < FINER * dt
    if len(present) < HELD * len(time) and finer:  # NaN between the steps
        return present, present
    values = np.nan_to_num(leading)
    changed = np.flatnonzero(np.append(True, (np.diff(values, axis=0) != 0).any(1)))
    if finer and len(changed) < HELD * len(time) and len(changed) > 2:
        return changed, np.append(changed[1:] - 1, len(time) - 1)
    every = np.arange(len(time))
    return every, every
