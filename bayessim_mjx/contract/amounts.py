"""From a line between an entry and its source to what is wrong: sign, unit, scale, offset; as few as explain it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
NEAR = 0.06  # relative distance of a factor from a number that has a name; a rule of thumb
UNITS = {  # {unit of the source: {other unit: how many of it one is}}
    "rad": {"degrees": 57.29578, "turns": 0.1591549},
    "rad/s": {"degrees/s": 57.29578, "rpm": 9.549297, "turns/s": 0.1591549},
    "m": {"mm": 1000.0, "cm": 100.0},
    "m/s": {"mm/s": 1000.0, "cm/s": 100.0, "km/h": 3.6},
    "1": {"m/s^2": 9.80665},
}
OFFSETS = {"rad/s": 0.15, "m/s": 0.15}  # of a source: offsets that estimators of speed have; a rule of thumb
POSES = {"pose_missing": 0.0, "pose_twice": 2.0, "pose_added": -1.0}  # times the pose in the constant part
OFFSET = 0.03  # rad, m or 1: offsets of encoders and mounts that a policy does not feel; a rule of thumb


@dataclass(frozen=True)
class Line:
    """One entry against its source: its likeliest slope, and the lowest and highest that the noise allows."""

    slope: float
    low: float
    high: float


@dataclass(frozen=True)
class Fault:
    """What is wrong with one entry.

    Attributes:
        kind: sign, unit, scale, scale_missing, scale_twice, pose_missing, pose_twice, pose_added, offset. found,
            expected: numbers, or the other unit.
    """

    kind: str
    found: float | str
    expected: float | str


def line(seen: Array, source: Array) -> Line:
    """Fit entry [N] against source [N]; noise may be in both, so the slope lies between two regressions."""
    rows = np.isfinite(seen) & np.isfinite(source)
    y, x = seen[rows], source[rows]
    cov, var_x, var_y = float(np.cov(y, x)[0, 1]), float(np.var(x, ddof=1)), float(np.var(y, ddof=1))
    slope = float(np.sign(cov) * np.sqrt(var_y / var_x))
    ends = sorted((cov / var_x, var_y / cov if cov else slope))
    return Line(slope, ends[0], ends[1])


def fits(line: Line, slope: float) -> bool:
    """Whether the noise allows this slope."""
    low, high = line.low - NEAR * abs(line.low), line.high + NEAR * abs(line.high)
    return low <= slope <= high


def named(line: Line, weight: float, unit: str, others: Sequence[float] = ()) -> tuple[list[Fault], float]:
    """(faults of the slope, the slope that they mean): as it should be, else sign, unit or scale.

    Args:
        weight: slope of the manifest. unit: of the source. others: weights that count as right too.
    """
    for right in (weight, *others):
        if fits(line, right):
            return [], right
    size = abs(line.slope)
    sign = [Fault("sign", -1.0, 1.0)] if line.slope * weight < 0 else []
    toward = -1.0 if sign else 1.0
    for right in (weight, *others):
        if sign and fits(line, -right):
            return sign, -right
    choices: list[tuple[Fault, float]] = [
        (Fault("unit", other, unit), factor * weight) for other, factor in UNITS.get(unit, {}).items()
    ]
    if abs(abs(weight) - 1.0) > NEAR:
        choices += [(Fault("scale_missing", 1.0, abs(weight)), float(np.sign(weight)))]
        choices += [(Fault("scale_twice", weight**2, abs(weight)), weight * abs(weight))]
    allowed = [(fault, slope) for fault, slope in choices if fits(line, toward * slope)]
    if allowed:
        fault, slope = min(allowed, key=lambda c: abs(np.log(size / abs(c[1]))))
        return [*sign, fault], toward * slope
    return [*sign, Fault("scale", size, abs(weight))], line.slope


def starting(seen: Array, source: Array, slope: float) -> tuple[float, float]:
    """(constant part of an entry [N] at this slope, its standard error)."""
    rest = seen - slope * source
    rest = rest[np.isfinite(rest)]
    # neighbouring rows are alike: a tenth of them counts
    return float(np.median(rest)), float(rest.std() / np.sqrt(max(len(rest) / 10, 1)))


def start_fault(
    start: float, sd: float, slope: float, weight: float, offset: float, unit: str, others: Sequence[float] = ()
) -> list[Fault]:
    """Faults of the constant part: the default pose that is missing, counted twice or added; else an offset.

    Args:
        start, sd: constant part and its standard error. slope: as `named` says. weight, offset: of the manifest.
        unit: of the source. others: offsets that count as right too.
    """
    ratio = slope / weight
    limit = OFFSETS.get(unit, OFFSET) * abs(slope) + 5 * sd
    right = [factor * value for value in (offset, *others) for factor in (1.0, ratio)]
    if min(abs(start - value) for value in right) <= limit:
        return []
    pose = abs(offset) * max(1.0, abs(ratio)) > 2 * limit
    for kind in POSES:
        if pose and pose_fits(kind, start, sd, slope, weight, offset, unit):
            return [Fault(kind, start, offset)]
    return [Fault("offset", (start - offset * ratio) / slope, 0.0)]


def pose_fits(kind: str, start: float, sd: float, slope: float, weight: float, offset: float, unit: str) -> bool:
    """Whether a constant part is that of a default pose that is missing, counted twice or added; see `start_fault`."""
    limit = OFFSETS.get(unit, OFFSET) * abs(slope) + 5 * sd
    return min(abs(start - POSES[kind] * value) for value in (offset, slope / weight * offset)) <= limit
