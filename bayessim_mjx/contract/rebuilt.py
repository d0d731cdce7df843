"""Logs without observations: they are computed from the logged state, and mistakes are searched through the network.

Commands that follow from the state by the manifest are right. Else one mistake at a time is made in the observations;
it is named if the network then gives the logged actions. Noise that the log and the policy do not share hides all this.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from bayessim_mjx.contract.axes import UNITS
from bayessim_mjx.contract.evidence import Evidence, Finding, Result, shifted
from bayessim_mjx.contract.manifest import Entry
from bayessim_mjx.contract.observed import groups
from bayessim_mjx.contract.recording import Run
from bayessim_mjx.contract.relate import EXPLAINS, FLOOR
from bayessim_mjx.contract.state import FRAMES, VECTORS, State

Array = NDArray[np.float64]
EXPLAINED = 0.02  # share of the actions' variance that a mistake may leave; a rule of thumb
ROWS = 600  # rows of each run that are tried: enough to tell mistakes apart; a rule of thumb

# the sign of a source, before the default pose is subtracted or after it
SIGNS = (lambda x, e: 2 * e.offset - x, lambda x, e: -x)
Change = tuple[Finding, list[Array]]  # a mistake, and observations [K, S] of each run with it


def compare(evidence: Evidence, result: Result) -> bool:
    """Search what is wrong with observations that were not logged; whether the actions are explained."""
    runs = evidence.runs
    seen = [evidence.fed(run)[:ROWS] for run in runs]
    limit = evidence.manifest.action_limit
    base = _left(evidence, [observation[:ROWS] for observation in evidence.given], seen, limit)
    names = [entry.name for entry in evidence.manifest.observations]
    if base is None:
        result.notes.append("not_rebuilt")
        return False
    best: tuple[float, Finding] | None = None
    tried = base > FLOOR and not evidence.network.memory
    for finding, observations in _changes(evidence, runs) if tried else ():
        left = _left(evidence, [o[:ROWS] for o in observations], seen, limit)
        if left is not None and (best is None or left < best[0]):
            best = left, finding
    if tried and (best is None or best[0] >= min(EXPLAINED, EXPLAINS * base)):
        best = min(filter(None, (best, _offset(evidence, seen, limit))), key=lambda found: found[0], default=None)
    if best is not None and best[0] < min(EXPLAINED, EXPLAINS * base):
        finding = best[1]
        result.findings.append(
            Finding("observation", finding.kind, finding.entries, finding.found, finding.expected, best[0], base)
        )
        return True
    if base < EXPLAINED:
        result.compared.setdefault("observation", []).extend(names)
    result.notes.append("rebuilt" if base < EXPLAINED else "rebuilt_unlike")
    return base < EXPLAINED


def _left(evidence: Evidence, given: Sequence[Array], seen: Sequence[Array], limit: float) -> float | None:
    """Share of the actions' variance that the network leaves at these observations; None without a complete row."""
    answers = np.concatenate([evidence.network.run(observation) for observation in given])
    acted = np.clip(np.concatenate(seen), -limit, limit)
    rows = np.isfinite(acted).all(1) & np.isfinite(answers).all(1)
    if rows.sum() < 3:
        return None
    rest, total = acted[rows] - answers[rows], acted[rows] - acted[rows].mean(0)
    return float(np.sum(rest**2) / max(float(np.sum(total**2)), 1e-9))


def _offset(evidence: Evidence, seen: Sequence[Array], limit: float) -> tuple[float, Finding] | None:
    """Find the joint whose angle, off by a constant, explains most: (what it leaves, the finding).

    A turn around the circle in steps finds the valley, and a search by the golden section its ground.
    """
    angles: dict[str, list[str]] = {}
    for entry in evidence.manifest.observations:
        for source in entry.terms:
            kind, _, joint = source.partition(":")
            if kind in ("sin", "cos") or (kind == "qpos" and entry.unit == "rad"):
                angles.setdefault(joint, []).append(entry.name)
    best: tuple[float, Finding] | None = None
    steps = ("time", "observation", "action", "ctrl")
    runs = [replace(run, **{name: getattr(run, name)[:ROWS] for name in steps}) for run in evidence.runs]
    for joint, names in angles.items():

        def left(offset: float, joint: str = joint) -> float:
            given = [evidence.rebuild(_turned(run, joint, offset)) for run in runs]
            found = _left(evidence, given, seen, limit)
            return np.inf if found is None else found

        step = np.radians(15)  # narrower than the valleys of a sine
        start = min(np.arange(-np.pi, np.pi, step), key=left)
        found = minimize_scalar(left, bounds=(start - step, start + step), method="bounded", options={"xatol": 1e-4})
        if best is None or found.fun < best[0]:
            value = float(np.angle(np.exp(1j * found.x)))
            best = float(found.fun), Finding("observation", "offset", tuple(names), value, 0.0)
    return best


