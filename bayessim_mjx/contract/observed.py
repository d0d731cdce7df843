"""Observations against the manifest, group by group: entries of one kind of source are compared together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.contract import axes, remainder
from bayessim_mjx.contract.evidence import Evidence, Finding, Result
from bayessim_mjx.contract.manifest import Entry
from bayessim_mjx.contract.relate import DELAYS, EXPLAINS, TOLD, Relation, relate, unexplained
from bayessim_mjx.contract.state import FRAMES, VECTORS
from bayessim_mjx.contract.words import judge, together

Array = NDArray[np.float64]
MOST = 0.8  # of the entries have to follow a rule that is meant for all; a rule of thumb
UNLIKE = ("beyond", "unrelated", "offset", "scale")  # findings of a sine that is that of another angle
SLOPE = 1.5  # factor between a measured velocity and the slope of the position over two steps; a rule of thumb


def groups(entries: Sequence[Entry]) -> list[list[int]]:
    """Group the entries that may be mistaken for each other: of one kind; of vectors, one joint."""
    found: dict[str, list[int]] = {}
    for i, entry in enumerate(entries):
        if not entry.terms:
            continue
        joint = entry.source.partition(":")[2].rpartition(".")[0]
        vector = entry.kind in (*VECTORS, "quaternion", "position")
        key = f"{entry.kind}:{joint}" if vector else entry.kind or entry.name
        key = "angle" if entry.kind in ("sin", "cos") else key
        found.setdefault(key, []).append(i)
    return list(found.values())


def compare(evidence: Evidence, result: Result) -> bool:
    """Compare all observations; whether the logged ones have been normalised before the policy."""
    entries, seen = evidence.manifest.observations, evidence.seen
    normalised = _normalised(evidence)
    if normalised:
        mean, std = evidence.manifest.mean, evidence.manifest.std
        assert mean is not None and std is not None
        seen = seen * std + mean
    clip = evidence.manifest.observation_clip
    for i, entry in enumerate(entries):
        if not entry.terms:
            result.untold[entry.name] = "unknown"
        elif not np.isfinite(seen[:, i]).any():
            result.untold[entry.name] = "not_logged"
    shared: list[tuple[list[int], Relation]] = []
    for members in groups(entries):
        own = [i for i in members if np.isfinite(seen[:, i]).any()]
        if own:
            relation = _group(evidence, result, [entries[i] for i in own], seen[:, own], clip)
            if relation is not None and relation.told.any():
                shared.append((own, relation))
    _of_all(result, entries, shared)
    return normalised


def _group(evidence: Evidence, result: Result, entries: list[Entry], seen: Array, clip: float) -> Relation | None:
    kind = entries[0].kind
    if kind == "quaternion":
        seen = axes.continuous(seen, [len(run.time) for run in evidence.runs])
    reference = evidence.reference(entries)
    delays = [d for d in DELAYS if d >= 0] if kind == "action" else DELAYS
    slopes = kind == "qvel" and not any(e.source in run.channels for run in evidence.runs for e in entries)
    if kind == "task" or slopes:
        delays = [0]
    # a log may be written before the clip or after it
    limited = np.where(np.abs(np.abs(seen) - clip) > 1e-6, seen, np.nan) if np.isfinite(clip) else seen
    relation = relate(limited, reference, FRAMES if kind in VECTORS else (), delays)
    if kind == "action":
        relation, reference = _fed_back(evidence, entries, limited, relation, delays, reference)
    if relation is None:
        result.untold |= {entry.name: "no_source" for entry in entries}
        return None
    plain = reference("", 0)
    assert plain is not None
    before = _apart(seen, plain, kind)
    found = axes.findings(entries, seen, relation)
    found += judge("observation", entries, limited, relation, axes.turned(relation), result)
    if (
        kind == "action"
        and any(f.kind in ("scale", "offset") for f in found)
        and _commands_back(evidence, seen, entries)
    ):
        found = [Finding("observation", "command_fed_back", tuple(e.name for e in entries))]
    found += [] if slopes else _beyond(entries, limited, relation, found)
    found = [f for f in found if not (slopes and _small(f))]
    found = _of_another_angle(evidence, entries, limited, relation, found, result)
    found += _others(evidence, entries, limited, relation, found)
    for f in axes.merged(entries, seen, found, relation):
        own = [i for i, entry in enumerate(entries) if entry.name in f.entries]
        now, mended = (float(np.mean(share[own])) for share in (before, relation.left))
        result.findings.append(replace(f, left=mended if f.left is None else f.left, before=now))
    bad = {name for f in found for name in f.entries}
    right = [e.name for e, told in zip(entries, relation.told, strict=True) if told and e.name not in bad]
    result.compared.setdefault("observation", []).extend(right)
    return relation


def _beyond(entries: Sequence[Entry], seen: Array, relation: Relation, found: Sequence[Finding]) -> list[Finding]:
    """Entries that nothing else is said of, and that go with their source but are not it."""
    bad = {name for f in found for name in f.entries}
    sizes = remainder.beyond(entries, seen, relation)
    return [Finding("observation", "beyond", (name,), size, 0.0) for name, size in sizes.items() if name not in bad]


def _of_another_angle(
    evidence: Evidence,
    entries: Sequence[Entry],
    seen: Array,
    relation: Relation,
    found: Sequence[Finding],
    result: Result,
) -> list[Finding]:
    """Say of sines and cosines that do not follow from their angle of which angle they are."""
    named = {}
    for i, entry in enumerate(entries):
        wrong = any(entry.name in f.entries and f.kind in UNLIKE for f in found)
        if wrong or result.untold.get(entry.name) == "noise":
            named[entry.name] = remainder.named(evidence, entry, seen[:, i], float(relation.left[i]))
    known = {name: answer for name, answer in named.items() if answer is not None}
    for name in known:
        result.untold.pop(name, None)
    kept = [replace(f, entries=tuple(name for name in f.entries if name not in known)) for f in found]
    own = together("observation", [(name, fault) for name, (fault, _) in known.items()])
    mended = [replace(f, left=float(np.mean([known[name][1] for name in f.entries]))) for f in own]
    return [f for f in kept if f.entries] + mended


def _small(finding: Finding) -> bool:
    """Whether a finding is no larger than the slope of a position differs from a measured velocity."""
    if finding.kind == "scale" and isinstance(finding.found, float) and isinstance(finding.expected, float):
        return 1 / SLOPE < finding.found / finding.expected < SLOPE
    return finding.kind in ("offset", "unrelated")


def _fed_back(evidence, entries, seen, relation, delays, reference):  # type: ignore[no-untyped-def]
    """Try actions within their limits, and the file's own answers, where what was logged explains less."""
    limit = evidence.manifest.action_limit
    for fed in ([np.clip(a, -limit, limit) for a in evidence.acted], evidence.answers):
        other = evidence.reference(entries, fed)
        second = relate(seen, other, (), delays)
        if second is not None and (relation is None or np.mean(second.left) < 0.5 * np.mean(relation.left)):
            relation, reference = second, other
    return relation, reference


