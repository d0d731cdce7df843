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
from bayessim_mjx.logs import instants
from bayessim_mjx.logs.log import Array

_WORDS = {"true": 1.0, "yes": 1.0, "on": 1.0, "false": 0.0, "no": 0.0, "off": 0.0, "": float("nan")}
_NUMBERS = "biufUS"  # NumPy's kinds of arrays that hold numbers, or texts of numbers
_DELIMITERS = {";": "semicolons", "\t": "tabs", "|": "bars", " ": "blanks"}


@dataclass(frozen=True)
class Table:
    """Columns by name, as read; converted to numbers when asked for (a log may hold text columns nobody needs)."""

    path: Path
    columns: Mapping[str, Sequence[str] | NDArray[Any]]
    first_line: int | None = None  # line of row 0 in a text file; None: rows are counted from 0
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # NPZ: joints, actuators
    widths: Mapping[str, int] = field(default_factory=dict)  # NPZ: columns of each array
    lenient: bool = False  # what is no number is NaN (`bad_rows` in a map)
    ragged: Mapping[int, str] = field(default_factory=dict)  # lenient: rows that hold nothing, and what is wrong there
    kept: Sequence[int] | None = None  # rows of the file, counted from its first, where some were left out

    @property
    def rows(self) -> int:
        return len(next(iter(self.columns.values())))

    def row(self, row: int) -> int:
        """The row as the file counts it."""
        return row if self.kept is None else int(self.kept[row])

    def where(self, row: int) -> str:
        return f"row {self.row(row)}" if self.first_line is None else f"line {self.row(row) + self.first_line}"

    def times(self, column: str) -> Array:
        """The column [T] in its own unit, or in seconds since the first row where it holds dates (ISO 8601).

        Raises:
            UserError: a field that is neither, naming its line.
        """
        values = self.columns[column]
        texts = values.dtype.kind in "US" if isinstance(values, np.ndarray) else True
        if not texts or not instants.dated(map(str, values)):
            return self.numbers(column)
        at = f"{self.path}: column {column!r}, "
        return instants.seconds([str(v) for v in values], lambda row: at + self.where(row), self.lenient)

    def unreadable(self, column: str) -> dict[int, str]:
        """Rows of a column whose field is neither blank nor a number, and what is there; only where `lenient`."""
        values = self.columns[column]
        if isinstance(values, np.ndarray) and values.dtype.kind not in "US":
            return {}
        nothing = ~np.isfinite(self.times(column))
        rows = (row for row in np.flatnonzero(nothing).tolist() if str(values[row]).strip().lower() not in ("", "nan"))
        return {row: f"column {column!r} holds {values[row]!r}" for row in rows}

    def numbers(self, column: str) -> Array:
        """The column as float64 [T]; blank fields are NaN. A column of words alone: true, yes, on are 1, the others 0.

        Raises:
            UserError: a field that is no number, naming its line.
        """
        values = self.columns[column]
        if isinstance(values, np.ndarray) and values.dtype.kind not in _NUMBERS:
            raise UserError(f"{self.path}: column {column!r} holds {values.dtype}; allowed: real numbers")
        try:
            if not isinstance(values, np.ndarray) and not all(map(str.isascii, values)):
                raise ValueError("digits of other scripts")
            return np.asarray(values).astype(np.float64)
        except (TypeError, ValueError):
            words = [str(v).strip().lower() for v in values]
            switch = self._switch(words)
            return np.array([self._number(column, row, word, switch) for row, word in enumerate(words)])

    def _switch(self, words: Sequence[str]) -> bool:
        """Whether words stand for on and off; where `lenient`, besides others that stand for nothing."""
        known = [word in _WORDS for word in words if word]
        return any(known) and not any(map(_is_number, words)) if self.lenient else all(known)

    def _number(self, column: str, row: int, text: str, switch: bool) -> float:
        try:
            if not text.isascii():
                raise ValueError("digits of other scripts")
            return _WORDS[text] if switch or not text else float(text)
        except (ValueError, KeyError):
            if self.lenient:
                return float("nan")
            at = f"{self.path}: {self.where(row)}, column {column!r}"
            raise UserError(
                f"{at}: {text!r} is not a number; allowed: numbers, or a column of true, false, yes, no, on, off"
            ) from None


def _is_number(text: str) -> bool:
    try:
        return np.isfinite(float(text))
    except ValueError:
        return False


def read_csv(path: Path, delimiter: str = ",", header: bool = True, skip_rows: int = 0, lenient: bool = False) -> Table:
    """Read a CSV file; columns of a file without a header line are called 0, 1, 2 ...

    A column without a name is called `unnamed <its number>`, or left out where it is blank throughout, as after a comma
    at the end of each line.

    Args:
        skip_rows: lines before the header, or before the first row where there is none.
        lenient: a row of the wrong length becomes one that holds nothing (`bad_rows`).

    Raises:
        UserError: no rows, a repeated column, a row of the wrong length, another delimiter.
    """
    try:
        text = path.read_text(encoding="utf-8-sig").splitlines()[skip_rows:]
        lines = list(csv.reader(text, delimiter=delimiter))
    except (UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path}: not a text file ({error}); allowed: CSV with a header line, or NPZ") from None
    while lines and not any(f.strip() for f in lines[-1]):
        lines.pop()
    body = lines[1:] if header else lines
    if not body:
        raise UserError(f"{path}: no data rows; allowed: a header line and one row per sample")
    names = [f.strip().lstrip("#").strip() for f in lines[0]] if header else [str(i) for i in range(len(body[0]))]
    other = next((d for d in _DELIMITERS if d in names[0]), None) if len(names) == 1 else None
    if other is not None:
        mend = f"`delimiter: {other!r}` in a map (docs/logs.md)"
        raise UserError(
            f"{path}: one column {names[0]!r}: its fields are parted by {_DELIMITERS[other]}; mend it with {mend}"
        )
    unnamed = [i for i, name in enumerate(names) if not name]
    names = [name or f"unnamed {i}" for i, name in enumerate(names)]
    repeated = sorted({n for n in names if names.count(n) > 1})
    if repeated:
        raise UserError(f"{path}: column {repeated[0]!r} appears more than once in the header")
    first = skip_rows + (2 if header else 1)
    ragged = {row: f"{len(fields)} fields" for row, fields in enumerate(body) if len(fields) != len(names)}
    if ragged and not lenient:
        row = min(ragged)
        raise UserError(f"{path}: line {row + first} has {ragged[row]}; allowed: {len(names)} ({', '.join(names)})")
    body = [[""] * len(names) if row in ragged else fields for row, fields in enumerate(body)]
    columns = {name: [r[i] for r in body] for i, name in enumerate(names)}
    blank = {names[i] for i in unnamed if not any(r[i].strip() for r in body)}
    columns = {name: column for name, column in columns.items() if name not in blank}
    return Table(path, columns, first, lenient=lenient, ragged=ragged)


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
    names = {k: tuple(map(str, np.ravel(arrays.pop(k)))) for k in ("joints", "actuators") if k in arrays}
    for key, given in names.items():
        if twice := sorted({n for n in given if given.count(n) > 1}):
            raise UserError(f"{path}: array {key!r} names {twice[0]!r} more than once; allowed: one column per channel")
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
