"""Actions against the answers of the file, commands against actions, steps against the control period."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.contract.axes import NEAR
from bayessim_mjx.contract.axes import findings as of_order
from bayessim_mjx.contract.evidence import Evidence, Finding, Result, shifted
from bayessim_mjx.contract.manifest import Entry
from bayessim_mjx.contract.relate import EXPLAINS, Relation, relate
from bayessim_mjx.contract.words import judge

Array = NDArray[np.float64]
DIGITS = 1e-3  # of an action: three digits of a log; a rule of thumb
EQUAL = 2e-3  # share of variance: texts of four digits and float32 leave less; a rule of thumb
RATE = 0.05  # relative distance of a rate that counts: clocks of small computers are 1 % off; a rule of thumb
GAP, GAPS = 1.5, 0.05  # periods of a late step, share of late steps that counts; rules of thumb
SATURATED = 0.02  # share of rows at one limit that makes it a limit; a rule of thumb
EXACT = 1e-4  # of an action: largest difference of another machine's arithmetic, float32
SPREAD = 0.02  # of an action: smallest standard deviation of noise that counts; a rule of thumb


def within_digits(seen: Array, expected: Array) -> bool:
    """Whether they are equal to the digits of a text file: actions that stand still have no variance to compare."""
    rest = seen - expected
    return bool(np.sqrt(np.nanmean(rest**2)) < DIGITS) if np.isfinite(rest).any() else False


def golden(evidence: Evidence, result: Result, pairs: dict[str, Array] | None) -> None:
    """Compare the file's answers on this machine with golden pairs of the manifest, and with those of `--golden`."""
    for part, given in (("manifest", evidence.manifest.golden), ("given", pairs or {})):
        if "action" not in given or "observation" not in given:
            continue
        observation = given["observation"]
        memory = given.get("memory", np.zeros((len(observation), evidence.network.memory)))
        error = np.abs(evidence.network.answers(observation, memory) - given["action"])
        # files of older versions have golden observations beyond the limit to which they clip: a few rows differ
        if np.mean(error.max(1) > EXACT) > 0.5:
            names = tuple(n for n, e in zip(evidence.manifest.actions, error.max(0), strict=True) if e > EXACT)
            result.findings.append(Finding("file", f"golden_{part}", names, float(error.max()), EXACT))
        else:
            result.compared.setdefault("golden", []).append(part)


def clock(evidence: Evidence, result: Result, complete: bool | None) -> None:
    """Compare the rate of the policy's steps with the control period.

    Args:
        complete: whether the log has every step; None: nothing shows it.
    """
    dt = evidence.manifest.dt
    steps = np.concatenate([np.diff(run.time) for run in evidence.runs])
    period = float(np.median(steps))
    ratio = period / dt
    late = float(np.mean(steps > GAP * period))
    # steps that alternate between two periods have a mean that tells more than their median
    if abs(ratio - 1) <= RATE:
        result.compared.setdefault("clock", []).append("rate")
    elif ratio > 1.5 and abs(ratio - round(ratio)) <= RATE * round(ratio) and not complete:
        kind = "slower_or_nth" if complete is None else "every_nth"
        result.notes.append(f"{kind} {round(ratio)} {1 / period:.4g} {1 / dt:.4g}")
    else:
        result.findings.append(Finding("clock", "rate", (), 1 / period, 1 / dt))
    if late > GAPS:
        result.findings.append(Finding("clock", "late_steps", (), late, GAPS))


def actions(evidence: Evidence, result: Result, normalised: bool) -> None:
    """Compare logged actions with the file's answers at the logged observations."""
    if not evidence.has("action") or not np.isfinite(evidence.seen).all(1).any():
        result.notes.append("no_actions" if not evidence.has("action") else "no_observations")
        return
    names = evidence.manifest.actions
    seen = np.concatenate([run.action for run in evidence.runs])
    inputs = _inputs(evidence)
    left = {
        name: _left(seen, np.concatenate(answers), evidence.manifest.action_limit) for name, answers in inputs.items()
    }
    best = min(left, key=lambda name: left[name])
    if best != "" and left[best] < EXPLAINS * left[""] and left[best] < EXPLAINS:
        if best == "normaliser_missing" and normalised:
            result.notes.append("log_is_normalised")
            result.findings[:] = [f for f in result.findings if f.kind != "normalised"]
        else:
            result.findings.append(Finding("action", best, (), None, None, left[best], left[""]))
    answers = inputs[best] if left[best] < EXPLAINS * left[""] else inputs[""]
    _against(evidence, result, seen, answers, names)


