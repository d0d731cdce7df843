"""Rows that a recorder wrote twice: the same stamp and the same values in every channel."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np

from bayessim_mjx.logs.log import Array
from bayessim_mjx.logs.table import Table


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


__all__ = ["without_copies"]
