"""How a text file is written, guessed from its lines, for a map that can be edited."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bayessim_mjx.logs.csv_files import ALLOWED, DELIMITERS, is_number
from bayessim_mjx.logs.texts import lines_of, named_delimiter

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
    if all(map(is_number, rows[first])) and not all(f.strip().lstrip("+-").isdigit() for f in rows[first]):
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


__all__ = ["form_of"]
