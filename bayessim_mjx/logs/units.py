"""Units of logged channels: those that a map may state, and those that a column's name bears."""

from __future__ import annotations

import math
import re

TURN = 2.0 * math.pi
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "days": 86400.0}
ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0, "mdeg": math.pi / 180e3, "rev": TURN}
LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
TURNING = {"rad/s": 1.0, "deg/s": math.pi / 180.0, "rev/s": TURN, "rpm": TURN / 60.0}
MOVING = {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3}
# the pound-force and the kilogram-force are exact: NIST SP 811 (2008), appendix B
FORCES = {
    "N m": 1.0, "mN m": 1e-3, "N cm": 1e-2, "kgf cm": 0.0980665, "ozf in": 0.007061551833, "lbf in": 0.1129848290276,
    "lbf ft": 1.3558179483314, "N": 1.0, "V": 1.0, "mV": 1e-3,
}  # fmt: skip
CURRENTS = {"A": 1.0, "mA": 1e-3}
COUNTS, PERCENT, PLAIN = "counts", "percent", "number"
SCALES = {**TIMES, **ANGLES, **LENGTHS, **TURNING, **MOVING, **FORCES, **CURRENTS}
POSITIONS = (*ANGLES, *LENGTHS, COUNTS, PERCENT)
OF_STREAM = {
    "time": tuple(TIMES),
    "qpos": POSITIONS,
    "qvel": (*TURNING, *MOVING, COUNTS),
    "ctrl": tuple(u for u in (*SCALES, COUNTS, PERCENT) if u not in TIMES),
    "streams": tuple(u for u in (*SCALES, COUNTS, PERCENT) if u not in TIMES),
}
# what stands at the end of a column's name, in brackets or behind a mark
_SPELT = {
    "s": "s", "sec": "s", "secs": "s", "seconds": "s", "ms": "ms", "msec": "ms", "millis": "ms", "milliseconds": "ms",
    "us": "us", "µs": "us", "μs": "us", "usec": "us", "micros": "us", "microseconds": "us", "ns": "ns", "nsec": "ns",
    "nanos": "ns", "nanoseconds": "ns", "days": "days",
    "rad": "rad", "mrad": "mrad", "deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg", "mdeg": "mdeg",
    "rev": "rev", "turns": "rev", "mm": "mm", "cm": "cm", "%": PERCENT, "pct": PERCENT, "percent": PERCENT,
    "counts": COUNTS, "ticks": COUNTS, "steps": COUNTS, "raw": COUNTS,
    "rad/s": "rad/s", "deg/s": "deg/s", "°/s": "deg/s", "dps": "deg/s", "rpm": "rpm", "rev/s": "rev/s", "mm/s": "mm/s",
    "ma": "mA", "mnm": "mN m", "ncm": "N cm", "mv": "mV", "kgcm": "kgf cm", "kgfcm": "kgf cm", "ozin": "ozf in",
    "inlb": "lbf in", "lbin": "lbf in", "ftlb": "lbf ft", "lbft": "lbf ft",
}  # fmt: skip
# only in brackets: as the last part of a name these are words of their own
_IN_BRACKETS = {
    "a": "A", "amp": "A", "amps": "A", "n": "N", "v": "V", "volt": "V", "volts": "V", "m": "m", "nm": "N m",
    "n.m": "N m",
    "radian": "rad", "radians": "rad", "m/s": "m/s", "min": "min", "h": "h", "rev": "rev", "turn": "rev",
    "count": COUNTS, "-": PLAIN,
}  # fmt: skip
# mean nothing else, wherever they stand in a name
_CERTAIN = frozenset((
    "deg", "degree", "degrees", "mdeg", "mrad", "rpm", "dps", "pct", "percent", "msec", "usec", "nsec", "millis",
    "micros", "nanos", "milliseconds", "microseconds", "nanoseconds",
))  # fmt: skip
_BRACKET = re.compile(r"[\[(<{]\s*([^\])>}]+?)\s*[\])>}]")
_LAST = re.compile(r"(?:^|[_\s.:-])([A-Za-zµμ°%]+(?:/s)?)\s*$")
_PART = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")


def words_of(name: str) -> list[str]:
    """Words of a name, parted by marks or by capital letters, in small letters: `shoulderPos_2` -> shoulder, pos, 2."""
    return [word.lower() for word in _PART.findall(name)]


def bare(name: str) -> str:
    """Return a name without its unit: brackets, and words that are one."""
    name = _BRACKET.sub(" ", name)
    last = _LAST.search(name)
    if last is not None and last[1].lower() in _SPELT and name[: last.start()].strip():
        return name[: last.start()]
    found = list(_PART.finditer(name))
    if len(found) > 1 and len(found[-1][0]) > 1 and found[-1][0].lower() in _SPELT:
        return name[: found[-1].start()]
    return "_".join(m[0] for m in found if m[0].lower() not in _CERTAIN) or name


def of_name(column: str) -> str | None:
    """Return the known unit that a column's name bears (`angle [deg]`, `t_ms`, `shoulderPosDeg`), or None.

    It stands in brackets, as the last word, or, of words that mean nothing else, anywhere. Beside another unit `raw`
    and `counts` are none.
    """
    inside = [_known(match[1]) for match in _BRACKET.finditer(column)]
    found = [unit for unit in inside if unit is not None]
    if found:
        return next((unit for unit in found if unit != COUNTS), COUNTS)
    name = _BRACKET.sub(" ", column).strip()
    last = _LAST.search(name)
    if last is not None and last[1].lower() in _SPELT:
        return _SPELT[last[1].lower()]
    words = words_of(name)
    if len(words) > 1 and len(words[-1]) > 1 and words[-1] in _SPELT:
        return _SPELT[words[-1]]
    return next((_SPELT[word] for word in words if word in _CERTAIN), None)


def _known(text: str) -> str | None:
    text = re.sub(r"[\s*\u00b7\u22c5]|(?<=\w)[-_](?=\w)", "", text.lower())
    return _SPELT.get(text) or _IN_BRACKETS.get(text)


def foreign(column: str) -> str | None:
    """Return text in brackets in a name that is neither a known unit nor an index, where no unit is known, or None."""
    if of_name(column) is not None:
        return None
    return next((m[0].strip() for m in _BRACKET.finditer(column) if not re.fullmatch(r"[\d\s:,]+", m[1])), None)


def scale_of(unit: str, resolution: float | None, torque_constant: float | None) -> float:
    """Return the model's unit per unit of the file.

    Args:
        unit: other than percent.
        resolution: counts per turn; torque_constant: N m/A.
    """
    if unit == COUNTS:
        return TURN / float(resolution or 1.0)
    return SCALES[unit] * (1.0 if torque_constant is None or unit not in CURRENTS else torque_constant)


__all__ = [
    "ANGLES",
    "COUNTS",
    "CURRENTS",
    "LENGTHS",
    "OF_STREAM",
    "PERCENT",
    "PLAIN",
    "TIMES",
    "bare",
    "foreign",
    "of_name",
    "scale_of",
    "words_of",
]
