"""Data sets of LeRobot (versions 2 and 3) as recordings: one per episode."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.importers.needs import needs
from bayessim_mjx.logs.importers.streams import Recording, numbered, recording
from bayessim_mjx.logs.log import Array

STATE, ACTION = "observation.state", "action"
MEANINGS = {"pos": "positions", "vel": "velocities", "effort": "efforts", "torque": "efforts", "current": "efforts"}


def recordings(folder: Path, episodes: Sequence[int] | None = None) -> Iterator[Recording]:
    """One recording per episode, all or those asked for.

    Raises:
        UserError: no data set of LeRobot, no positions or actions in it, no such episode.
    """
    info = _info(folder)
    tables = sorted((folder / "data").rglob("*.parquet"))
    if not tables:
        raise UserError(f"{folder}: no parquet file below data/; allowed: the folder of a LeRobot data set")
    found = set()
    for path in tables:
        columns = _read(path)
        index = columns["episode_index"].astype(int)
        for episode in np.unique(index):
            if episodes is None or int(episode) in episodes:
                found.add(int(episode))
                yield _episode(f"episode_{episode:06d}", {k: c[index == episode] for k, c in columns.items()}, info)
    absent = sorted(set(episodes or ()) - found)
    if absent:
        raise UserError(f"{folder}: no episode {absent[0]}; allowed: 0 to {info.get('total_episodes', 0) - 1}")


def _info(folder: Path) -> Mapping[str, Any]:
    path = folder / "meta" / "info.json"
    try:
        info = json.loads(path.read_text())
        return info if info["features"] and float(info["fps"]) > 0 else {}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{path}: not readable ({error!r}); allowed: a folder with meta/info.json that has fps and features"
        ) from None


def _read(path: Path) -> dict[str, Array]:
    """Return the columns that are needed; lists become [T, n]."""
    parquet = needs("pyarrow.parquet", "from-lerobot", "pyarrow")
    schema = parquet.read_schema(path).names
    missing = [name for name in (STATE, ACTION, "episode_index") if name not in schema]
    if missing:
        raise UserError(f"{path}: no column {missing[0]!r}; it has {', '.join(schema)}")
    names = [n for n in (STATE, ACTION, "episode_index", "frame_index", "timestamp") if n in schema]
    table = parquet.read_table(path, columns=names)
    return {name: np.array(table.column(name).to_pylist(), float) for name in names}


def _episode(name: str, columns: Mapping[str, Array], info: Mapping[str, Any]) -> Recording:
    arrays: dict[str, Array] = {}
    names: dict[str, list[str]] = {}
    for what, (joints, values) in _split(STATE, columns[STATE], info).items():
        arrays[what], names[what] = values, joints
    commands = _split(ACTION, columns[ACTION], info)
    joints = [joint for what in commands for joint in commands[what][0]]
    arrays["commands"], names["commands"] = np.concatenate([v for _, v in commands.values()], 1), joints
    return recording(name, _time(columns, float(info["fps"])), arrays, names)


def _time(columns: Mapping[str, Array], fps: float) -> Array:
    """Return the time stamps; where they are the frames' numbers at the rate, without the rounding of their float32."""
    frames = columns.get("frame_index", np.arange(len(columns["episode_index"]))) / fps
    stamps = columns.get("timestamp", frames)
    return frames if np.max(np.abs(stamps - stamps[0] - frames + frames[0])) < 1e-3 / fps + 1e-4 else stamps


def _split(key: str, values: Array, info: Mapping[str, Any]) -> dict[str, tuple[list[str], Array]]:
    """Return {what: (joints, [T, n])}: `elbow.pos` is a position of the joint elbow, a plain name too."""
    table = values.reshape(len(values), -1)
    given = numbered(_names(info["features"].get(key, {}).get("names")), table.shape[1])
    out: dict[str, tuple[list[str], list[Array]]] = {}
    for name, column in zip(given, table.T, strict=True):
        joint, _, last = name.rpartition(".")
        what = MEANINGS.get(last) if joint else None
        joints, found = out.setdefault(what or "positions", ([], []))
        joints.append(joint if what else name)
        found.append(column)
    return {what: (joints, np.stack(found, 1)) for what, (joints, found) in out.items()}


def _names(given: Any) -> list[str] | None:
    """Names as data sets of any version write them: a list, or lists within a mapping."""
    if isinstance(given, Mapping):
        inner = [_names(value) or [] for value in given.values()]
        return [name for part in inner for name in part]
    return [str(name) for name in given] if isinstance(given, list) else None
