"""Rows that cannot be used (`bad_rows` in a map), that a recorder wrote twice, or that stand in reverse order."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterable, Mapping

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.check import LARGEST, needed_columns
from bayessim_mjx.logs.log import Array, Channels
from bayessim_mjx.logs.mapping import LogMap
from bayessim_mjx.logs.pieces import MIN_ROWS
from bayessim_mjx.logs.signals import COUNTS, LEVELS, STEPS, quantum
from bayessim_mjx.logs.table import Table
from bayessim_mjx.logs.turns import MOST
from bayessim_mjx.quantities import percent


def leave_out(
    table: Table, columns: dict[str, Array], sources: Mapping[str, str], channels: Channels, policy: str
) -> tuple[Table, dict[str, Array]]:
    """Table and columns without the rows that cannot be used, with a warning that counts them.

    `drop` leaves out a row with any field that is no number, `nan` only those without a time, a command or a
    position: its other fields that are no number are then missing values.

    Args:
        columns: channels [T], NaN where a field is no number.
        sources: the table's column of each channel.
        policy: drop or nan.
    """
    used = {name: source for name, source in sources.items() if name in columns}
    unreadable = {r: text for name, c in used.items() for r, text in table.unreadable(c, columns[name]).items()}
    bad = dict(table.ragged) | (unreadable if policy == "drop" else {})
    for name in needed_columns(columns, channels):
        for row in np.flatnonzero(~(np.abs(columns[name]) < LARGEST)).tolist():
            bad.setdefault(row, unreadable.get(row, f"column {name!r} holds {columns[name][row]}"))
    for row in _not_after(columns["time"], bad):
        bad[row] = f"time {columns['time'][row]:.9g} s is not after that of the row before"
    missing = len(set(unreadable) - set(bad))
    if not bad and not missing:
        return table, columns
    _tell(table, bad, unreadable, missing, policy, len(columns["time"]))
    rows = np.array([row for row in range(len(columns["time"])) if row not in bad], dtype=np.int64)
    lines = [table.row(int(row)) for row in rows]
    return dataclasses.replace(table, kept=lines), {name: column[rows] for name, column in columns.items()}


def _not_after(time: Array, bad: Iterable[int]) -> list[int]:
    """Rows whose time stands still or runs back, seen from the last row that is kept."""
    out, last, left_out = [], -np.inf, set(bad)
    for row, now in enumerate(time):
        if row in left_out:
            continue
        if now <= last:
            out.append(row)
        else:
            last = now
    return out


def _tell(
    table: Table, bad: Mapping[int, str], unreadable: Mapping[int, str], missing: int, policy: str, rows: int
) -> None:
    texts = []
    if bad:
        first = min(bad)
        texts += [f"{len(bad)} of {rows} rows ({percent(len(bad) / rows)}) left out"]
        texts += [f"first {table.where(first)}: {bad[first]}"]
    if missing:
        first = min(set(unreadable) - set(bad))
        texts += [f"fields of {missing} row(s) count as missing, first {table.where(first)}: {unreadable[first]}"]
    warnings.warn(f"{table.path}: bad_rows: {policy}: {'; '.join(texts)}", stacklevel=4)


def check_markers(
    table: Table, columns: Mapping[str, Array], sources: Mapping[str, str], channels: Channels, log_map: LogMap
) -> None:
    """Positions do not leave their motion to one same value and return at once: that value stands for a missing one.

    Raises:
        UserError: a position does so three times or more; names the key `missing`.
    """
    stated = {name for name, source, _ in log_map.channels() if source.missing is not None}
    single = [j for j, kind in zip(channels.joints, channels.kinds, strict=True) if kind in ("hinge", "slide")]
    for joint in single:
        name = f"qpos:{joint}"
        x = columns.get(name, np.zeros(0))
        if name in stated or len(x) < MIN_ROWS or not np.isfinite(x).all():
            continue
        steps, across = np.abs(np.diff(x)), np.abs(x[2:] - x[:-2])
        usual = max(STEPS * float(np.median(across)), COUNTS * quantum(x))
        out = (steps[:-1] > usual) & (steps[1:] > usual) & (across < usual)
        values, counts = np.unique(x[1:-1][out], return_counts=True)
        marked = values[(counts >= LEVELS) & (counts >= MOST * np.array([np.sum(x == v) for v in values]))]
        if len(marked):
            row = int(np.flatnonzero(x == marked[0])[0])
            count = int(np.sum(x == marked[0]))
            text = f"{table.path}: column {name!r} leaves its motion for {marked[0]:.6g} in {count} rows"
            key = f"`qpos: {{{joint}: {{column: {sources.get(name, name)!r}, missing: RAW_NUMBER}}}}`"
            raise UserError(f"{text}, first {table.where(row)}; {key} and `bad_rows: drop` in a map leave them out")


def oldest_first(table: Table, columns: dict[str, Array]) -> tuple[Table, dict[str, Array]]:
    """Table and columns [T] with the rows in the order of time, where they stand newest first, with a warning."""
    steps = np.diff(columns["time"])
    seen = steps[np.isfinite(steps)]
    if not len(seen) or not ((seen <= 0).all() and (seen < 0).any()):
        return table, columns
    last = table.rows - 1
    warnings.warn(
        f"{table.path}: the rows stand newest row first; they are read from the last to the first", stacklevel=4
    )
    changed = dataclasses.replace(
        table,
        columns={name: column[::-1] for name, column in table.columns.items()},
        ragged={last - row: why for row, why in table.ragged.items()},
        kept=[table.row(row) for row in range(last, -1, -1)],
    )
    return changed, {name: column[::-1] for name, column in columns.items()}


def without_copies(table: Table, columns: dict[str, Array]) -> tuple[Table, dict[str, Array]]:
    """Table and columns [T] without rows that repeat the row before them, with a warning that counts them.

    Rows with the same stamp and another value stay, and are refused later: nothing says which of them holds.
    """
    time = columns["time"]
    if len(time) < 2 or (np.diff(time) != 0).all():
        return table, columns
    every = np.stack(list(columns.values()), 1)
    same = (every[1:] == every[:-1]) | (np.isnan(every[1:]) & np.isnan(every[:-1]))
    copies = np.r_[False, same.all(axis=1)]
    if not copies.any() or copies.all():
        return table, columns
    first = int(np.flatnonzero(copies)[0])
    text = f"{table.path}: {int(copies.sum())} row(s) repeat the row before them, first {table.where(first)}"
    warnings.warn(f"{text}; each counts once", stacklevel=4)
    kept = np.flatnonzero(~copies)
    lines = [table.row(int(row)) for row in kept]
    return dataclasses.replace(table, kept=lines), {name: column[kept] for name, column in columns.items()}