def _turned(run: Run, joint: str, offset: float) -> Run:
    """Return the run as if the joint stood `offset` rad further."""
    name = f"qpos:{joint}"
    own = {name: run.channels[name] + offset} if name in run.channels else {}
    return replace(run, channels={**run.channels, **own})


def _changes(evidence: Evidence, runs: Sequence[Run]) -> Iterator[Change]:
    """Every mistake that is tried."""
    entries, given = evidence.manifest.observations, evidence.given
    for members in groups(entries):
        own = [entries[i] for i in members]
        for i in members:
            for how in SIGNS:
                yield _by(given, "sign", [entries[i]], [i], how, -1.0)
        if own[0].kind == "action":
            yield _by(given, "frozen", own, members, lambda x, e: 0 * x, 0.0)
        yield from _of_group(given, own, members)
        for k, i in enumerate(members):
            for j in members[k + 1 :]:
                if own[0].kind != "task" and abs(entries[i].weight) == abs(entries[j].weight):
                    yield _swapped(given, entries, i, j)
                    if entries[i].offset != entries[j].offset:
                        yield _exchanged(given, entries, i, j)
        for frame in FRAMES if own[0].kind in VECTORS else ():
            changed = _other_frame(runs, given, own, members, frame)
            if changed is not None:
                yield Finding("observation", "frame", tuple(e.name for e in own), frame, ""), changed
        for steps in (1, 2):
            late = [_late(o, members, steps) for o in given]
            yield Finding("observation", "delay", tuple(e.name for e in own), float(steps)), late
    for steps in (1, 2):
        every = list(range(len(entries)))
        yield Finding("observation", "delay", (), float(steps)), [_late(o, every, steps) for o in given]


def _of_group(given: Sequence[Array], own: Sequence[Entry], members: Sequence[int]) -> Iterator[Change]:
    """Mistakes of all entries of a group: units, scales, default pose, sign."""
    first = own[0]
    if len(own) > 1:
        for how in SIGNS:
            yield _by(given, "sign", own, members, how, -1.0)
    for unit, factor in UNITS.get(first.unit, {}).items() if first.kind not in ("action", "sin", "cos") else ():
        yield _by(given, "unit", own, members, lambda x, e, f=factor: f * x, unit, first.unit)
    if abs(abs(first.weight) - 1) > 0.01 and first.source:
        yield _by(given, "scale_missing", own, members, lambda x, e: x / abs(e.weight), 1.0, abs(first.weight))
        yield _by(
            given, "scale_twice", own, members, lambda x, e: x * abs(e.weight), first.weight**2, abs(first.weight)
        )
    posed = [(e, i) for e, i in zip(own, members, strict=True) if e.offset]
    if posed:
        moved, where = [e for e, _ in posed], [i for _, i in posed]
        yield _by(given, "pose_missing", moved, where, lambda x, e: x - e.offset, 0.0)


def _by(given, kind, own, members, how, found, expected=None) -> Change:  # type: ignore[no-untyped-def]
    out = [observation.copy() for observation in given]
    for observation in out:
        for entry, i in zip(own, members, strict=True):
            observation[:, i] = how(observation[:, i], entry)
    return Finding("observation", kind, tuple(e.name for e in own), found, expected), out


def _swapped(given: Sequence[Array], entries: Sequence[Entry], i: int, j: int) -> Change:
    """Two sources in each other's place; weights and offsets stay."""
    out = [observation.copy() for observation in given]
    one, two = entries[i], entries[j]
    for new, old in zip(out, given, strict=True):
        new[:, i] = one.weight * (old[:, j] - two.offset) / two.weight + one.offset
        new[:, j] = two.weight * (old[:, i] - one.offset) / one.weight + two.offset
    return Finding("observation", "order", (one.name, two.name), f"{two.name}, {one.name}", ""), out


def _exchanged(given: Sequence[Array], entries: Sequence[Entry], i: int, j: int) -> Change:
    """Two entries in each other's place, with their weights and offsets."""
    out = [observation.copy() for observation in given]
    for new, old in zip(out, given, strict=True):
        new[:, [i, j]] = old[:, [j, i]]
    one, two = entries[i].name, entries[j].name
    return Finding("observation", "order", (one, two), f"{two}, {one}", ""), out


def _other_frame(
    runs: Sequence[Run], given: Sequence[Array], own: Sequence[Entry], members: Sequence[int], frame: str
) -> list[Array] | None:
    if frame == ("world" if own[0].kind.endswith("_world") else "body"):
        return None
    out = [observation.copy() for observation in given]
    for run, observation in zip(runs, out, strict=True):
        for entry, i in zip(own, members, strict=True):
            values = State(run, 0.0).entry(entry, frame)
            if values is None:
                return None
            observation[:, i] = values
    return out


def _late(observation: Array, members: Sequence[int], steps: int) -> Array:
    out = observation.copy()
    out[:, members] = shifted(observation[:, members], steps)
    return out
