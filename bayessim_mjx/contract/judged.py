"""Entries against their sources, one by one: findings of sign, unit, scale, default pose and offset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.contract import amounts
from bayessim_mjx.contract.evidence import Finding, Result
from bayessim_mjx.contract.manifest import Entry
from bayessim_mjx.contract.relate import Relation

Array = NDArray[np.float64]
SAME = 0.02  # by which two numbers of one finding may differ, relatively; a rule of thumb
CLEAR = 5.0  # times its noise: motion that has to show in what follows from it; a rule of thumb


def judge(
    part: str, entries: Sequence[Entry], seen: Array, relation: Relation, quiet: Sequence[str], result: Result
) -> list[Finding]:
    """Find wrong signs, units, scales and offsets; each finding has all entries that share it.

    Args:
        quiet: kinds that another finding of the group explains.
    """
    faults: list[tuple[str, amounts.Fault]] = []
    lines: dict[str, tuple[Entry, float, float, float]] = {}
    for i, entry in enumerate(entries):
        own, source = seen[:, i], relation.expected[:, i]
        rows = np.isfinite(own) & np.isfinite(source)
        if rows.sum() < 3:
            result.untold[entry.name] = "no_source"
            continue
        other = entries[relation.order[i]]
        base = (source - other.offset) / other.weight
        if relation.told[i] and relation.turn is None:
            slope_faults, slope = amounts.named(amounts.line(own, base), entry.weight, entry.unit, [other.weight])
            start, sd = amounts.starting(own, base, slope)
            offsets = [other.offset] if other is not entry else []
            lines[entry.name] = (entry, start, sd, slope)
            found = [
                *slope_faults,
                *amounts.start_fault(start, sd, slope, entry.weight, entry.offset, entry.unit, offsets),
            ]
        elif relation.turn is None:
            found = _still(entry, own[rows], base[rows], result)
        else:
            found = []
        faults += [(entry.name, fault) for fault in found if fault.kind not in quiet]
    return _together(part, _poses(faults, lines))


def _poses(
    faults: list[tuple[str, amounts.Fault]], lines: dict[str, tuple[Entry, float, float, float]]
) -> list[tuple[str, amounts.Fault]]:
    """Let a default pose that is wrong in some entries hold for others too, whose own pose is too small to show it."""
    kinds = {fault.kind for _, fault in faults if fault.kind.startswith("pose")}
    out = [(name, fault) for name, fault in faults if fault.kind != "offset" or not kinds]
    for name, (entry, start, sd, slope) in lines.items() if kinds else ():
        own = [fault for of, fault in faults if of == name]
        if any(fault.kind.startswith("pose") for fault in own):
            continue
        for kind in sorted(kinds):
            if entry.offset and amounts.pose_fits(kind, start, sd, slope, entry.weight, entry.offset, entry.unit):
                out.append((name, amounts.Fault(kind, start, entry.offset)))
                break
        else:
            out += [(name, fault) for fault in own if fault.kind == "offset"]
    return out


def _still(entry: Entry, own: Array, base: Array, result: Result) -> list[amounts.Fault]:
    """Faults of an entry whose source does not move, or that does not move with it."""
    expected = entry.weight * base + entry.offset
    limit = amounts.OFFSETS.get(entry.unit, amounts.OFFSET) * abs(entry.weight)
    moves = float(np.std(expected)) > limit
    if np.ptp(own) <= 1e-9 * max(1.0, abs(float(own[0]))) and moves:
        return [amounts.Fault("frozen", float(own[0]), "")]
    if moves and _clear(own) and _clear(expected):
        return [amounts.Fault("unrelated", "", "")]
    result.untold[entry.name] = "still" if not moves else "noise"
    if entry.kind == "action":
        return []
    noise = 5 * float(np.hypot(own.std(), expected.std()) / np.sqrt(max(len(own) / 10, 1)))
    limit += noise
    here, there = float(np.mean(own)), float(np.mean(expected))
    if abs(here - there) <= limit or moves:
        return []
    if abs(here + there) <= limit and abs(there) > 2 * limit:
        return [amounts.Fault("sign", -1.0, 1.0)]
    if abs(here - (there - entry.offset)) <= limit and abs(entry.offset) > 2 * limit:
        return [amounts.Fault("pose_missing", here, there)]
    for other, factor in amounts.UNITS.get(entry.unit, {}).items():
        if abs(there) > 2 * limit and abs(here / (factor * there) - 1) < amounts.NEAR:
            return [amounts.Fault("unit", other, entry.unit)]
    return [amounts.Fault("offset", (here - there) / entry.weight, 0.0)]


def _clear(values: Array) -> bool:
    """Whether the motion stands far out of the noise of the channel."""
    bend = values[2:] - 2 * values[1:-1] + values[:-2]
    noise = float(np.median(np.abs(bend))) / (0.6745 * np.sqrt(6.0))  # of white noise: sd of its second difference
    return float(np.std(values)) > CLEAR * noise


def _together(part: str, faults: Sequence[tuple[str, amounts.Fault]]) -> list[Finding]:
    """One finding for all entries with the same fault."""
    found: list[Finding] = []
    for name, fault in faults:
        for k, other in enumerate(found):
            if other.kind == fault.kind and _alike(other, fault):
                found[k] = replace(other, entries=(*other.entries, name))
                break
        else:
            found.append(Finding(part, fault.kind, (name,), fault.found, fault.expected))
    return found


def _alike(one: Finding, two: amounts.Fault) -> bool:
    if one.kind.startswith("pose") or one.kind == "frozen":
        return True
    if isinstance(one.found, float) and isinstance(two.found, float):
        ratio = [
            abs(float(a)) / max(abs(float(b)), 1e-9)
            for a, b in ((one.found, one.expected or 1.0), (two.found, two.expected or 1.0))
        ]
        return abs(ratio[0] - ratio[1]) <= SAME * max(ratio[0], 1e-9) * 2
    return one.found == two.found and one.expected == two.expected
