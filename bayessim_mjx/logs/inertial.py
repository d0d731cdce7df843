"""Columns of inertial measurement units in files: their names, and rows that hold nothing else."""

from __future__ import annotations

import dataclasses
import re
import warnings
from collections.abc import Iterable

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.check import LARGEST, needed_columns
from bayessim_mjx.logs.log import Array, Channels
from bayessim_mjx.logs.resample import integrals
from bayessim_mjx.logs.table import Table

SIZES = {"gyro": 3, "accel": 3, "quat": 4, "touch": 1}  # numbers of each kind of column
NAMES = {"gyro": "gyroscope", "accel": "accelerometer", "quat": "orientation", "touch": "foot contact"}
UNITS = {"gyro": "rad/s", "accel": "m/s^2", "touch": "N"}
MEAN = "mean:"  # before the name of a column of means around each row
_COLUMN = re.compile(rf"({'|'.join(SIZES)})(?::([^\[\]]+))?(?:\[(\d)\])?")


def column(name: str) -> tuple[str, str, int] | None:
    """(kind, sensor, index) of a column's name, such as `gyro:imu[0]`; None: it belongs to no such sensor."""
    match = _COLUMN.fullmatch(name)
    return (match[1], match[2] or "", int(match[3] or 0)) if match else None


def having(names: Iterable[str], kind: str) -> bool:
    """Whether there are columns of this kind of sensor."""
    return any((found := column(name)) is not None and found[0] == kind for name in names)


def onto_encoders(table: Table, columns: dict[str, Array], channels: Channels) -> tuple[Table, dict[str, Array]]:
    """Table and columns without the rows that hold samples of inertial units alone.

    The unit is often faster than the encoders. The sample nearest to a row stays, for it is compared with a simulation
    at that instant. Means over the time around each row go into further columns (`MEAN`): they keep the way between
    rows.

    Raises:
        UserError: no row holds all commands and positions.
    """
    units = [name for name in columns if column(name) is not None]
    needed = [n for n in needed_columns(columns, channels) if n != "time" and n in columns]
    if not units or not needed:
        return table, columns
    whole = np.isfinite(np.stack([columns[n] for n in needed])).any(axis=0)
    alone = ~whole & np.isfinite(np.stack([columns[n] for n in units])).any(axis=0)
    if not alone.any():
        return table, columns
    time = columns["time"]
    if not whole.any() or not (np.diff(time) > 0).all() or not (np.abs(time) < LARGEST).all():
        raise UserError(
            f"{table.path}: {int(alone.sum())} rows hold samples of an inertial unit alone, and nothing can be put "
            "together; allowed: time that increases in all rows, and rows with all commands and positions"
        )
    rows = np.flatnonzero(~alone)
    changed = {name: x[rows] for name, x in columns.items()}
    for name in units:
        seen = np.isfinite(columns[name])
        given = time[seen], columns[name][seen], time[rows]
        if seen.any():
            changed[name] = _nearest(*given)
        if seen.any() and name.startswith(("gyro", "accel")):
            changed[MEAN + name] = _means(*given)
    lines = [table.row(int(row)) for row in rows]
    text = f"{table.path}: {int(alone.sum())} rows hold samples of an inertial unit alone"
    text = f"{text}: their means go into the {len(rows)} others"
    warnings.warn(text, stacklevel=4)
    return dataclasses.replace(table, kept=lines), changed


def _means(time: Array, x: Array, rows: Array) -> Array:
    """Means of what runs linearly from sample to sample, over the time that is nearest to each row."""
    middles = 0.5 * (rows[1:] + rows[:-1])
    half = float(np.median(np.diff(rows))) / 2 if len(rows) > 1 else 0.0
    edges = np.concatenate([[rows[0] - half], middles, [rows[-1] + half]])
    if half <= 0.0:
        return np.interp(rows, time, x)
    area = integrals(time, x[:, None], edges, (half, half), linear=True)[:, 0]
    return np.asarray(np.diff(area) / np.diff(edges))


def _nearest(time: Array, x: Array, rows: Array) -> Array:
    after = np.clip(np.searchsorted(time, rows), 1, max(len(time) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(time) - 1)
    return np.asarray(np.where(rows - time[before] <= time[after] - rows, x[before], x[after]))
