"""Units of logged channels: those that a map may state, and those that a column's name bears."""

from __future__ import annotations

import math
import re

TURN = 2.0 * math.pi
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "days": 86400.0}
ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0, "rev": TURN}
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
    "rad": "rad", "mrad": "mrad", "deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg",
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
_END = re.compile(r"(?:[\[(<{]\s*([^\])>}]+?)\s*[\])>}]|(?:^|[_\s.:-])([A-Za-zµμ°%]+(?:/s)?))\s*$")


def of_name(column: str) -> str | None:
    """Return the known unit at the end of a column's name (`angle [deg]`, `t_ms`), or None."""
    match = _END.search(column.strip())
    if match is None:
        return None
    if match[1] is None:
        return _SPELT.get(match[2].lower())
    text = re.sub(r"[\s*\u00b7\u22c5]|(?<=\w)[-_](?=\w)", "", match[1].lower())
    return _SPELT.get(text) or _IN_BRACKETS.get(text)


def foreign(column: str) -> str | None:
    """Return text in brackets at the end of a name that is neither a known unit nor an index, or None."""
    match = _END.search(column.strip())
    known = match is None or match[1] is None or of_name(column) is not None
    return None if known or match is None or re.fullmatch(r"[\d\s:,]+", match[1]) else match[0].strip()


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
    "foreign",
    "of_name",
    "scale_of",
]
