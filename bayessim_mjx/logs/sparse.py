"""Files in which each signal has rows of its own, the fields of the others blank: brought onto the positions' clock."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.check import needed_columns
from bayessim_mjx.logs.importers.streams import Stream
from bayessim_mjx.logs.log import Array, Channels
from bayessim_mjx.logs.pieces import MIN_ROWS
from bayessim_mjx.logs.table import Table


def onto_positions(
    table: Table, columns: dict[str, Array], channels: Channels, linear: bool = False
) -> tuple[Table, dict[str, Array]]:
    """Table and columns on the rows of the first joint's positions, where no row of the file holds all that is needed.

    As in recordings of other tools, measured signals are interpolated linearly and commands averaged until the next
    row. Rows before the first sample of a signal are left out.

    Args:
        columns: channels [T], NaN where a field is blank. linear: commands run from one to the next.

    Raises:
        UserError: stamps that run back, or no row at which all signals are known.
    """
    needed = [n for n in needed_columns(columns, channels) if n != "time" and n in columns]
    seen = {name: np.isfinite(columns[name]) for name in needed}
    apart = bool(needed) and not np.all(list(seen.values()), axis=0).any()
    if not apart or min(int(x.sum()) for x in seen.values()) < MIN_ROWS:
        return table, columns
    time = columns["time"]
    if not (np.diff(time) >= 0).all():
        text = f"{table.path}: each signal has rows of its own, and the stamps run back"
        raise UserError(f"{text}; allowed: rows in the order of time")
    first = next(name for name in needed if name.startswith("qpos:") or not any(n.startswith("qpos:") for n in needed))
    rows = np.flatnonzero(seen[first])
    rows = rows[np.r_[True, np.diff(time[rows]) > 0]]
    changed = {"time": time[rows]}
    for name, x in columns.items():
        own = np.isfinite(x)
        if name != "time":
            kind = "measured" if not name.startswith(("ctrl:", "enabled:")) else "linear" if linear else "held"
            changed[name] = Stream(time[own], x[own], kind).on(time[rows]) if own.any() else x[rows]  # type: ignore[arg-type]
    whole = np.isfinite([changed[name] for name in needed]).all(axis=0)
    if not whole.any():
        raise UserError(f"{table.path}: each signal has rows of its own, and at no time all of them are known")
    text = (
        f"{table.path}: each signal has rows of its own; they are brought onto the {int(whole.sum())} rows of {first}"
    )
    warnings.warn(f"{text}, commands as means over each row", stacklevel=4)
    kept = [table.row(int(row)) for row in rows[whole]]
    return dataclasses.replace(table, kept=kept, ragged={}), {name: x[whole] for name, x in changed.items()}


__all__ = ["onto_positions"]
