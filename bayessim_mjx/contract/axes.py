"""Orders, frames and turns of axes: findings of a group as a whole."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.contract import amounts
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
    if inverse < 0.25 * same and same > amounts.OFFSET**2 and moves > amounts.OFFSET**2:
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
