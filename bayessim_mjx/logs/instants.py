"""Dates and times of day (`2026-03-01T10:15:02.250Z`, `29.11.2026 10:15:02,25`) as seconds since the first of them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime, timedelta

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array

_DATE = re.compile(r"\d{4}-?\d{2}-?\d{2}[T ]")  # only with a time of day behind it
_CLOCK = (
    r"(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<second>\d{2})(?:[.,](?P<part>\d+))?)?\s*"
    r"(?P<half>[AaPp]\.?[Mm]\.?)?"
)
_DAY = r"(?P<a>\d{1,2})(?P<mark>[./-])(?P<b>\d{1,2})(?P=mark)(?P<year>\d{4})"
_YEAR = r"(?P<year>\d{4})(?P<mark>[./])(?P<b>\d{1,2})(?P=mark)(?P<a>\d{1,2})"
_MONTH = r"(?P<a>\d{1,2})[- ](?P<name>[A-Za-z]{3})[a-z]*[- ](?P<year>\d{4})"
_FORMS = {form: re.compile(rf"{form}[ T,]+{_CLOCK}") for form in (_DAY, _YEAR, _MONTH)}
_OF_DAY = re.compile(_CLOCK)
_MINUTES = re.compile(r"(?P<minute>\d{1,2}):(?P<second>\d{2})[.,](?P<part>\d+)")
_COLON = re.compile(r"[\d./-]*[T ]*\d{1,2}:\d{2}")  # some form of a time, known or not
_TWO = re.compile(r"\d{1,2}:\d{2}")
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_ORDERS = {"day first": ("a", "b"), "month first": ("b", "a")}
_DIGITS = re.compile(r"([.,]\d{6})\d+")  # strptime has microseconds at most
DAY, HOUR = 86400.0, 3600.0  # s; source: the definition of the units
ALLOWED = "allowed: seconds, or ISO 8601 with date and time as in 2026-03-01T10:15:02.250Z"
MEND = "; another form needs `format` in the map (time: {column: ..., format: '%d/%m/%Y %H:%M:%S.%f'})"

Where = Callable[[int], str]


def dated(fields: Iterable[str]) -> bool:
    """Whether the first field that is not blank is a date with a time, or a time of day, in a known form or another."""
    first = next((field.strip() for field in fields if field.strip()), "")
    whole = (*_FORMS.values(), _OF_DAY, _MINUTES)
    return (
        _DATE.match(first) is not None
        or _COLON.match(first) is not None
        or any(form.fullmatch(first) for form in whole)
    )


def seconds(fields: Sequence[str], where: Where, lenient: bool = False, form: str | None = None) -> Array:
    """Seconds [T] since the first field, to a microsecond. Blank fields are NaN.

    Args:
        where: row -> file and line, for messages.
        lenient: what is no time is NaN.
        form: of the dates, as in `strptime`; None: found, where one alone fits.

    Raises:
        UserError: no time, or some with a time zone and some without, naming the line; two forms that fit.
    """
    fields = [field.strip() for field in fields]
    if form is not None:
        times = [_stated(field, form, row, where, lenient) for row, field in enumerate(fields)]
        cycle = None if re.search(r"%[djc xDFs]", form) else DAY if re.search(r"%[HITX]", form) else HOUR
        return _since_first(times, fields, where, cycle)
    first = next((field for field in fields if field), "")
    if _TWO.fullmatch(first):
        both = "hours and minutes (`format: '%H:%M'`) or minutes and seconds (`format: '%M:%S'`)"
        raise UserError(f"{where(fields.index(first))}: {first!r} is {both}; state one in the map (time: format)")
    for shape in _FORMS.values():
        if shape.fullmatch(first):
            return _ordered(fields, shape, where, lenient)
    for shape, cycle in ((_OF_DAY, DAY), (_MINUTES, HOUR)):
        if shape.fullmatch(first):
            times = [_shaped(f, shape, ("a", "b"), row, where, lenient) for row, f in enumerate(fields)]
            return _since_first(times, fields, where, cycle)
    return _since_first([_instant(f, row, where, lenient) for row, f in enumerate(fields)], fields, where, None)


def _ordered(fields: Sequence[str], shape: re.Pattern[str], where: Where, lenient: bool) -> Array:
    """Dates in numbers: the order of day and month matters only where it changes the seconds between rows."""
    first = next(match for match in map(shape.fullmatch, fields) if match)
    groups = first.groupdict()
    orders = dict(_ORDERS)
    if groups.get("name") or groups.get("mark") == "." or shape is _FORMS[_YEAR]:
        orders = {"day first": ("a", "b")}
    found: dict[str, Array] = {}
    wrong: UserError | None = None
    for name, order in orders.items():
        try:
            times = [_shaped(f, shape, order, row, where, lenient) for row, f in enumerate(fields)]
            found[name] = _since_first(times, fields, where, None)
        except UserError as error:
            wrong = wrong or error
    if not found and wrong is not None:
        raise wrong
    every = list(found.values())
    if len(every) == 2 and not np.allclose(every[0], every[1], atol=1e-6, equal_nan=True):
        text = f"{where(0)}: {fields[0]!r} has the day first (`format: '%d{{m}}%m{{m}}%Y ...'`) or the month first"
        text = text.format(m=groups["mark"]) + f" (`format: '%m{groups['mark']}%d{groups['mark']}%Y ...'`)"
        raise UserError(f"{text}, and the rows' times differ by it; state one in the map (time: format)")
    return every[0]


def _shaped(
    field: str, shape: re.Pattern[str], order: tuple[str, str], row: int, where: Where, lenient: bool
) -> datetime | None:
    match = shape.fullmatch(field)
    try:
        if match:
            return _moment({k: v for k, v in match.groupdict().items() if v is not None}, order)
    except ValueError:
        pass
    if field and not lenient:
        raise UserError(f"{where(row)}: {field!r} is not a time like those before it; {ALLOWED}{MEND}")
    return None


def _moment(part: dict[str, str], order: tuple[str, str]) -> datetime:
    day, month = int(part.get(order[0], "1")), int(part.get(order[1], "1"))
    if "name" in part:
        day, month = int(part["a"]), _MONTHS.index(part["name"].lower()) + 1
    hour = int(part.get("hour", "0"))
    if "half" in part:
        if not 1 <= hour <= 12:
            raise ValueError("no hour of a half day")
        hour = hour % 12 + (12 if part["half"].lower().startswith("p") else 0)
    micro = int(part.get("part", "0").ljust(6, "0")[:6])
    return datetime(
        int(part.get("year", "1900")), month, day, hour, int(part["minute"]), int(part.get("second", "0")), micro
    )


def _stated(field: str, form: str, row: int, where: Where, lenient: bool) -> datetime | None:
    try:
        if field:
            return datetime.strptime(_DIGITS.sub(r"\1", field), form)
    except (ValueError, re.error):  # the second of a form that names a part twice
        if not lenient:
            raise UserError(f"{where(row)}: {field!r} is no time of the form {form!r} (time: format)") from None
    return None


def _since_first(times: Sequence[datetime | None], fields: Sequence[str], where: Where, cycle: float | None) -> Array:
    """Seconds since the first; a long step back is the end of a `cycle` [s], after which the clock begins anew."""
    first = next((t for t in times if t is not None), None)
    out = np.full(len(times), np.nan)
    ahead, last = 0.0, 0.0
    for row, time in enumerate(times):
        if time is None or first is None:
            continue
        if (time.tzinfo is None) != (first.tzinfo is None):
            zone = "without" if time.tzinfo is None else "with"
            raise UserError(
                f"{where(row)}: {fields[row]!r} {zone} a time zone, unlike the rows before; allowed: one kind"
            )
        now = (time - first) / timedelta(seconds=1)
        if cycle is not None and now + ahead < last - 0.9 * cycle:
            ahead += cycle
        out[row] = last = now + ahead
    return out


def _instant(field: str, row: int, where: Where, lenient: bool) -> datetime | None:
    try:
        if _DATE.match(field):
            return datetime.fromisoformat(field)
    except ValueError:
        pass
    if field and not lenient:
        raise UserError(f"{where(row)}: {field!r} is not a time; {ALLOWED}{MEND}")
    return None
