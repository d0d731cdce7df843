"""Read recorded motion: CSV, NPZ or JSON lines, one file per run, checked row by row before anything is simulated."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.bad_rows import check_markers, leave_out, oldest_first, without_copies
from bayessim_mjx.logs.check import STREAMS, check_finite, check_motion, check_names, check_time
from bayessim_mjx.logs.csv_files import read_csv
from bayessim_mjx.logs.doubts import check_units, say_better_clock
from bayessim_mjx.logs.files import FORMAT, Paths, distinct, files_of, map_of_folder, side_yaml
from bayessim_mjx.logs.inertial import having, onto_encoders
from bayessim_mjx.logs.log import HOLDS, Array, Channels, Log, suggest
from bayessim_mjx.logs.mapping import LogMap
from bayessim_mjx.logs.pieces import MIN_ROWS, pieces
from bayessim_mjx.logs.plausible import check_plausible
from bayessim_mjx.logs.proposal import hint
from bayessim_mjx.logs.sparse import onto_positions
from bayessim_mjx.logs.table import Table, read_jsonl, read_npz
from bayessim_mjx.physics import controllers

LATEST = 1.0  # s by which commands may act, or an inertial unit may read, later or earlier than their rows say


def read_logs(
    paths: Paths,
    mj_model: mujoco.MjModel,
    map: str | Path | Mapping[str, Any] | LogMap | None = None,
    partial: bool = False,
) -> list[Log]:
    """Read all runs of a folder (or the files named), in the model's order of joints and actuators.

    A folder's own `map.yaml` is used where `map` is not given; columns keep their names if it names no channel. Files
    are cut at gaps longer than 5 periods and 10 ms;
    `<file stem>.yaml` beside a file becomes its metadata; `sigma` and `quantum` there, {<channel>: value}, replace the
    estimates of a channel's noise and resolution.

    Args:
        paths: a folder or files; mj_model: names their channels; map: where columns come from.
        partial: positions and velocities may be missing (`Log.absent`); else they are refused.

    Raises:
        UserError: whatever is wrong with a file, naming the file, its column and row, and what is allowed.
    """
    chosen = map if map is not None else map_of_folder(paths)
    log_map = chosen if chosen is None or isinstance(chosen, LogMap) else LogMap.read(chosen)
    channels = Channels.of(mj_model)
    if log_map is not None:
        check_map(log_map, channels)
    files = distinct(files_of(paths, log_map))
    logs = [log for path in files for log in _read_one(path, mj_model, channels, log_map, partial)]
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


def _read_one(
    path: Path, mj_model: mujoco.MjModel, channels: Channels, log_map: LogMap | None, partial: bool
) -> list[Log]:
    log_map = log_map or LogMap()
    table = table_of(path, log_map)
    if log_map.names_channels:
        columns, sources = log_map.apply(table), log_map.sources(table)
    else:
        columns, sources = _columns(table, channels, log_map)
    table, columns = onto_encoders(table, columns, channels)
    table, columns = onto_positions(table, columns, channels, log_map.hold == "linear")
    columns, absent = filled(table, columns, channels, mj_model) if partial else (columns, ())
    check_names(table, columns, channels)
    table, columns = oldest_first(table, columns)
    if table.lenient:
        table, columns = leave_out(table, columns, sources, channels, log_map.bad_rows)
    table, columns = without_copies(table, columns)
    check_finite(table, columns, channels)
    check_time(table, columns["time"], MIN_ROWS)
    hold = {} if log_map.hold is None else {"hold": log_map.hold}
    metadata = {**hold, **log_map.metadata, **side_yaml(path), "source": str(path)}
    if metadata.get("hold", HOLDS[0]) not in HOLDS:
        raise UserError(f"{path}: hold = {metadata['hold']!r} in its side YAML; allowed: {', '.join(HOLDS)}")
    for key in ("commands_late", "imu_late"):
        late = metadata.get(key, 0.0)
        if not isinstance(late, int | float) or isinstance(late, bool) or not abs(late) < LATEST:
            raise UserError(f"{path}: {key} = {late!r}; allowed: seconds between -{LATEST:g} and {LATEST:g}")
    law = controllers.read(
        metadata, mj_model, channels.actuators, str(path)
    )  # refused here, before anything is simulated
    through, declared = np.asarray(law.through), np.asarray(law.on_position) > 0
    check_markers(table, columns, sources, channels, log_map)
    check_units(table, columns, channels, mj_model, log_map, through, declared)
    check_motion(table, columns, channels, mj_model, through, absent, declared)
    check_plausible(table, columns, channels, mj_model, log_map, absent)
    say_better_clock(table, columns, channels, log_map)
    columns = _with_numbers(table, columns)
    if "condition" in metadata:
        metadata.setdefault("operating_condition", metadata["condition"])
    return pieces(table, columns, channels, metadata, absent)


def table_of(path: Path, log_map: LogMap) -> Table:
    """Return the columns of a file as the map says it is written.

    Raises:
        UserError: a file that cannot be read so.
    """
    form = log_map.form
    if path.suffix == ".npz":
        return replace(read_npz(path), lenient=form.lenient)
    if path.suffix == ".jsonl":
        return read_jsonl(path, form.skip_rows, form.lenient, form.encoding, form.decimal)
    return read_csv(path, form)


def _with_numbers(table: Table, columns: dict[str, Array]) -> dict[str, Array]:
    """Without the streams that hold no number at all, which say nothing."""
    empty = [name for name, column in columns.items() if not np.isfinite(column).any()]
    for name in empty:
        warnings.warn(f"{table.path}: column {name!r} holds no finite number; it is left out", stacklevel=4)
    return {name: column for name, column in columns.items() if name not in empty}


def check_map(log_map: LogMap, channels: Channels) -> None:
    """Refuse names in a map that the model lacks.

    Raises:
        UserError: no such joint or actuator.
    """
    for stream, allowed in (("ctrl", channels.actuators), ("qpos", channels.qpos), ("qvel", channels.qvel)):
        for name in getattr(log_map, stream):
            if name not in allowed:
                raise UserError(f"{log_map.path}: {stream}.{name} is no channel of the model; {suggest(name, allowed)}")


def _columns(table: Table, channels: Channels, log_map: LogMap) -> tuple[dict[str, Array], dict[str, str]]:
    """Return the file's own columns as channels, and {channel: column} of what is needed.

    Text columns that nobody asked for are left out with a warning.
    """
    names = {c: c for c in table.columns} if table.first_line is not None else _npz_names(table, channels)
    clock = log_map.rate is not None or log_map.time != LogMap.time
    own = log_map.sources(table).values() if clock else ()
    out = {"time": log_map.clock(table)} if clock or "time" in table.columns else {}
    for column, name in names.items():
        if name == "time" or (clock and column in own):
            continue
        needed = name.split(":")[0] in STREAMS
        if name in out:
            raise UserError(f"{table.path}: two columns are {name!r}; allowed: one column per channel")
        try:
            out[name] = table.numbers(column)
        except UserError as error:
            if needed:
                raise
            warnings.warn(f"{error}; the column is left out", stacklevel=2)
    sources = {name: column for column, name in names.items() if name == "time" or name.split(":")[0] in STREAMS}
    if clock:
        sources = {**sources, **log_map.sources(table)}
    return out, sources


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
    _whole_joints(table, columns, absent, channels)
    if len(absent) == len(channels.qpos) and len(slow) == len(channels.qvel):
        raise UserError(
            f"{table.path}: no column qpos:<joint> or qvel:<joint>, so there is no motion to compare; it has "
            f"{', '.join(table.columns)}{hint(list(table.columns), mj_model)}"
        )
    home = dict(zip((f"qpos:{n}" for n in channels.qpos), mj_model.qpos0, strict=True))
    rows = len(next(iter(columns.values())))
    blank = {name: np.full(rows, home.get(name, 0.0)) for name in absent}
    positions = [name for name in absent if name.startswith("qpos:")]
    if positions:
        text = f"{table.path}: no column {', '.join(positions)}: this motion is estimated from the measurements"
        warnings.warn(text, stacklevel=4)
    return {**columns, **blank}, tuple(absent)


def _known(table: Table, channels: Channels) -> None:
    """Refuse columns of joints that the model lacks: a wrong name, not a joint without an encoder."""
    for stream, allowed in (("qpos", channels.qpos), ("qvel", channels.qvel)):
        for column in table.columns:
            name = column.partition(":")[2]
            if column.startswith(f"{stream}:") and name not in allowed:
                names = ", ".join(f"{stream}:{n}" for n in allowed)
                text = f"{table.path}: column {column}: the model has no such joint; allowed: {names}"
                key = f"`{stream}: {{{name.strip()}: {column!r}}}`"
                raise UserError(f"{text}; {key} in a map takes it" if name.strip() in allowed else text)


def _whole_joints(table: Table, columns: Mapping[str, Array], absent: list[str], channels: Channels) -> None:
    """Several numbers of one joint (a quaternion) are measured together; a base's position may show in a gyroscope."""
    for joint, kind in zip(channels.joints, channels.kinds, strict=True):
        for stream in ("qpos", "qvel"):
            own = [f"{stream}:{n}" for n in channels.of_joint(joint, stream)]
            lost = [name for name in own if name in absent]
            inertial = kind == "free" and having(columns, "gyro")
            needed = kind in ("free", "ball") and stream == "qpos" and not inertial  # no such motion is estimated
            if lost and (needed or len(lost) < len(own)):
                text = f"{table.path}: missing column(s) {', '.join(lost)}"
                none = ", or none"
                if needed:
                    imu = "gyro:SENSOR[0..2] and accel:SENSOR[0..2] of an inertial measurement unit on it"
                    base = f", or {imu}" if kind == "free" else ""
                    none = f"{base} (only hinges, slides and a floating base may be without)"
                raise UserError(f"{text}; allowed: all {len(own)} of joint {joint!r}{none}")
