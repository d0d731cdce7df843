"""Named columns of one file, and NPZ files as such. Knows the file formats, not the model."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import instants
from bayessim_mjx.logs.log import Array
from bayessim_mjx.logs.texts import Marks, lines_of

_WORDS = {"true": 1.0, "yes": 1.0, "on": 1.0, "false": 0.0, "no": 0.0, "off": 0.0, "": float("nan")}
_COMMAS = Marks(",")
_NUMBERS = "biufUS"  # NumPy's kinds of arrays that hold numbers, or texts of numbers


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
    marks: Marks = Marks()  # in the numbers of a text file
    kept: Sequence[int] | None = None  # rows of the file, counted from its first, where some were left out

    @property
    def rows(self) -> int:
        return len(next(iter(self.columns.values())))

    def row(self, row: int) -> int:
        """Return the row as the file counts it."""
        return row if self.kept is None else int(self.kept[row])

    def where(self, row: int) -> str:
        return f"row {self.row(row)}" if self.first_line is None else f"line {self.row(row) + self.first_line}"

    def dated(self, column: str) -> bool:
        """Whether the column holds dates or times of day."""
        values = self.columns[column]
        texts = values.dtype.kind in "US" if isinstance(values, np.ndarray) else True
        return texts and instants.dated(map(str, values))

    def times(self, column: str, date: str | None = None, form: str | None = None) -> Array:
        """Seconds [T] since the first row of a column of dates or times of day.

        Args:
            date: column with the dates, where `column` has times of day. form: as of `instants.seconds`.

        Raises:
            UserError: a field that is no time, naming its line.
        """
        fields = [str(v).strip() for v in self.columns[column]]
        if date is not None:
            fields = [f"{str(d).strip()} {t}".strip() for d, t in zip(self.columns[date], fields, strict=True)]
        at = f"{self.path}: column {column!r}, "
        return instants.seconds(fields, lambda row: at + self.where(row), self.lenient, form)

    def unreadable(self, column: str, found: Array) -> dict[int, str]:
        """Rows of a column whose field is neither blank nor a number, and what is there; only where `lenient`.

        Args:
            found: [T], what was read of it, NaN where nothing was.
        """
        values = self.columns[column]
        if isinstance(values, np.ndarray) and values.dtype.kind not in "US":
            return {}
        rows = (r for r in np.flatnonzero(~np.isfinite(found)).tolist() if _filled(str(values[r])))
        return {row: f"column {column!r} holds {values[row]!r}" for row in rows}

    def numbers(self, column: str, suffix: str = "") -> Array:
        """Read the column as float64 [T]; blank fields are NaN. Of words alone true, yes and on are 1, the others 0.

        Args:
            suffix: text behind each number, such as its unit.

        Raises:
            UserError: a field that is no number, naming its line.
        """
        values = self.columns[column]
        if suffix and not isinstance(values, np.ndarray):
            bare = [v.strip().removesuffix(suffix.strip()).strip() for v in values]
            return replace(self, columns={column: bare}).numbers(column)
        if isinstance(values, np.ndarray) and values.dtype.kind not in _NUMBERS:
            raise UserError(f"{self.path}: column {column!r} holds {values.dtype}; allowed: real numbers")
        if self.marks == _COMMAS and not isinstance(values, np.ndarray) and not any("." in v for v in values):
            values = [v.replace(",", ".") for v in values]  # as a whole, which is faster than field by field
        try:
            if not (self.marks.plain or self.marks == _COMMAS) or (
                not isinstance(values, np.ndarray) and not all(v.isascii() and "_" not in v for v in values)
            ):
                raise ValueError("to be read field by field")
            return np.asarray(values).astype(np.float64)
        except (TypeError, ValueError):
            words = [str(v).strip().lower() for v in self.columns[column]]
            switch = self._switch(words)
            return np.array([self._number(column, row, word, switch) for row, word in enumerate(words)])

    def _switch(self, words: Sequence[str]) -> bool:
        """Whether words stand for on and off; where `lenient`, besides others that stand for nothing."""
        known = [word in _WORDS for word in words if word]
        return any(known) and not any(map(_is_number, words)) if self.lenient else all(known)

    def _number(self, column: str, row: int, text: str, switch: bool) -> float:
        try:
            if "_" in text:
                raise ValueError("a mark that only programs allow")
            return _WORDS[text] if switch or not text else self.marks.number(text)
        except (ValueError, KeyError):
            if self.lenient and not (self.marks.doubt and "," in text):
                return float("nan")
            at = f"{self.path}: {self.where(row)}, column {column!r}"
            allowed = "allowed: numbers, or a column of true, false, yes, no, on, off"
            raise UserError(f"{at}: {self._wrong(text)}; {allowed}") from None

    def _wrong(self, text: str) -> str:
        """Why a field is no number, and the key of the map that mends it."""
        if self.marks.doubt and "," in text:
            return f"{text!r} {self.marks.doubt}"
        if self.marks.stated and re.search(r"\d[.,]\d", text):
            marks = f"`decimal: {self.marks.decimal!r}`, `thousands: {self.marks.thousands!r}`"
            return f"{text!r} is not a number by {marks} of the map; `thousands` is the mark between groups of three"
        if re.fullmatch(r"[+-]?[\d.,'\s]+", text):
            return f"{text!r} is not a number; `decimal` and `thousands` in a map state the marks in it (docs/logs.md)"
        if match := re.fullmatch(r"[+-]?\d[\d.,]*(?:e[+-]?\d+)?(\s*[^\d\s.,_:#/+-].*)", text):
            return (
                f"{text!r} has a unit behind its number; `suffix: {match[1]!r}` of the channel in a map passes over it"
            )
        return f"{text!r} is not a number; `bad_rows: drop` or `bad_rows: nan` in a map leaves such fields out"


def _filled(text: str) -> bool:
    return text.strip().lower() not in ("", "nan")


def _is_number(text: str) -> bool:
    try:
        return np.isfinite(float(text))
    except ValueError:
        return False


def read_npz(path: Path) -> Table:
    """Read an NPZ file: arrays of length T; a 2-D array `a` becomes the columns `a[0]`, `a[1]` ...

    Raises:
        UserError: not an NPZ file, pickled objects, an array of the wrong length.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {k: _in_seconds(file[k]) for k in file.files}
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