def _inputs(evidence: Evidence) -> dict[str, list[Array]]:
    """Answers of the file to other inputs than those logged: {mistake: [K, A] of each run}."""
    manifest, network = evidence.manifest, evidence.network
    found = {"": evidence.answers}
    if manifest.mean is not None and manifest.std is not None:
        mean, std = manifest.mean, manifest.std
        found["normaliser_missing"] = [network.run(run.observation * std + mean) for run in evidence.runs]
        found["normaliser_twice"] = [network.run((run.observation - mean) / std) for run in evidence.runs]
    if network.memory:
        found["memory_reset"] = [network.run(run.observation, forgets=True) for run in evidence.runs]
    return found


def _left(seen: Array, answers: Array, limit: float) -> float:
    """Share of variance of actions within their limits that answers leave, without any line between them."""
    inside = np.clip(seen, -limit, limit)
    rows = np.isfinite(inside).all(1) & np.isfinite(answers).all(1)
    if rows.sum() < 3:
        return 1.0
    y, x = inside[rows], answers[rows]
    total = float(np.sum((y - y.mean(0)) ** 2))
    return float(np.sum((y - x) ** 2)) / max(total, 1e-9)


def _against(evidence: Evidence, result: Result, seen: Array, answers: list[Array], names: Sequence[str]) -> None:
    limit, whole = evidence.manifest.action_limit, np.concatenate(answers)
    if _left(seen, whole, limit) < EQUAL or within_digits(np.clip(seen, -limit, limit), whole):
        _limits(result, seen, whole, names, evidence)
        result.compared.setdefault("action", []).extend(names)
        return
    entries = [Entry(name, {f"action:{name}": 1.0}, 0.0, "") for name in names]
    capped = _within(seen, whole, limit)
    relation = relate(capped, _shifts(answers), ())
    noisy = _noise(seen, whole, limit)
    if relation is None or (float(np.mean(relation.left)) > EXPLAINS and noisy == 0):
        result.findings.append(Finding("action", "other_policy", (), None, None, _left(seen, whole, limit)))
        return
    plain = relation.delay == 0 and relation.smooth == 1.0 and relation.order == tuple(range(len(names)))
    if noisy and plain and relation.held == 1 and not relation.stale:
        result.findings.append(Finding("action", "noise", (), noisy, 0.0))
        return
    found = [replace(f, part="action") for f in of_order(entries, capped, relation) if f.kind == "order"]
    found += [replace(f, part="action") for f in judge("action", entries, capped, relation, (), result)]
    found += _timing("action", relation)
    result.findings += [replace(f, left=float(np.mean(relation.left))) for f in found]
    _limits(result, seen, whole, names, evidence)


def _shifts(values: Sequence[Array]) -> Callable[[str, float], Array | None]:
    """Make the reference of values [K, n] of each run that were delayed by whole steps."""
    return lambda frame, d: None if frame or d % 1 else np.concatenate([shifted(v, int(d)) for v in values])


def _timing(part: str, relation: Relation) -> list[Finding]:
    """Delays, filters and held values of all entries of a part."""
    found = []
    if relation.delay:
        found.append(Finding(part, "delay", (), float(relation.delay)))
    if relation.smooth < 1.0:
        found.append(Finding(part, "smooth", (), round(relation.smooth, 2)))
    if relation.held > 1:
        found.append(Finding(part, "held", (), float(relation.held)))
    elif relation.stale:
        found.append(Finding(part, "stale", (), round(relation.stale, 2)))
    return found


def _within(seen: Array, expected: Array, limit: float) -> Array:
    """Values without those at a limit, of the contract or their own: no line holds there."""
    out = np.where(np.abs(expected) < limit, seen, np.nan)
    for i in range(out.shape[1]):
        for end in _ends(seen[:, i]):
            out[:, i] = np.where(seen[:, i] == end, np.nan, out[:, i])
    return out if np.isfinite(out).all(1).sum() > 30 else seen


def _ends(values: Array) -> list[float]:
    """Largest and smallest value where many rows have them."""
    good = values[np.isfinite(values)]
    if len(good) < 3 or np.ptp(good) < 1e-9:
        return []
    return [float(end) for end in (good.min(), good.max()) if np.mean(good == end) > SATURATED]


def _limits(result: Result, seen: Array, answers: Array, names: Sequence[str], evidence: Evidence) -> None:
    """Actions beyond the limit, or held at a smaller one."""
    limit = evidence.manifest.action_limit
    beyond = np.nanmax(np.abs(seen), axis=0) > limit + 1e-3
    if beyond.any() and not _command_is_clipped(evidence):
        largest = float(np.nanmax(np.abs(seen)))
        who = tuple(n for n, b in zip(names, beyond, strict=True) if b)
        result.findings.append(Finding("action", "clip_missing", who, largest, limit))
    smaller = {}
    for i, name in enumerate(names):
        ends = [e for e in _ends(seen[:, i]) if abs(e) < limit - 1e-3]
        # a network may be constant there by itself, as where its normaliser clips
        ends = [e for e in ends if np.mean(np.sign(e) * answers[seen[:, i] == e, i] > abs(e) + 1e-3) > 0.5]
        if ends:
            smaller[name] = max(map(abs, ends))
    if smaller:
        result.findings.append(
            Finding("action", "clip_smaller", tuple(smaller), float(np.median([*smaller.values()])), limit)
        )