def _commands_back(evidence: Evidence, seen: Array, entries: Sequence[Entry]) -> bool:
    """Whether the previous commands are fed back, in place of the actions."""
    if not evidence.has("ctrl"):
        return False
    expected = evidence.reference(entries, [run.ctrl for run in evidence.runs])("", 0)
    if expected is None:
        return False
    rows = np.isfinite(seen).all(1) & np.isfinite(expected).all(1)
    rest = np.mean((seen[rows] - expected[rows]) ** 2) if rows.any() else np.inf
    return bool(rest < EXPLAINS * np.mean(np.var(seen[rows], axis=0)))


def _apart(seen: Array, expected: Array, kind: str) -> Array:
    """[g] mean square of what was seen less what the manifest expects, as shares of the entries' variance."""
    rows = np.isfinite(seen).all(1) & np.isfinite(expected).all(1)
    y, x = seen[rows], expected[rows]
    if kind == "quaternion":  # q and -q are one attitude
        x = x * np.where((x * y).sum(1) < 0, -1.0, 1.0)[:, None]
    return ((y - x) ** 2).sum(0) / np.maximum(((y - y.mean(0)) ** 2).sum(0), 1e-9)


def _left(seen: Array, expected: Array) -> Array:
    rows = np.isfinite(seen).all(1) & np.isfinite(expected).all(1)
    return np.diag(unexplained(seen[rows], expected[rows])) if rows.sum() > 2 else np.ones(seen.shape[1])


