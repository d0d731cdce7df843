"""Times of day in ISO 8601 (`2026-03-01T10:15:02.250Z`) as seconds since the first of them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime, timedelta

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array

_DATE = re.compile(r"\d{4}-?\d{2}-?\d{2}[T ]")  # only with a time of day behind it
ALLOWED = "allowed: seconds, or ISO 8601 with date and time as in 2026-03-01T10:15:02.250Z"


def dated(fields: Iterable[str]) -> bool:
    """Whether the first field that is not blank begins with a date."""
    first = next((field.strip() for field in fields if field.strip()), "")
    return _DATE.match(first) is not None


def seconds(fields: Sequence[str], where: Callable[[int], str], lenient: bool = False) -> Array:
    """Seconds [T] since the first field, to a microsecond. Blank fields are NaN.

    Args:
        where: row -> file and line, for messages.
        lenient: what is no time is NaN.

    Raises:
        UserError: no time, or some with a time zone and some without, naming the line.
    """
    times = [_instant(field.strip(), row, where, lenient) for row, field in enumerate(fields)]
    first = next((t for t in times if t is not None), None)
    out = np.full(len(times), np.nan)
    for row, time in enumerate(times):
        if time is None or first is None:
            continue
        if (time.tzinfo is None) != (first.tzinfo is None):
            zone = "without" if time.tzinfo is None else "with"
            raise UserError(
                f"{where(row)}: {fields[row]!r} {zone} a time zone, unlike the rows before; allowed: one kind"
            )
        out[row] = (time - first) / timedelta(seconds=1)
    return out


def _instant(field: str, row: int, where: Callable[[int], str], lenient: bool) -> datetime | None:
    try:
        if _DATE.match(field):
            return datetime.fromisoformat(field)
    except ValueError:
        pass
    if field and not lenient:
        raise UserError(f"{where(row)}: {field!r} is not a time; {ALLOWED}")
    return None
