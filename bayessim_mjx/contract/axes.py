"""Orders, frames and turns of axes: findings of a group as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.contract.evidence import Finding
from bayessim_mjx.contract.manifest import Entry
from bayessim_mjx.contract.relate import Relation
from bayessim_mjx.contract.state import VECTORS

Array = NDArray[np.float64]


def continuous(quat: Array, lengths: Sequence[int]) -> Array:
    """Quaternions [N, 4] in any order without flips of the sign within each run."""
    out = []
    for run in np.split(quat, np.cumsum(lengths)[:-1]):
        dots = np.nansum(run[1:] * run[:-1], axis=1)
        out.append(run * np.cumprod(np.append(1.0, np.where(dots < 0, -1.0, 1.0)))[:, None])
    return np.concatenate(out)


def turned(relation: Relation) -> tuple[str, ...]:
    """Kinds of findings that a turn of axes explains."""
    return ("sign",) if relation.turn is not None else ()


def findings(entries: Sequence[Entry], seen: Array, relation: Relation) -> list[Finding]:
    """Frame, order and turn of a group."""
    names = tuple(entry.name for entry in entries)
    found = []
    if relation.frame:
        found.append(Finding("observation", "frame", names, relation.frame, ""))
    if relation.turn is not None:
        found.append(Finding("observation", "axes", names, _angle(relation.turn), ""))
        return found
    moved = [i for i, j in enumerate(relation.order) if i != j]
    if moved:
        shown = ", ".join(entries[relation.order[i]].name for i in moved)
        found.append(Finding("observation", "order", tuple(entries[i].name for i in moved), shown, ""))
    if entries[0].kind == "quaternion" and len(moved) == 4:
        kinds = "".join(entries[j].source[-1] for j in relation.order)
        own = "".join(entry.source[-1] for entry in entries)
        return [Finding("observation", "quaternion_order", names, kinds, own)]
    return found


def merged(entries: Sequence[Entry], seen: Array, found: list[Finding], relation: Relation) -> list[Finding]:
    """Put findings that one cause explains together: axes that are turned, quaternions, gravity that is constant."""
    names = tuple(entry.name for entry in entries)
    kind = entries[0].kind
    others = {f.entries[0] for f in found if f.kind == "other_source"}
    found = [f for f in found if not (f.kind == "unrelated" and set(f.entries) <= others)]
    if kind == "quaternion":
        return _quaternion(names, entries, seen, relation, found)
    if kind == "gravity" and len(entries) == 3 and any(f.kind == "frozen" for f in found):
        down = np.nanmedian(seen, axis=0)
        axis = [entry.source[-1] for entry in entries]
        if (
            abs(down[axis.index("z")]) > 0.9 * abs(entries[0].weight)
            and np.abs(np.delete(down, axis.index("z"))).max() < 0.1
        ):
            return [Finding("observation", "frame", names, "world", "")]
    if kind in VECTORS and len(entries) == 3 and relation.turn is None:
        return _signed(names, found, relation)
    return found


def _signed(names: tuple[str, ...], found: list[Finding], relation: Relation) -> list[Finding]:
    """One turn in place of orders and signs of three axes, where they are one."""
    flipped = {name for f in found if f.kind == "sign" for name in f.entries}
    if not flipped and relation.order == (0, 1, 2):
        return found
    matrix = np.zeros((3, 3))
    for i, j in enumerate(relation.order):
        matrix[i, j] = -1.0 if names[i] in flipped else 1.0
    if np.linalg.det(matrix) < 0:
        return found
    rest = [f for f in found if f.kind not in ("sign", "order")]
    return [*rest, Finding("observation", "axes", names, _angle(matrix), "")]


def _quaternion(
    names: tuple[str, ...], entries: Sequence[Entry], seen: Array, relation: Relation, found: list[Finding]
) -> list[Finding]:
    """q and -q are one attitude; with the other sign of w alone, the attitude is the inverse."""
    rows = np.isfinite(seen).all(1) & np.isfinite(relation.expected).all(1)
    weights = np.array([entry.weight for entry in entries])
    y, x = seen[rows] / weights, relation.expected[rows] / weights
    rest = [f for f in found if f.kind in ("order", "quaternion_order", "frozen", "unit", "scale")]
    w = [entries[relation.order[i]].source[-1] for i in range(len(entries))].index("w")
    vector = [i for i in range(len(entries)) if i != w]
    size = lambda a, b: float(np.mean(np.sum((a - b) ** 2, axis=1)))  # noqa: E731
    other = np.where(np.arange(len(entries)) == w, 1.0, -1.0)
    same = min(size(y, x), size(y, -x))
    inverse = min(size(y, other * x), size(y, -other * x))
    moves = float(np.mean(np.sum(x[:, vector] ** 2, axis=1)))
    if inverse < 0.25 * same and same > OFFSET**2 and moves > OFFSET**2:
        return [*rest, Finding("observation", "inverse", names)]
    return rest


def _angle(matrix: Array) -> str:
    """`90 degrees about z` of a rotation; the axis by its letter where it is one."""
    degrees = float(np.degrees(np.arccos(np.clip((np.trace(matrix) - 1) / 2, -1, 1))))
    values, vectors = np.linalg.eig(matrix)
    axis = np.real(vectors[:, np.argmin(np.abs(values - 1))])
    spin = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    if spin @ axis < 0 or (abs(spin @ axis) < 1e-6 and axis[np.argmax(np.abs(axis))] < 0):
        axis = -axis
    k = int(np.argmax(np.abs(axis)))
    text = (
        ("" if axis[k] > 0 else "-") + "xyz"[k]
        if abs(axis[k]) > 0.98
        else "(" + ", ".join(f"{v:.2f}" for v in axis) + ")"
    )
    return f"{5 * round(degrees / 5):g} degrees about {text}"


# From a line between an entry and its source to what is wrong: sign, unit, scale, offset; as few as explain it


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
