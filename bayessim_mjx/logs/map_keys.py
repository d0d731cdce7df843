"""The keys of a map, and what each may hold."""

from __future__ import annotations

import codecs
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import units
from bayessim_mjx.logs.log import HOLDS, suggest

_MARKS = (".", ",", "'", " ")
_KINDS: dict[str, tuple[type | tuple[type, ...], str]] = {
    "files": (str, "a file pattern inside the folder such as '*.csv'"),
    "delimiter": (str, "one character"),
    "encoding": (str, "the name of an encoding, such as utf-8, utf-16, latin-1 or cp1252"),
    "decimal": (str, "'.' or ','"),
    "thousands": (str, "the mark between groups of three digits: '.', ',', \"'\" or ' '"),
    "header": (bool, "true or false"),
    "skip_after_header": (int, "a number of lines from 0, such as 1 for a line of units"),
    "column": ((str, int), "a header name or an index from 0"),
    "date": ((str, int), "a header name or an index from 0, of the column with the dates"),
    "nanoseconds": ((str, int), "a header name or an index from 0, of the column with the nanoseconds"),
    "format": (str, "a form of dates as in Python's strptime, such as '%d/%m/%Y %H:%M:%S.%f'"),
    "unit": (str, "a unit"),
    "suffix": (str, "the text behind each number, such as ' rad'"),
    "range": (list, "two different numbers, the channel at 0 % and at 100 %, such as [0.0, 0.04]"),
    "resolution": ((int, float), "counts per turn, above 0"),
    "missing": ((int, float), "the raw number that stands for a value that is missing"),
    "zero": ((int, float), "a number, the raw value where the channel is 0"),
    "torque_constant": ((int, float), "N m per A, not 0"),
    "signed": (int, "a number of bits from 2 to 64, such as 16"),
    "sign_magnitude": (int, "the bit of the sign, from 1 to 62, such as 10"),
    "skip_rows": (int, "a number of lines from 0"),
    "bad_rows": (str, "error, drop (leave such rows out) or nan (their other fields are missing)"),
    "hold": (str, "previous (held until the next row) or linear"),
    "rate": ((int, float), "rows per second, above 0"),
    "sign": (int, "1 or -1"),
}
_CHOICES = {"bad_rows": ("error", "drop", "nan"), "hold": HOLDS, "decimal": (".", ","), "thousands": _MARKS}
_BELOW = {"signed": (2, 64), "sign_magnitude": (1, 62), "skip_rows": (0, 10**9), "skip_after_header": (0, 10**9)}


def plain(path: str, key: str, value: Any) -> Any:
    """Return the value, if it has the kind that its key needs (a number, where nothing else is said).

    Raises:
        UserError: another kind, or a value that is not among those allowed; names the map, the key and what is allowed.
    """
    last = key.rsplit(".", 1)[-1]
    kind, allowed = _KINDS.get(last, ((int, float), "a number"))
    good = isinstance(value, kind) and (kind is bool or not isinstance(value, bool))
    if not (good and _fits(last, value)):
        raise UserError(f"{path}: {key} = {value!r}; allowed: {allowed}")
    return value


def _fits(key: str, value: Any) -> bool:
    if key in _CHOICES:
        return value in _CHOICES[key]
    if key in _BELOW:
        return bool(_BELOW[key][0] <= value <= _BELOW[key][1])
    if key in ("rate", "resolution"):
        return bool(1e-300 < value < 1e300)
    if key in ("value", "offset", "wrap", "scale", "zero", "missing", "torque_constant"):
        positive = key != "wrap" or value > 0
        return abs(value) < 1e300 and positive and (key not in ("scale", "torque_constant") or value != 0)
    if key == "files":
        return bool(value.strip()) and not Path(value).is_absolute() and ".." not in Path(value).parts
    if key == "range":
        numbers = [v for v in value if isinstance(v, int | float) and not isinstance(v, bool) and abs(v) < 1e300]
        return len(numbers) == len(value) == 2 and numbers[0] != numbers[1]
    return _fits_text(key, value)


def _fits_text(key: str, value: Any) -> bool:
    if key == "delimiter":
        return len(value) == 1
    if key == "sign":
        return value in (1, -1)
    if key == "format":
        return "%" in value
    if key == "encoding":
        try:
            return bool(codecs.lookup(value)._is_text_encoding)
        except (LookupError, ValueError):
            return False
    return True


def source_keys(path: str, key: str, block: Mapping[str, Any], allowed: Iterable[str]) -> None:
    """Check that the keys of one channel are known and go together.

    Raises:
        UserError: an unknown key, neither a column nor a value, a unit without what it needs, two keys for one thing.
    """
    for entry in block:
        if entry not in allowed:
            raise UserError(f"{path}: unknown key {key}.{entry}; {suggest(str(entry), allowed)}")
    if ("column" in block) == ("value" in block):
        raise UserError(f"{path}: {key} needs either column or value; it has {', '.join(block) or 'nothing'}")
    for pair in (("signed", "sign_magnitude"), ("unit", "scale"), ("format", "unit"), ("format", "nanoseconds")):
        if all(one in block for one in pair):
            raise UserError(f"{path}: {key} has {pair[0]} and {pair[1]}; allowed: one of them")
    if "unit" in block:
        _unit(path, key, block)
    for entry, needed in (("resolution", (units.COUNTS,)), ("range", (units.PERCENT,)),
                          ("torque_constant", tuple(units.CURRENTS))):  # fmt: skip
        if entry in block and block.get("unit") not in needed:
            raise UserError(f"{path}: {key}.{entry} without `unit: {needed[-1]}`; allowed: both, or neither")


def _unit(path: str, key: str, block: Mapping[str, Any]) -> None:
    stream = key.partition(".")[0]
    allowed = units.OF_STREAM[stream]
    unit = block["unit"]
    if unit not in allowed:
        raise UserError(f"{path}: {key}.unit = {unit!r}; {suggest(str(unit), allowed)}")
    needs = {units.COUNTS: "resolution", units.PERCENT: "range"}
    if stream == "ctrl":  # elsewhere an ampere may stay one
        needs |= dict.fromkeys(units.CURRENTS, "torque_constant")
    if unit in needs and needs[unit] not in block:
        entry = needs[unit]
        more = " (1 where the model's actuator takes amperes)" if entry == "torque_constant" else ""
        raise UserError(f"{path}: {key}.unit = {unit!r} without {entry}; allowed: {entry}: {_KINDS[entry][1]}{more}")


__all__ = ["plain", "source_keys"]
