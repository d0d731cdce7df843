"""CSV files as tables, and how a file is written, guessed for a map: delimiter, header, lines of units, marks."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.table import Table
from bayessim_mjx.logs.texts import lines_of, marks_of, named_delimiter

ALLOWED = "allowed: CSV with a header line, or NPZ"
DELIMITERS = {";": "semicolons", "\t": "tabs", "|": "bars", " ": "blanks"}


@dataclass(frozen=True)
class Form:
    """How a CSV file is written.

    Attributes:
        delimiter: one character. header: whether there is a line of names.
        skip_rows: lines before the header, or before the first row where there is none; of all text files.
        skip_after_header: lines between the header and the first row.
        encoding: of all text files; decimal, thousands: marks in numbers (`texts.Marks`); None: found in the file.
        lenient: a row of the wrong length becomes one that holds nothing (`bad_rows`).
    """

    delimiter: str = ","
    header: bool = True
    skip_rows: int = 0
    skip_after_header: int = 0
    encoding: str | None = None
    decimal: str | None = None
    thousands: str | None = None
    lenient: bool = False


def read_csv(path: Path, form: Form = Form()) -> Table:  # noqa: B008  # immutable
    """Read a CSV file; columns of a file without a header line are called 0, 1, 2 ...

    A column without a name is called `unnamed <its number>`, or left out where it is blank throughout, as after a comma
    at the end of each line.

    Raises:
        UserError: no rows, a repeated column, a row of the wrong length, another delimiter, encoding or header.
    """
    text = lines_of(path, form.encoding, ALLOWED)[form.skip_rows :]
    own = named_delimiter(text[0]) if text and not form.skip_rows else None
    text, skipped = (text[1:], 1) if own else (text, form.skip_rows)
    delimiter = own or form.delimiter
    try:
        lines = list(csv.reader(text, delimiter=delimiter, skipinitialspace=not delimiter.isspace()))
    except csv.Error as error:
        raise UserError(f"{path}: not a text file ({error}); {ALLOWED}") from None
    if delimiter == " ":
        lines = _in_blanks(text, lines)
    while lines and not any(f.strip() for f in lines[-1]):
        lines.pop()
    body = lines[1 + form.skip_after_header :] if form.header else lines[form.skip_after_header :]
    kept = [row for row, fields in enumerate(body) if any(f.strip() for f in fields) or len(fields) == len(lines[0])]
    body = [body[row] for row in kept]  # lines that hold nothing at all are no rows
    if not body:
        raise UserError(f"{path}: no data rows; allowed: a header line and one row per sample")
    names = [f.strip().lstrip("#").strip() for f in lines[0]] if form.header else [str(i) for i in range(len(body[0]))]
    _other_delimiter(path, names, lines)
    if form.header:
        _no_header(path, lines[0], names)
    unnamed = [i for i, name in enumerate(names) if not name]
    names = [name or f"unnamed {i}" for i, name in enumerate(names)]
    repeated = sorted({n for n in names if names.count(n) > 1})
    if repeated:
        mend = "`header: false` and `skip_rows: 1` in a map number the columns from 0"
        raise UserError(f"{path}: column {repeated[0]!r} appears more than once in the header; {mend}")
    first = skipped + form.skip_after_header + (2 if form.header else 1)
    ragged = {row: f"{len(fields)} fields" for row, fields in enumerate(body) if len(fields) != len(names)}
    if ragged and not form.lenient:
        row = min(ragged)
        at = f"{path}: line {kept[row] + first} has {ragged[row]}; allowed: {len(names)} ({', '.join(names)})"
        raise UserError(at + _why_ragged(text, body, names, delimiter, ragged))
    if form.header and not form.lenient:
        _units_row(path, body, first + kept[0])
        _header_again(path, lines[0], body, [first + row for row in kept])
    body = [[""] * len(names) if row in ragged else fields for row, fields in enumerate(body)]
    marks = marks_of(body, form.decimal, form.thousands)
    columns = {name: [r[i] for r in body] for i, name in enumerate(names)}
    blank = {names[i] for i in unnamed if not any(r[i].strip() for r in body)}
    columns = {name: column for name, column in columns.items() if name not in blank}
    return Table(path, columns, first, lenient=form.lenient, ragged=ragged, marks=marks, kept=kept)


def _in_blanks(text: Sequence[str], lines: list[list[str]]) -> list[list[str]]:
    """Columns that are set out by several blanks, and a `#` that stands alone before the names."""
    if len({len(fields) for fields in lines if fields}) > 1:
        split = [line.split() for line in text]
        if split and split[0][:1] == ["#"]:
            split[0] = split[0][1:]
        if len({len(fields) for fields in split if fields}) == 1:
            return split
    return lines


def _other_delimiter(path: Path, names: Sequence[str], lines: Sequence[Sequence[str]]) -> None:
    table = next((i for i, fields in enumerate(lines) if len(fields) > 1), 0) if len(names) == 1 else 0
    if table and sum(len(fields) > 1 for fields in lines) > 0.5 * len(lines):
        raise UserError(
            f"{path}: the first line ({names[0]!r}) is one field, and line {table + 1} has {len(lines[table])}; "
            f"`skip_rows` in a map (here {table} more) passes over lines before the header"
        )
    other = next((d for d in DELIMITERS if d in names[0]), None) if len(names) == 1 else None
    if other is not None:
        mend = f"`delimiter: {other!r}` in a map (docs/logs.md)"
        raise UserError(
            f"{path}: one column {names[0]!r}: its fields are parted by {DELIMITERS[other]}; mend it with {mend}"
        )


def _no_header(path: Path, fields: Sequence[str], names: Sequence[str]) -> None:
    """Refuse a first line with numbers that have fractions as a header; whole numbers may be names."""
    if any(is_number(name) and not name.lstrip("+-").isdigit() and name.lower() != "nan" for name in names):
        text = f"{path}: the first line ({', '.join(fields[:4])} ...) holds numbers, not names"
        raise UserError(f"{text}; `header: false` in a map numbers the columns from 0, and keeps that line as a row")


def _units_row(path: Path, body: Sequence[Sequence[str]], first: int) -> None:
    """Refuse a line of words above lines of numbers: it is a line of units."""
    if len(body) < 3:
        return
    words = [not is_number(f) and bool(f.strip()) for f in body[0]]
    numbers = [[is_number(f) for f in fields] for fields in body[1:3]]
    both = [all(column) for column in zip(*numbers, strict=True)]
    if sum(both) >= 2 and all(word or not f.strip() for word, f in zip(words, body[0], strict=True)) and any(words):
        text = f"{path}: line {first} ({', '.join(body[0][:4])} ...) holds words above columns of numbers"
        raise UserError(f"{text}; `skip_after_header: 1` in a map passes over a line of units")


def _header_again(path: Path, header: Sequence[str], body: Sequence[Sequence[str]], lines: Sequence[int]) -> None:
    """Refuse a line of names among the rows: a recorder began anew in the same file."""
    again = next((line for line, fields in zip(lines, body, strict=True) if fields == header), None)
    if again is not None:
        text = f"{path}: line {again} has the names of the columns again; where the clock begins anew there, cut the"
        raise UserError(f"{text} file into two; where it goes on, `bad_rows: drop` in a map leaves the line out")


def _why_ragged(
    text: Sequence[str], body: Sequence[Sequence[str]], names: Sequence[str], delimiter: str, ragged: Mapping[int, str]
) -> str:
    """Name the likely cause of rows of other lengths, and the keys that mend it."""
    if delimiter == "," and len(ragged) == len(body) and all(len(fields) == 2 * len(names) for fields in body):
        return (
            "; each row has twice as many: commas separate the fields and are decimal marks too, and the two cannot be "
            "distinguished; write the file with `delimiter: ';'` and `decimal: ','`, or with decimal points"
        )
    for other, word in DELIMITERS.items():
        counts = {line.count(other) for line in text if line.strip()}
        if other not in (delimiter, " ") and len(counts) == 1 and counts != {0}:
            return f"; its fields may be parted by {word}: `delimiter: {other!r}` in a map"
    return "; `bad_rows: drop` in a map leaves such rows out, `skip_rows` passes over lines before the header"


def is_number(text: str) -> bool:
    """Whether a field holds a number, with a decimal point or comma."""
    try:
        float(text.strip().replace(",", "."))
    except ValueError:
        return False
    return True


HEAD = 200  # lines that are looked at; rule of thumb, not measured
MOST = 0.9  # share of the lines that have to have the same number of fields; rule of thumb, not measured


def form_of(path: Path) -> dict[str, Any]:
    """Keys of a map, with what differs from a plain CSV file: delimiter, skip_rows, header, skip_after_header.

    Raises:
        UserError: bytes of an unknown encoding.
    """
    lines = lines_of(path, None, ALLOWED)[:HEAD]
    if not lines or named_delimiter(lines[0]):
        return {}
    marks = {mark: _table(lines, mark) for mark in (",", *DELIMITERS)}
    best = max(marks, key=lambda mark: _score(marks[mark]))
    rows = marks[best]
    width = _width(rows)
    if width < 2:
        return {}
    first = next(i for i, row in enumerate(rows) if len(row) == width)
    out: dict[str, Any] = {} if best == "," else {"delimiter": best}
    if first:
        out["skip_rows"] = first
    if any(is_number(f) and not f.strip().lstrip("+-").isdigit() for f in rows[first]):
        out["header"] = False
    elif len(rows) > first + 2 and not any(map(is_number, rows[first + 1])) and any(map(is_number, rows[first + 2])):
        out["skip_after_header"] = 1
    return out


def _table(lines: Sequence[str], mark: str) -> list[list[str]]:
    if mark == " ":  # in runs, and `# ` may stand before the names
        return [[part for i, part in enumerate(line.split()) if i or part != "#"] for line in lines]
    try:
        return list(csv.reader(lines, delimiter=mark))
    except csv.Error:
        return []


def _width(rows: Sequence[Sequence[str]]) -> int:
    """Fields of the most common kind of row."""
    counts = [len(row) for row in rows if row]
    return max(set(counts), key=counts.count) if counts else 0


def _score(rows: Sequence[Sequence[str]]) -> float:
    """Share of the fields that are numbers in rows of the same length; 0 where rows differ."""
    width = _width(rows)
    same = [row for row in rows if len(row) == width]
    if width < 2 or len(same) < MOST * len([row for row in rows if row]) - 12:
        return 0.0
    fields = [field for row in same for field in row]
    return sum(map(is_number, fields)) / len(fields) + 1e-3 * min(width, 50)


__all__ = ["DELIMITERS", "Form", "form_of", "is_number", "read_csv"]
