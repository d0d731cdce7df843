"""HDF5 files as recordings: arrays by their paths, one recording per file, or per group where a path has a `*`."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.importers.needs import needs
from bayessim_mjx.logs.importers.streams import Recording, numbered, recording

WHAT = ("positions", "commands", "velocities", "efforts", "time")
USUAL = {  # of ALOHA's files
    "positions": "observations/qpos",
    "commands": "action",
    "velocities": "observations/qvel",
    "efforts": "observations/effort",
}


@dataclass(frozen=True)
class Paths:
    """Where the arrays lie in the file, and what their columns are called.

    Attributes:
        of: path by what it holds (`WHAT`); a `*` stands for the group of one run.
        rate: rows per second, where there is no array of times.
        joints: names of the columns of positions, velocities and efforts; commands: of the commands.
    """

    of: Mapping[str, str]
    rate: float | None = None
    joints: Sequence[str] | None = None
    commands: Sequence[str] | None = None


def recordings(path: Path, paths: Paths) -> Iterator[Recording]:
    """Return the recordings of one file.

    Raises:
        UserError: no HDF5 file, no array at a path, neither times nor a rate.
    """
    h5py = needs("h5py", "from-hdf5", "h5py")
    if "time" not in paths.of and paths.rate is None:
        raise UserError(f"{path}: neither --time nor --rate; allowed: one of them")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise UserError(f"{path}: not a readable HDF5 file ({error})") from None
    with file:
        every: list[str] = []
        file.visititems(lambda name, thing: every.append(name) if isinstance(thing, h5py.Dataset) else None)
        for run in _runs(path, every, paths.of["positions"]):
            yield _run(path, file, every, run, paths)


def _runs(path: Path, every: Sequence[str], pattern: str) -> list[str]:
    """List the groups that the `*` of the pattern stands for, by their numbers; "" where it has none."""
    pattern = pattern.strip("/")
    if "*" not in pattern:
        return [""]
    first, _, last = pattern.partition("*")
    found = [re.fullmatch(f"{re.escape(first)}([^/]+){re.escape(last)}", name) for name in every]
    runs = [match[1] for match in found if match]
    if not runs:
        raise UserError(f"{path}: no array at {pattern!r}; {_told(every)}")
    return sorted(runs, key=lambda run: [int(x) if x.isdigit() else x for x in re.split(r"(\d+)", run)])


def _run(path: Path, file: Any, every: Sequence[str], run: str, paths: Paths) -> Recording:
    arrays = {}
    for what, pattern in paths.of.items():
        name = pattern.strip("/").replace("*", run)
        if name not in every and what not in WHAT[:2] and pattern == USUAL.get(what):
            continue  # a file of ALOHA's form without velocities or efforts
        if name not in every:
            raise UserError(f"{path}: no array at {name!r} (--{what}); {_told(every)}")
        arrays[what] = np.asarray(file[name], float)
    rows = len(arrays["positions"])
    time = arrays.pop("time").reshape(-1) if "time" in arrays else np.arange(rows) / float(paths.rate or 1.0)
    names = {}
    for what, values in arrays.items():
        count = int(np.prod(values.shape[1:], dtype=int))
        given = paths.commands or paths.joints if what == "commands" else paths.joints
        if given is not None and len(given) != count:
            flag = "--commands_of" if what == "commands" else "--joints"
            raise UserError(
                f"{path}: {what} have {count} columns; allowed: as many names in {flag}, it has {len(given)}"
            )
        names[what] = numbered(given, count)
    return recording(f"{path.stem}_{run}" if run else path.stem, time, arrays, names)


def _told(every: Sequence[str]) -> str:
    return f"it has {', '.join(every[:20])}{' ...' if len(every) > 20 else ''}" if every else "it has none"
