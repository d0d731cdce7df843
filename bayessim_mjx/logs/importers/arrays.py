"""Arrays of one sampling as a recording: what LeRobot's tables and HDF5 files hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.importers.streams import Recording, Stream
from bayessim_mjx.logs.log import Array


def recording(
    name: str, time: Array, arrays: Mapping[str, Array], names: Mapping[str, Sequence[str]], notes: Sequence[str] = ()
) -> Recording:
    """The recording of arrays `positions`, `commands` [T, n] and, where there are some, `velocities` and `efforts`.

    Args:
        name: of the run.
        time: [T], s.
        arrays: by what they are.
        names: of the columns of each.
        notes: what the user should know.

    Raises:
        UserError: another number of rows or columns than times or names.
    """
    streams: dict[str, dict[str, Stream]] = {}
    for what, values in arrays.items():
        table = np.asarray(values, float).reshape(len(values), -1)
        if table.shape != (len(time), len(names[what])):
            allowed = f"allowed: {len(time)} rows, as many as times, of {', '.join(names[what])}"
            raise UserError(f"{name}: {what} of shape {np.shape(values)}; {allowed}")
        kind = "held" if what == "commands" else "measured"
        streams[what] = {j: Stream(time, c, kind) for j, c in zip(names[what], table.T, strict=True)}  # type: ignore[arg-type]
    return Recording(name, **streams, notes=notes)  # type: ignore[arg-type]


def numbered(given: Sequence[str] | None, count: int) -> list[str]:
    """Names of `count` columns: those given where they are as many, else `joint0`, `joint1` ..."""
    return list(given) if given is not None and len(given) == count else [f"joint{i}" for i in range(count)]
