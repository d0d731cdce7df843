"""What an entry of the observation has beside its stated source: more than scale, offset, timing and noise explain."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.contract.axes import NEAR, OFFSET, OFFSETS, Fault
from bayessim_mjx.contract.evidence import Evidence, shifted
from bayessim_mjx.contract.manifest import Entry
from bayessim_mjx.contract.relate import CLEAR, EXPLAINS, FLAT, Relation, unexplained
from bayessim_mjx.contract.state import VECTORS, State

Array = NDArray[np.float64]
NOISE = 3.0  # times its own white noise: below it sensors whose noise lasts a few rows; a rule of thumb
SHARE = 0.05  # of the entry's variance at least, and of rows that stay where values are quantised; a rule of thumb
EXACT = ("action", "task", "quaternion")  # kinds that other rules compare
SUMS = (1.0, -1.0)


def beyond(entries: Sequence[Entry], seen: Array, relation: Relation) -> dict[str, float]:
    """{entry: rms of the remainder} of those that do not follow from their source although they go with it.

    A value is right within the span of its source from one step before to one step after, with a scale of 1 +- NEAR, a
    constant, a step of quantised values, and axes that are turned by less than FLAT.
    """
    kind = entries[0].kind
    if kind in EXACT or relation.turn is not None or relation.held > 1 or relation.stale or relation.smooth < 1:
        return {}
    x = relation.expected
    near = np.stack([shifted(x, steps) for steps in (-1, 0, 1)])
    low, high = np.fmin.reduce(near), np.fmax.reduce(near)
    start = np.nanmedian(seen - x, axis=0)
    apart = np.maximum(0.0, np.maximum(low - (seen - start), (seen - start) - high))
    away = np.abs(x - np.nanmean(x, axis=0))
    leak = np.radians(FLAT) * (away.sum(1, keepdims=True) - away) if kind in VECTORS else 0.0
    rest = np.maximum(0.0, apart - NEAR * away - leak - grain(x))
    found = {}
    for i, entry in enumerate(entries):
        if not relation.told[i]:
            continue
        size = float(np.sqrt(np.nanmean(rest[:, i] ** 2)))
        least = OFFSETS.get(entry.unit, OFFSET) * abs(entry.weight)  # what a policy does not feel
        clear = size > NOISE * white(seen[:, i] - x[:, i]) and size**2 > SHARE * float(np.nanvar(seen[:, i]))
        if clear and size > least:
            found[entry.name] = size
    return found


def grain(values: Array) -> Array:
    """[n] steps of quantised channels [N, n]: the usual change of those that often stay at one value; else 0."""
    sizes = np.abs(np.diff(values, axis=0))
    moved = np.where(sizes > 0, sizes, np.nan)
    often = np.nanmean(sizes == 0, axis=0) > SHARE
    return np.array(
        [np.nanmedian(m) if stays and np.isfinite(m).any() else 0.0 for m, stays in zip(moved.T, often, strict=True)]
    )


def white(values: Array) -> float:
    """Return the white noise (sd) of a channel by its second differences: too large where it moves fast."""
    bend = values[2:] - 2 * values[1:-1] + values[:-2]
    return float(np.sqrt(np.nanmean(bend**2) / 6.0)) if np.isfinite(bend).any() else np.inf


def contradicts(seen: Array, expected: Array) -> bool:
    """Whether an entry is not its source plus noise, however large: then their line would have the slope 1.

    Args:
        seen: [N]. expected: [N] of a source that has no noise; with noise in it the slope is lower.
    """
    x, y = expected - expected.mean(), seen - seen.mean()
    slope = float(x @ y / (x @ x))
    rest = y - slope * x
    alike = max(0.0, _following(x) * _following(rest))
    count = len(x) * (1 - alike) / (1 + alike)  # of rows that do not repeat each other (Bartlett 1946, eq. 1)
    return abs(slope - 1.0) > CLEAR * float(np.std(rest) / (np.std(x) * np.sqrt(max(count, 1.0)))) + NEAR


def slow(values: Array) -> bool:
    """Whether a channel moves little in one step: else a part of a step is enough to hide a relation with it."""
    return float(np.std(values)) >= NOISE * float(np.std(np.diff(values)))


def _following(values: Array) -> float:
    """Correlation of a row with the next."""
    return float(values[1:] @ values[:-1] / max(float(values @ values), 1e-12))


def named(evidence: Evidence, entry: Entry, seen: Array, left: float) -> tuple[Fault, float] | None:
    """(fault, share left) of an entry that is the sine or cosine of another angle: of degrees, shifted, or of a sum.

    Args:
        seen: [N]. left: share of its variance that its own source leaves.
    """
    if entry.kind not in ("sin", "cos"):
        return None
    own = entry.source.partition(":")[2]
    angles = _angles(evidence)
    if own not in angles:
        return None
    wave = np.sin if entry.kind == "sin" else np.cos
    rows = np.isfinite(seen) & np.isfinite(angles[own])
    shift = _shift(seen[rows], angles[own][rows], wave)
    tried: dict[tuple[str, float | str], Array] = {
        ("unit", "degrees"): wave(np.degrees(angles[own])),
        ("offset", shift): wave(angles[own] + shift),
    }
    for other, angle in angles.items():
        for sign in SUMS if other != own else ():
            shown = f"{entry.kind} of {own} {'+' if sign > 0 else '-'} {other}"
            tried["other_source", shown] = wave(angles[own] + sign * angle)
    shares = {key: float(unexplained(seen[rows, None], x[rows, None])[0, 0]) for key, x in tried.items()}
    best = min(shares, key=lambda key: shares[key])
    if shares[best] >= EXPLAINS * left:
        return None
    right: dict[str, float | str] = {"unit": "rad", "offset": 0.0}
    return Fault(*best, right.get(best[0], entry.name)), shares[best]


def _shift(seen: Array, angle: Array, wave: Callable[[Array], Array]) -> float:
    """Angle by which the wave is shifted that explains an entry best, rad."""
    quarter = np.pi / 2
    found, *_ = np.linalg.lstsq(np.stack([wave(angle), wave(angle + quarter)], 1), seen, rcond=None)
    return float(np.arctan2(found[1], found[0]))


def _angles(evidence: Evidence) -> Mapping[str, Array]:
    """{joint: [N] rad} of the joints with one number whose positions every run has."""
    names = {name for run in evidence.runs for name in run.channels if name.startswith("qpos:") and "[" not in name}
    found = {}
    for joint in (name[5:] for name in sorted(names)):
        parts = [State(run, 0.0).channel(f"qpos:{joint}") for run in evidence.runs]
        known = [part for part in parts if part is not None]
        if len(known) == len(parts):
            found[joint] = np.concatenate(known)
    return found
