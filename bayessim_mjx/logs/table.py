"""Files to named columns: CSV with a header line, NPZ with arrays. Knows the file formats, not the model."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array

_WORDS = {"true": 1.0, "false": 0.0, "": float("nan")}


@dataclass(frozen=True)
class Table:
    """Columns by name, as read; converted to numbers when asked for (a log may hold text columns nobody needs)."""

    path: Path
    columns: Mapping[str, Sequence[str] | NDArray[Any]]
    first_line: int | None = None  # line of row 0 in a text file; None: rows are counted from 0
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # NPZ: joints, actuators
    widths: Mapping[str, int] = field(default_factory=dict)  # NPZ: columns of each array

    @property
    def rows(self) -> int:
        return len(next(iter(self.columns.values())))

    def where(self, row: int) -> str:
        return f"row {row}" if self.first_line is None else f"line {row + self.first_line}"

    def numbers(self, column: str) -> Array:
        """The column as float64 [T]; blank fields are NaN, true/false are 1/0.

        Raises:
            UserError: a field that is no number, naming its line.
        """
        values = self.columns[column]
        try:
            return np.asarray(values).astype(np.float64)
        except (TypeError, ValueError):
            return np.array([self._number(column, row, str(v)) for row, v in enumerate(values)])

    def _number(self, column: str, row: int, text: str) -> float:
        word = text.strip().lower()
        try:
            return _WORDS[word] if word in _WORDS else float(word)
        except ValueError:
            at = f"{self.path}: {self.where(row)}, column {column!r}"
            raise UserError(f"{at}: {text!r} is not a number; allowed: numbers, true, false") from None


def read_csv(path: Path, delimiter: str = ",", header: bool = True) -> Table:
    """Read a CSV file; columns of a file without a header line are called 0, 1, 2 ...

    Raises:
        UserError: no rows, a repeated column, a row of the wrong length.
    """
    try:
        lines = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines(), delimiter=delimiter))
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path}: not a text file ({error}); allowed: CSV with a header line, or NPZ") from None
    while lines and not any(f.strip() for f in lines[-1]):
        lines.pop()
    body = lines[1:] if header else lines
    if not body:
        raise UserError(f"{path}: no data rows; allowed: a header line and one row per sample")
    names = [f.strip().lstrip("#").strip() for f in lines[0]] if header else [str(i) for i in range(len(body[0]))]
    repeated = sorted({n for n in names if names.count(n) > 1})
    if repeated:
        raise UserError(f"{path}: column {repeated[0]!r} appears more than once in the header")
    first = 2 if header else 1
    for row, fields in enumerate(body):
        if len(fields) != len(names):
            allowed = f"allowed: {len(names)} ({', '.join(names)})"
            raise UserError(f"{path}: line {row + first} has {len(fields)} fields; {allowed}")
    return Table(path, {name: [r[i] for r in body] for i, name in enumerate(names)}, first)


def read_npz(path: Path) -> Table:
    """Read an NPZ file: arrays of length T; a 2-D array `a` becomes the columns `a[0]`, `a[1]` ...

    Raises:
        UserError: not an NPZ file, pickled objects, an array of the wrong length.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {k: file[k] for k in file.files}
    except Exception as error:  # zipfile, numpy and zlib each raise their own kinds for a broken archive
        raise UserError(f"{path}: not a readable NPZ file ({error}); allowed: numpy.savez of plain arrays") from None
    names = {k: tuple(map(str, np.atleast_1d(arrays.pop(k)))) for k in ("joints", "actuators") if k in arrays}
    rows = len(arrays["time"]) if "time" in arrays and arrays["time"].ndim == 1 else None
    columns: dict[str, NDArray[Any]] = {}
    widths: dict[str, int] = {}
    for key, value in arrays.items():
        needed = key in ("time", "ctrl", "qpos", "qvel")
        if needed and (value.ndim not in (1, 2) or (rows is not None and len(value) != rows)):
            raise UserError(
                f"{path}: array {key!r} has shape {value.shape}; allowed: {rows or 'T'} rows, as many as 'time'"
            )
        if value.ndim == 1 and (rows is None or len(value) == rows):
            columns[key], widths[key] = value, 1
        elif value.ndim == 2 and (rows is None or len(value) == rows):
            columns.update({f"{key}[{i}]": c for i, c in enumerate(value.T)})
            widths[key] = value.shape[1]
    return Table(path, columns, None, names, widths)