def _in_seconds(x: NDArray[Any]) -> NDArray[Any]:
    """Dates as seconds since the first of them, spans as seconds, and all else as it is."""
    if x.dtype.kind not in "mM" or not x.size:
        return x
    return (x - x.ravel()[0] if x.dtype.kind == "M" else x) / np.timedelta64(1, "s")


# JSON lines: one object per line and sample; objects within it join their keys by `:`, lists number theirs


ALLOWED = 'allowed: one object per line, as {"time": 0.01, "ctrl": {"motor": 1.2}, "qpos": {"elbow": 0.3}}'


def read_jsonl(
    path: Path, skip_rows: int = 0, lenient: bool = False, encoding: str | None = None, decimal: str | None = None
) -> Table:
    """Read JSON lines: `{"qpos": {"elbow": 1}}` is the column `qpos:elbow`, `{"q": [1, 2]}` are `q[0]` and `q[1]`.

    A key that a line lacks, or null, is a blank field. Empty lines are passed over.

    Args:
        skip_rows: lines before the first sample.
        lenient: a line that is no object becomes a row that holds nothing (`bad_rows`).
        encoding: as the map states it, or None. decimal: the mark in texts that hold numbers.

    Raises:
        UserError: a line that is no object, two keys that name the same column, no sample.
    """
    lines = lines_of(path, encoding, ALLOWED)
    rows: list[dict[str, str]] = []
    at: list[int] = []
    ragged: dict[int, str] = {}
    for number, line in enumerate(lines[skip_rows:], skip_rows + 1):
        if not line.strip():
            continue
        try:
            row = _row(line, f"{path}: line {number}", decimal == ",")
        except UserError as error:
            if not lenient:
                raise
            row, ragged[len(rows)] = {}, str(error)
        rows.append(row)
        at.append(number)
    names = list(dict.fromkeys(name for row in rows for name in row))
    if not names:
        raise UserError(f"{path}: no data rows; {ALLOWED}")
    columns = {name: [row.get(name, "") for row in rows] for name in names}
    return Table(path, columns, 1, lenient=lenient, ragged=ragged, kept=[number - 1 for number in at])


def _row(line: str, where: str, commas: bool) -> dict[str, str]:
    try:
        content = json.loads(line)
    except ValueError as error:
        mend = "`bad_rows: drop` in a map leaves such lines out"
        raise UserError(f"{where}: not JSON ({error}); {ALLOWED}; {mend}") from None
    if not isinstance(content, dict):
        raise UserError(f"{where}: {type(content).__name__} in place of an object; {ALLOWED}")
    out: dict[str, str] = {}
    for name, value in _flat("", content, commas):
        if name in out:
            raise UserError(f"{where}: two values of {name!r}; allowed: one value per column")
        out[name] = value
    return out


def _flat(name: str, value: Any, commas: bool) -> Iterator[tuple[str, str]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flat(f"{name}:{key}" if name else key, inner, commas)
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from _flat(f"{name}[{i}]", inner, commas)
    elif commas and isinstance(value, str):
        yield name, value.replace(",", ".")
    else:
        yield name, "" if value is None else repr(value) if isinstance(value, float) else str(value)
