"""Files of logs: those of a folder, its map, the metadata beside a file, and logs in the library's own format."""

from __future__ import annotations

import difflib
import hashlib
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx.config import read_yaml
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.logs.mapping import LogMap

METADATA = (
    "condition", "operating_condition", "controller", "payload", "repeat_of", "sigma", "quantum", "hold",
    "commands_late",
)  # fmt: skip
SUFFIXES = (".csv", ".npz", ".jsonl")
FORMAT = (
    "CSV with the columns time, ctrl:<actuator>, qpos:<joint>[, qvel:<joint>], "
    "NPZ with time, ctrl, qpos[, qvel], joints, actuators, or JSON lines (.jsonl) with the keys of the CSV's columns"
)

Paths = str | Path | Sequence[str | Path]


def map_of_folder(paths: Paths) -> Path | None:
    """Return the `map.yaml` of the one folder that is given, if it has one."""
    given = _listed(paths)
    own = given[0] / "map.yaml" if len(given) == 1 else None
    return own if own is not None and own.is_file() else None


def _listed(paths: Paths) -> list[Path]:
    return [Path(paths)] if isinstance(paths, str | Path) else [Path(p) for p in paths]


def files_of(paths: Paths, log_map: LogMap | None) -> list[Path]:
    """Every log file meant by the path(s), sorted.

    Raises:
        UserError: a path that does not exist, a folder without logs, a file of another kind.
    """
    given = _listed(paths)
    if not given:
        raise UserError(f"real.logs is empty; allowed: a folder of logs, or files: {FORMAT}")
    found: list[Path] = []
    for path in given:
        if path.is_dir():
            pattern = log_map.files if log_map is not None and log_map.files else "*"
            inside = sorted(p for p in path.glob(pattern) if p.is_file() and (pattern != "*" or p.suffix in SUFFIXES))
            if not inside:
                seen = ", ".join(sorted(p.name for p in path.iterdir())[:5]) or "nothing"
                raise UserError(f"{path}: no log matches {pattern!r}; it holds {seen}; allowed: {FORMAT}")
            found += inside
        elif not path.is_file():
            raise UserError(f"{path}: no such file or folder; allowed: a folder of logs, or files: {FORMAT}")
        elif log_map is None and path.suffix not in SUFFIXES:
            raise UserError(f"{path}: unknown kind of file {path.suffix!r}; allowed: {', '.join(SUFFIXES)}, or a map")
        else:
            found.append(path)
    return found


def distinct(files: Sequence[Path]) -> list[Path]:
    """Every recording once: one file named twice, or a copy of it, is no second run and no second condition."""
    first: dict[bytes, Path] = {}
    for path in files:
        same = first.setdefault(hashlib.sha256(path.read_bytes()).digest(), path)
        if same is not path:
            warnings.warn(f"{path}: the same recording as {same}; it counts once", stacklevel=3)
    return list(first.values())


def side_yaml(path: Path) -> Mapping[str, Any]:
    """Read the metadata beside a log: `run1.yaml` of `run1.csv`; warn of a key that looks misspelt."""
    side = path.with_suffix(".yaml")
    content = read_yaml(side) if side.is_file() and side.name != "map.yaml" else {}
    for key in content:
        near = difflib.get_close_matches(str(key), METADATA, n=1, cutoff=0.75)
        if key not in METADATA and near and near[0] not in content:
            warnings.warn(f"{side}: key {key!r} has no meaning here; did you mean {near[0]!r}?", stacklevel=5)
    return content


def write_log(path: str | Path, log: Log, velocity: bool | None = None) -> Path:
    """Write one log; `velocity` (default: where measured) says whether qvel goes into the file.

    Raises:
        UserError: a suffix that is neither .csv nor .npz.
    """
    path = Path(path)
    with_qvel = log.has_qvel if velocity is None else velocity
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npz":
        arrays: dict[str, Any] = {"time": log.time, "ctrl": log.ctrl, "qpos": log.qpos} | (
            {"qvel": log.qvel} if with_qvel else {}
        )
        names = {"joints": np.array(log.joints), "actuators": np.array(log.actuators)}
        np.savez(path, **(arrays | names | dict(log.streams)))
    elif path.suffix == ".csv":
        table = _columns(log, with_qvel)
        np.savetxt(
            path,
            np.stack(list(table.values()), 1),
            ["%.12g"] + ["%.9g"] * (len(table) - 1),
            ",",
            header=",".join(table),
            comments="",
        )
    else:
        raise UserError(f"{path}: unknown kind of file {path.suffix!r}; allowed: .csv, .npz")
    return path


def _columns(log: Log, with_qvel: bool) -> dict[str, Array]:
    table: dict[str, Array] = {"time": log.time}
    blocks = {"ctrl": (log.channels.actuators, log.ctrl), "qpos": (log.channels.qpos, log.qpos)}
    if with_qvel:
        blocks["qvel"] = (log.channels.qvel, log.qvel)
    for stream, (names, values) in blocks.items():
        table.update({f"{stream}:{n}": c for n, c in zip(names, values.T, strict=True)})
    return {name: column for name, column in (table | dict(log.streams)).items() if name not in log.absent}
