"""Read recorded motion: CSV or NPZ, one file per run, checked row by row before anything is simulated."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.check import STREAMS, check_channels, check_motion, check_time
from bayessim_mjx.logs.files import FORMAT, Paths, distinct, files_of, map_of_folder, side_yaml
from bayessim_mjx.logs.log import Array, Channels, Log, suggest
from bayessim_mjx.logs.mapping import LogMap
from bayessim_mjx.logs.pieces import MIN_ROWS, pieces
from bayessim_mjx.logs.table import Table, read_csv, read_npz
from bayessim_mjx.physics import controllers


def read_logs(
    paths: Paths, mj_model: mujoco.MjModel, map: str | Path | Mapping[str, Any] | LogMap | None = None
) -> list[Log]:
    """Read all runs of a folder (or the files named), in the model's order of joints and actuators.

    A folder's own `map.yaml` is used where `map` is not given. Files are cut at gaps longer than 5 periods and 10 ms;
    `<file stem>.yaml` beside a file becomes its metadata; `sigma` and `quantum` there, {<channel>: value}, replace the
    estimates of a channel's noise and resolution.

    Raises:
        UserError: whatever is wrong with a file, naming the file, its column and row, and what is allowed.
    """
    chosen = map if map is not None else map_of_folder(paths)
    log_map = chosen if chosen is None or isinstance(chosen, LogMap) else LogMap.read(chosen)
    channels = Channels.of(mj_model)
    if log_map is not None:
        _check_map(log_map, channels)
    files = distinct(files_of(paths, log_map))
    logs = [log for path in files for log in _read_one(path, mj_model, channels, log_map)]
    _check_repeats(logs)
    return logs


def _check_repeats(logs: Sequence[Log]) -> None:
    """Warn of a `repeat_of` that names none of the logs."""
    known = {alias for log in logs for alias in log.aliases}
    for log in logs:
        target = log.metadata.get("repeat_of")
        if target is not None and str(target) not in known:
            source = log.metadata["source"]
            names = ", ".join(sorted({Path(str(other.metadata["source"])).name for other in logs}))
            text = f"{source}: repeat_of = {target!r} in its side YAML is none of the logs; it is left alone"
            warnings.warn(f"{text}; allowed: {names}", stacklevel=3)


def _read_one(path: Path, mj_model: mujoco.MjModel, channels: Channels, log_map: LogMap | None) -> list[Log]:
    if path.suffix == ".npz":
        table = read_npz(path)
    else:
        table = read_csv(path, *((log_map.delimiter, log_map.header) if log_map else ()))
    columns = log_map.apply(table) if log_map is not None else _columns(table, channels)
    check_channels(table, columns, channels)
    check_time(table, columns["time"], MIN_ROWS)
    metadata = {**(log_map.metadata if log_map else {}), **side_yaml(path), "source": str(path)}
    law = controllers.read(
        metadata, mj_model, channels.actuators, str(path)
    )  # refused here, before anything is simulated
    check_motion(table, columns, channels, mj_model, np.asarray(law.through))
    columns = _with_numbers(table, columns)
    if "condition" in metadata:
        metadata.setdefault("operating_condition", metadata["condition"])
    return pieces(table, columns, channels, metadata)


def _with_numbers(table: Table, columns: dict[str, Array]) -> dict[str, Array]:
    """Without the streams that hold no number at all, which say nothing."""
    empty = [name for name, column in columns.items() if not np.isfinite(column).any()]
    for name in empty:
        warnings.warn(f"{table.path}: column {name!r} holds no finite number; it is left out", stacklevel=4)
    return {name: column for name, column in columns.items() if name not in empty}


def _check_map(log_map: LogMap, channels: Channels) -> None:
    for stream, allowed in (("ctrl", channels.actuators), ("qpos", channels.qpos), ("qvel", channels.qvel)):
        for name in getattr(log_map, stream):
            if name not in allowed:
                raise UserError(f"{log_map.path}: {stream}.{name} is no channel of the model; {suggest(name, allowed)}")


def _columns(table: Table, channels: Channels) -> dict[str, Array]:
    """The file's own columns as channels; text columns nobody asked for are left out with a warning."""
    names = {c: c for c in table.columns} if table.first_line is not None else _npz_names(table, channels)
    out = {}
    for column, name in names.items():
        needed = name == "time" or name.split(":")[0] in STREAMS
        if name in out:
            raise UserError(f"{table.path}: two columns are {name!r}; allowed: one column per channel")
        try:
            out[name] = table.numbers(column)
        except UserError as error:
            if needed:
                raise
            warnings.warn(f"{error}; the column is left out", stacklevel=2)
    return out


def _npz_names(table: Table, channels: Channels) -> dict[str, str]:
    """Array columns `qpos[0]` ... to channel names, by the names the file gives in `joints` and `actuators`."""
    out = {c: c for c in table.columns}
    for stream, key in (
        ("qpos", "joints"),
        ("qvel", "joints"),
        ("ctrl", "actuators"),
        ("effort", "actuators"),
        ("enabled", "actuators"),
    ):
        if stream not in table.widths or (stream in ("effort", "enabled") and key not in table.names):
            continue
        if key not in table.names:
            raise UserError(f"{table.path}: no array {key!r} with the names of the {stream} columns; allowed: {FORMAT}")
        names = _expand(table, key, stream, channels)
        width = table.widths[stream]
        if len(names) != width:
            named = f"{key!r} names {len(names)} ({', '.join(names)})"
            raise UserError(
                f"{table.path}: array {stream!r} has {width} columns, {named}; allowed: one column per channel"
            )
        own = [stream] if stream in table.columns else [f"{stream}[{i}]" for i in range(width)]
        out.update({c: f"{stream}:{n}" for c, n in zip(own, names, strict=True)})
    return out


def _expand(table: Table, key: str, stream: str, channels: Channels) -> list[str]:
    if key == "actuators":
        return list(table.names[key])
    for joint in table.names[key]:
        if joint not in channels.joints:
            raise UserError(
                f"{table.path}: {joint!r} in 'joints' is no joint of the model; {suggest(joint, channels.joints)}"
            )
    return [c for joint in table.names[key] for c in channels.of_joint(joint, stream)]
