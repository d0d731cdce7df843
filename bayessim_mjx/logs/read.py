"""Read recorded motion: CSV or NPZ, one file per run, checked row by row before anything is simulated."""

from __future__ import annotations

import difflib
import hashlib
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from bayessim_mjx.config import read_yaml
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.check import STREAMS, check_channels, check_motion, check_time
from bayessim_mjx.logs.log import Array, Channels, Log, suggest
from bayessim_mjx.logs.mapping import LogMap
from bayessim_mjx.logs.signals import estimate_velocity, noise_level
from bayessim_mjx.logs.table import Table, read_csv, read_npz
from bayessim_mjx.physics import controllers

MIN_ROWS = 10
MAX_GAP = 5.0  # sample periods without a sample after which a file is cut in two
SHORT_GAP = 0.01  # s; shorter pauses are bridged however fast the file is
METADATA = ("condition", "operating_condition", "controller", "payload", "repeat_of", "sigma", "quantum")
_SUFFIXES = (".csv", ".npz")
_FORMAT = (
    "CSV with the columns time, ctrl:<actuator>, qpos:<joint>[, qvel:<joint>], "
    "or NPZ with time, ctrl, qpos[, qvel], joints, actuators"
)

Paths = str | Path | Sequence[str | Path]


def read_logs(
    paths: Paths, mj_model: mujoco.MjModel, map: str | Path | Mapping[str, Any] | LogMap | None = None
) -> list[Log]:
    """Read all runs of a folder (or the files named), in the model's order of joints and actuators.

    A folder's own `map.yaml` is used where `map` is not given. Files are cut at gaps longer than MAX_GAP periods and
    10 ms; `<file stem>.yaml` beside a file becomes its metadata; `sigma` and `quantum` there, {<channel>: value},
    replace the estimates of a channel's noise and resolution.

    Raises:
        UserError: whatever is wrong with a file, naming the file, its column and row, and what is allowed.
    """
    chosen = map if map is not None else _map_of_folder(paths)
    log_map = chosen if chosen is None or isinstance(chosen, LogMap) else LogMap.read(chosen)
    channels = Channels.of(mj_model)
    if log_map is not None:
        _check_map(log_map, channels)
    files = _distinct(_files(paths, log_map))
    logs = [log for path in files for log in _read_one(path, mj_model, channels, log_map)]
    _check_repeats(logs)
    return logs


def _distinct(files: Sequence[Path]) -> list[Path]:
    """Every recording once: one file named twice, or a copy of it, is no second run and no second condition."""
    first: dict[bytes, Path] = {}
    for path in files:
        same = first.setdefault(hashlib.sha256(path.read_bytes()).digest(), path)
        if same is not path:
            warnings.warn(f"{path}: the same recording as {same}; it counts once", stacklevel=3)
    return list(first.values())


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


def _map_of_folder(paths: Paths) -> Path | None:
    given = _listed(paths)
    own = given[0] / "map.yaml" if len(given) == 1 else None
    return own if own is not None and own.is_file() else None


def _listed(paths: Paths) -> list[Path]:
    return [Path(paths)] if isinstance(paths, str | Path) else [Path(p) for p in paths]


def _files(paths: Paths, log_map: LogMap | None) -> list[Path]:
    """Every log file meant by the path(s), sorted.

    Raises:
        UserError: a path that does not exist, a folder without logs, a file of another kind.
    """
    given = _listed(paths)
    if not given:
        raise UserError(f"real.logs is empty; allowed: a folder of logs, or files: {_FORMAT}")
    found: list[Path] = []
    for path in given:
        if path.is_dir():
            pattern = log_map.files if log_map is not None and log_map.files else "*"
            inside = sorted(p for p in path.glob(pattern) if p.is_file() and (pattern != "*" or p.suffix in _SUFFIXES))
            if not inside:
                seen = ", ".join(sorted(p.name for p in path.iterdir())[:5]) or "nothing"
                raise UserError(f"{path}: no log matches {pattern!r}; it holds {seen}; allowed: {_FORMAT}")
            found += inside
        elif not path.is_file():
            raise UserError(f"{path}: no such file or folder; allowed: a folder of logs, or files: {_FORMAT}")
        elif log_map is None and path.suffix not in _SUFFIXES:
            raise UserError(f"{path}: unknown kind of file {path.suffix!r}; allowed: {', '.join(_SUFFIXES)}, or a map")
        else:
            found.append(path)
    return found


def _read_one(path: Path, mj_model: mujoco.MjModel, channels: Channels, log_map: LogMap | None) -> list[Log]:
    if path.suffix == ".npz":
        table = read_npz(path)
    else:
        table = read_csv(path, *((log_map.delimiter, log_map.header) if log_map else ()))
    columns = log_map.apply(table) if log_map is not None else _columns(table, channels)
    check_channels(table, columns, channels)
    check_time(table, columns["time"], MIN_ROWS)
    metadata = {**(log_map.metadata if log_map else {}), **_side_yaml(path), "source": str(path)}
    law = controllers.read(
        metadata, mj_model, channels.actuators, str(path)
    )  # refused here, before anything is simulated
    check_motion(table, columns, channels, mj_model, np.asarray(law.through))
    columns = _with_numbers(table, columns)
    if "condition" in metadata:
        metadata.setdefault("operating_condition", metadata["condition"])
    return _pieces(table, columns, channels, metadata)


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
            raise UserError(
                f"{table.path}: no array {key!r} with the names of the {stream} columns; allowed: {_FORMAT}"
            )
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