def _command_is_clipped(evidence: Evidence) -> bool:
    """Whether commands are made of clipped actions although the log has them as the network gave them."""
    manifest = evidence.manifest
    if manifest.scale is None or manifest.offset is None or not evidence.has("ctrl"):
        return False
    if not evidence.has("action"):
        return True
    ctrl = np.concatenate([run.ctrl for run in evidence.runs])
    acted = np.concatenate([run.action for run in evidence.runs])
    clipped = manifest.offset + manifest.scale * np.clip(acted, -manifest.action_limit, manifest.action_limit)
    plain = manifest.offset + manifest.scale * acted
    return bool(np.nanmean((ctrl - clipped) ** 2) < np.nanmean((ctrl - plain) ** 2))


def _noise(seen: Array, answers: Array, limit: float) -> float:
    """Compute the standard deviation of noise that was added to the answers; 0 where the rest is no white noise."""
    rows = np.isfinite(seen).all(1) & np.isfinite(answers).all(1)
    inside = (np.abs(answers) < 0.7 * limit).all(1) & (np.abs(seen) < limit).all(1)
    rows &= inside if (rows & inside).sum() > 30 else True
    rest = seen[rows] - answers[rows]
    if len(rest) < 30 or rest.std() < SPREAD:
        return 0.0
    centred = rest - rest.mean(0)
    size = centred.std(0)
    if size.min() < 0.3 * size.max():
        return 0.0
    following = np.flatnonzero(rows)
    pairs = following[1:][np.diff(following) == 1]
    lagged = np.mean(
        (seen[pairs] - answers[pairs] - rest.mean(0)) * (seen[pairs - 1] - answers[pairs - 1] - rest.mean(0)), 0
    )
    white = np.abs(lagged / np.maximum(size**2, 1e-12)).mean() < 0.2
    level = np.abs(rest.mean(0)).max() < 0.3 * size.max()
    moving = np.maximum(answers[rows].std(0), 1e-9)
    follows = np.mean(centred * (answers[rows] - answers[rows].mean(0)), 0) / moving**2
    steady = answers[rows].std(0) < 0.1 * size
    return float(np.median(size)) if white and level and bool((steady | (np.abs(follows) < 0.3)).all()) else 0.0


def commands(evidence: Evidence, result: Result, strict: bool = False) -> None:
    """Compare logged commands with offset + scale * action.

    Args:
        strict: the actions are guesses, so that only a relation that explains the commands counts.
    """
    manifest = evidence.manifest
    if manifest.scale is None or manifest.offset is None:
        result.notes.append("no_scale")
        return
    if not evidence.has("ctrl"):
        result.notes.append("no_commands")
        return
    limit, scale, offset = manifest.action_limit, manifest.scale, manifest.offset
    ctrl = np.concatenate([run.ctrl for run in evidence.runs])
    bound = limit if _command_is_clipped(evidence) else np.inf  # that the clip is missing is said of the actions
    made = [offset + scale * np.clip(a, -bound, bound) for a in evidence.acted]
    names = manifest.actions
    low, high = manifest.command_range.T
    whole = np.concatenate(made)
    if within_digits((ctrl - offset) / scale, (np.clip(whole, low, high) - offset) / scale) or (
        _left(ctrl, np.clip(whole, low, high), np.inf) < EQUAL
        and np.nanmax(np.abs(np.nanmean(ctrl - np.clip(whole, low, high), axis=0) / scale)) < NEAR
    ):
        result.compared.setdefault("command", []).extend(names)
        return
    entries = [Entry(n, {f"action:{n}": float(s)}, float(o), "") for n, s, o in zip(names, scale, offset, strict=True)]
    own = _off_the_ends(ctrl)
    relation = relate(own, _shifts(made), ())
    if relation is None:
        result.notes.append("no_commands")
        return
    if strict and float(np.mean(relation.left)) > EQUAL:
        return
    if strict:
        result.notes.remove("rebuilt_unlike")
    found = [replace(f, part="command") for f in of_order(entries, own, relation) if f.kind == "order"]
    found += judge("command", entries, own, relation, (), result)
    found += _timing("command", relation)
    bad = {name for f in found for name in f.entries}
    good = [n for n, told in zip(names, relation.told, strict=True) if told and n not in bad]
    result.compared.setdefault("command", []).extend(good)
    result.findings += [replace(f, left=float(np.mean(relation.left))) for f in found]


def _off_the_ends(values: Array) -> Array:
    out = values.copy()
    for i in range(values.shape[1]):
        for end in _ends(values[:, i]):
            out[:, i] = np.where(values[:, i] == end, np.nan, out[:, i])
    return out if np.isfinite(out).all(1).sum() > 30 else values
