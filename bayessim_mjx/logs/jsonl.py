"""JSON lines: one object per line and sample; objects within it join their keys by `:`, lists number theirs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.table import Table
from bayessim_mjx.logs.texts import lines_of

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
        raise UserError(f"{where}: not JSON ({error}); {ALLOWED}") from None
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