def _others(
    evidence: Evidence, entries: Sequence[Entry], seen: Array, relation: Relation, known: Sequence[Finding]
) -> list[Finding]:
    """Entries that follow from none of their group: another source of the manifest that explains them."""
    named = {name for f in known if f.kind in ("unit", "offset", "other_source") for name in f.entries}
    names = {f.entries[0] for f in _unrelated(entries, seen, relation)} - named
    found = []
    for i, entry in enumerate(entries):
        if entry.name not in names:
            continue
        left = {}
        for other in evidence.manifest.observations:
            values = evidence.reference([other])("", 0) if other.terms and other.name != entry.name else None
            if values is not None:
                left[other.name] = float(_left(seen[:, [i]], values)[0])
        best = min(left, key=lambda name: left[name], default="")
        if best and left[best] < EXPLAINS:
            found.append(Finding("observation", "other_source", (entry.name,), best, entry.name))
    return found


def _unrelated(entries: Sequence[Entry], seen: Array, relation: Relation) -> list[Finding]:
    rows = np.isfinite(seen).all(1) & np.isfinite(relation.expected).all(1)
    return [
        Finding("observation", "unrelated", (entry.name,))
        for i, entry in enumerate(entries)
        if not relation.told[i] and np.std(seen[rows, i]) > 1e-9 and np.std(relation.expected[rows, i]) > 1e-9
    ]


def _of_all(result: Result, entries: Sequence[Entry], shared: Sequence[tuple[list[int], Relation]]) -> None:
    """Delays, held and filtered values: of the whole observation where all groups share them, else of a group."""
    for kind, of, default in (
        ("held", lambda r: float(r.held) if r.held > 1 else None, None),
        ("stale", lambda r: round(r.stale, 2) if r.stale and r.held == 1 else None, None),
        ("smooth", lambda r: round(r.smooth, 2) if r.smooth < 1 else None, None),
        ("delay", lambda r: float(r.delay) if r.delay else None, None),
    ):
        values = [
            (members, of(relation), relation) for members, relation in shared if entries[members[0]].kind != "task"
        ]
        given = [v for _, v, _ in values if v is not None]
        if not given:
            continue
        if len(given) == len(values) and max(given) - min(given) <= (0.1 if kind in ("stale", "smooth") else 0):
            result.findings.append(Finding("observation", kind, (), float(np.median(given)), default))
            continue
        for members, value, relation in values:
            if value is not None:
                names = tuple(entries[i].name for i in members)
                result.findings.append(Finding("observation", kind, names, value, default, float(relation.left.mean())))


def _normalised(evidence: Evidence) -> bool:
    """Whether the logged observations are those of the manifest after its normaliser."""
    manifest = evidence.manifest
    if manifest.mean is None or manifest.std is None:
        return False
    right, through = [], []
    for i, entry in enumerate(manifest.observations):
        expected = evidence.reference([entry])("", 0) if entry.terms else None
        if expected is None or _left(evidence.seen[:, [i]], expected)[0] > TOLD:
            continue
        found = axes.line(evidence.seen[:, i], expected[:, 0])
        start, sd = axes.starting(evidence.seen[:, i], expected[:, 0], 1 / manifest.std[i])
        near = abs(start + manifest.mean[i] / manifest.std[i]) <= axes.OFFSET / manifest.std[i] + 5 * sd
        right.append(axes.fits(found, 1.0))
        through.append(axes.fits(found, 1 / manifest.std[i]) and near)
    return len(through) > 1 and bool(np.mean(through) >= MOST > np.mean(right))
