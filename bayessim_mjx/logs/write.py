"""Write logs in the library's own format, CSV or NPZ."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array, Log


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