def _side_yaml(path: Path) -> Mapping[str, Any]:
    side = path.with_suffix(".yaml")
    content = read_yaml(side) if side.is_file() and side.name != "map.yaml" else {}
    for key in content:
        near = difflib.get_close_matches(str(key), METADATA, n=1, cutoff=0.75)
        if key not in METADATA and near and near[0] not in content:
            warnings.warn(f"{side}: key {key!r} has no meaning here; did you mean {near[0]!r}?", stacklevel=5)
    return content


def _pieces(table: Table, columns: Mapping[str, Array], channels: Channels, metadata: Mapping[str, Any]) -> list[Log]:
    """The file as one log, or as several where samples are missing for long."""
    time = columns["time"]
    steps = np.diff(time)
    gaps = np.flatnonzero(steps > max(MAX_GAP * float(np.median(steps)), SHORT_GAP))
    edges = [0, *(gaps + 1), len(time)]
    spans = [(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True) if b - a >= MIN_ROWS]
    if len(gaps):
        worst = gaps[np.argmax(steps[gaps])]
        text = (
            f"{table.path}: {len(gaps)} gap(s) in time, the largest {steps[worst]:.4g} s "
            f"after {table.where(int(worst))} (median period {np.median(steps):.4g} s)"
        )
        if not spans:
            raise UserError(f"{text}; no run of {MIN_ROWS} samples is left; allowed: gaps up to {MAX_GAP:g} periods")
        warnings.warn(f"{text}; cut into {len(spans)} run(s)", stacklevel=2)
    names = [table.path.name] if len(spans) == 1 else [f"{table.path.name}#{k}" for k in range(len(spans))]
    return [
        _log(name, {k: c[a:b] for k, c in columns.items()}, channels, metadata)
        for name, (a, b) in zip(names, spans, strict=True)
    ]


def _log(name: str, columns: Mapping[str, Array], channels: Channels, metadata: Mapping[str, Any]) -> Log:
    rows = len(columns["time"])

    def stack(stream: str, names: Sequence[str]) -> Array:
        return np.stack([columns[f"{stream}:{n}"] for n in names], 1) if names else np.zeros((rows, 0))

    sigma, grain = (_known(metadata, key, columns, channels) for key in ("sigma", "quantum"))

    def spread_of(stream: str, names: Sequence[str], x: Array) -> Array:
        keys = [f"{stream}:{n}" for n in names]
        level = [sigma[k] if k in sigma else noise_level(c, grain.get(k)) for k, c in zip(keys, x.T, strict=True)]
        return np.array(level)

    qpos = stack("qpos", channels.qpos)
    sigma_qpos = spread_of("qpos", channels.qpos, qpos)
    velocity, spread = estimate_velocity(columns["time"], qpos, channels, sigma_qpos)
    has_qvel = all(f"qvel:{n}" in columns for n in channels.qvel)
    if has_qvel:
        measured = stack("qvel", channels.qvel)
        _compare(name, measured, velocity, spread, channels)
        velocity, spread = measured, spread_of("qvel", channels.qvel, measured)
    used = {"time"} | {
        f"{s}:{n}" for s in ("ctrl", "qpos", "qvel") for n in getattr(channels, s if s != "ctrl" else "actuators")
    }
    return Log(
        name=name,
        time=columns["time"],
        ctrl=stack("ctrl", channels.actuators),
        qpos=qpos,
        qvel=velocity,
        has_qvel=has_qvel,
        channels=channels,
        sigma_qpos=sigma_qpos,
        sigma_qvel=spread,
        streams={k: c for k, c in columns.items() if k not in used},
        metadata=metadata,
    )


def _known(metadata: Mapping[str, Any], key: str, columns: Mapping[str, Array], channels: Channels) -> dict[str, float]:
    """Declared noise or quantum per column; `<joint>` is short for `qpos:<joint>`."""
    given, source = metadata.get(key) or {}, metadata["source"]
    if not isinstance(given, Mapping):
        raise UserError(f"{source}: {key} = {given!r} in its side YAML; allowed: a mapping '<channel>: value'")
    out = {}
    for name, value in given.items():
        column = f"qpos:{name}" if name in channels.qpos else str(name)
        if column not in columns or column == "time":
            allowed = [c for c in columns if c != "time"]
            raise UserError(f"{source}: {key}.{name} in its side YAML: no such channel; {suggest(str(name), allowed)}")
        number = isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)
        if not number or value < 0 or (key == "sigma" and value == 0):  # 0 would make every gap an infinite one
            least = "a number > 0" if key == "sigma" else "a number >= 0"
            raise UserError(f"{source}: {key}.{name} = {value!r} in its side YAML; allowed: {least}")
        out[column] = float(value)
    return out


def _compare(name: str, measured: Array, estimated: Array, spread: Array, channels: Channels) -> None:
    """Warn where the logged velocity is not the derivative of the logged position (unit, sign)."""
    for channel, v, w, s in zip(channels.qvel, measured.T, estimated.T, spread, strict=True):
        energy = float(w @ w)
        if energy <= 9.0 * len(w) * s**2 or energy == 0.0:
            continue
        slope = float(v @ w) / energy
        if not 0.7 < slope < 1.4:
            text = f"{name}: qvel:{channel} is about {slope:.3g} times the derivative of qpos:{channel}"
            warnings.warn(f"{text}; allowed: the same unit and sign per second (mend it in the map)", stacklevel=2)
