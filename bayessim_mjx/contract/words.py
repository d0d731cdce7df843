"""Sentences of the check, made of its findings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.contract import axes, remainder
from bayessim_mjx.contract.evidence import Finding, Result
from bayessim_mjx.contract.manifest import Entry
from bayessim_mjx.contract.relate import CLEAR, Relation
from bayessim_mjx.quantities import compact, listed, ordinal, percent

Array = NDArray[np.float64]
SAME = 0.02  # by which two numbers of one finding may differ, relatively; a rule of thumb


def judge(
    part: str, entries: Sequence[Entry], seen: Array, relation: Relation, quiet: Sequence[str], result: Result
) -> list[Finding]:
    """Find wrong signs, units, scales and offsets; each finding has all entries that share it.

    Args:
        quiet: kinds that another finding of the group explains.
    """
    faults: list[tuple[str, axes.Fault]] = []
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
            slope_faults, slope = axes.named(axes.line(own, base), entry.weight, entry.unit, [other.weight])
            start, sd = axes.starting(own, base, slope)
            offsets = [other.offset] if other is not entry else []
            lines[entry.name] = (entry, start, sd, slope)
            found = [
                *slope_faults,
                *axes.start_fault(start, sd, slope, entry.weight, entry.offset, entry.unit, offsets),
            ]
        elif relation.turn is None:
            found = _still(entry, own[rows], base[rows], result)
        else:
            found = []
        faults += [(entry.name, fault) for fault in found if fault.kind not in quiet]
    return together(part, _poses(faults, lines))


def _poses(
    faults: list[tuple[str, axes.Fault]], lines: dict[str, tuple[Entry, float, float, float]]
) -> list[tuple[str, axes.Fault]]:
    """Let a default pose that is wrong in some entries hold for others too, whose own pose is too small to show it."""
    kinds = {fault.kind for _, fault in faults if fault.kind.startswith("pose")}
    out = [(name, fault) for name, fault in faults if fault.kind != "offset" or not kinds]
    for name, (entry, start, sd, slope) in lines.items() if kinds else ():
        own = [fault for of, fault in faults if of == name]
        if any(fault.kind.startswith("pose") for fault in own):
            continue
        for kind in sorted(kinds):
            if entry.offset and axes.pose_fits(kind, start, sd, slope, entry.weight, entry.offset, entry.unit):
                out.append((name, axes.Fault(kind, start, entry.offset)))
                break
        else:
            out += [(name, fault) for fault in own if fault.kind == "offset"]
    return out


def _still(entry: Entry, own: Array, base: Array, result: Result) -> list[axes.Fault]:
    """Faults of an entry whose source does not move, or that does not move with it."""
    expected = entry.weight * base + entry.offset
    limit = axes.OFFSETS.get(entry.unit, axes.OFFSET) * abs(entry.weight)
    moves = float(np.std(expected)) > limit
    if np.ptp(own) <= 1e-9 * max(1.0, abs(float(own[0]))) and moves:
        return [axes.Fault("frozen", float(own[0]), "")]
    if (
        moves
        and _clear(expected)
        and remainder.slow(expected)
        and (_clear(own) or remainder.contradicts(own, expected))
    ):
        return [axes.Fault("unrelated", "", "")]
    result.untold[entry.name] = "still" if not moves else "noise"
    if entry.kind == "action":
        return []
    noise = 5 * float(np.hypot(own.std(), expected.std()) / np.sqrt(max(len(own) / 10, 1)))
    limit += noise
    here, there = float(np.mean(own)), float(np.mean(expected))
    if abs(here - there) <= limit or moves:
        return []
    if abs(here + there) <= limit and abs(there) > 2 * limit:
        return [axes.Fault("sign", -1.0, 1.0)]
    if abs(here - (there - entry.offset)) <= limit and abs(entry.offset) > 2 * limit:
        return [axes.Fault("pose_missing", here, there)]
    for other, factor in axes.UNITS.get(entry.unit, {}).items():
        if abs(there) > 2 * limit and abs(here / (factor * there) - 1) < axes.NEAR:
            return [axes.Fault("unit", other, entry.unit)]
    return [axes.Fault("offset", (here - there) / entry.weight, 0.0)]


def _clear(values: Array) -> bool:
    """Whether the motion stands far out of the noise of the channel."""
    bend = values[2:] - 2 * values[1:-1] + values[:-2]
    noise = float(np.median(np.abs(bend))) / (0.6745 * np.sqrt(6.0))  # of white noise: sd of its second difference
    return float(np.std(values)) > CLEAR * noise


def together(part: str, faults: Sequence[tuple[str, axes.Fault]]) -> list[Finding]:
    """One finding for all entries with the same fault."""
    found: list[Finding] = []
    for name, fault in faults:
        for k, other in enumerate(found):
            if other.kind == fault.kind and _alike(other, fault):
                each = {**other.each, name: (fault.found, fault.expected)}
                found[k] = replace(other, entries=(*other.entries, name), each=each)
                break
        else:
            each = {name: (fault.found, fault.expected)}
            found.append(Finding(part, fault.kind, (name,), fault.found, fault.expected, each=each))
    return found


def _alike(one: Finding, two: axes.Fault) -> bool:
    if one.kind.startswith("pose") or one.kind == "frozen":
        return True
    if isinstance(one.found, float) and isinstance(two.found, float):
        ratio = [
            abs(float(a)) / max(abs(float(b)), 1e-9)
            for a, b in ((one.found, one.expected or 1.0), (two.found, two.expected or 1.0))
        ]
        return abs(ratio[0] - ratio[1]) <= SAME * max(ratio[0], 1e-9) * 2
    return one.found == two.found and one.expected == two.expected


MOST = 4  # names that a sentence lists; more only by their number; a rule of thumb
SENTENCES = {
    "order": "they show {found}",
    "frame": "in {frame}",
    "axes": "axes are turned by {found}",
    "quaternion_order": "quaternion in the order {found} in place of {expected}",
    "inverse": "quaternion is that of the inverse rotation (conjugate)",
    "command_fed_back": "previous commands are fed back in place of actions",
    "other_source": "shows {found}",
    "unrelated": "follows from no logged source",
    "beyond": "{found} (rms) off what its source, timing and noise explain",
    "frozen": "constant at {found} while its source moves",
    "sign": "sign is flipped",
    "unit": "in {found} in place of {expected}",
    "scale": "scale {found} in place of {expected}",
    "scale_missing": "scale {found} in place of {expected} (it is not applied)",
    "scale_twice": "scale {found} in place of {expected} (it is applied twice)",
    "pose_missing": "default pose is not {pose}",
    "pose_twice": "default pose is {pose} twice",
    "pose_added": "default pose has the wrong sign",
    "offset": "offset of {found} from the source",
    "delay": "{found} step(s) late",
    "early": "{found} step(s) early",
    "held": "refreshed every {found} steps only",
    "stale": "old values in {share} of the steps",
    "smooth": "low-pass filtered: a step takes {share} of the new value",
    "normalised": "normalised before the policy, which normalises again",
    "normaliser_missing": "as of a policy without its normaliser",
    "normaliser_twice": "as of a policy that normalises twice",
    "memory_reset": "as of a policy whose memory is reset in every step",
    "other_policy": "not those of this file: another policy, another normaliser or other inputs",
    "noise": "noise with standard deviation {found} is added (sampled, not the mean)",
    "clip_missing": "beyond {expected}: clip is missing (largest {found})",
    "clip_smaller": "limited to {found} in place of {expected}",
    "rate": "control at {found} Hz in place of {expected} Hz",
    "late_steps": "{share} of the steps are late",
    "golden_manifest": "this machine's answers differ from the golden pairs by {found}",
    "golden_given": "the given pairs differ from the file's answers by {found}",
}
SWAPPED = "swapped"
UNEQUAL = {  # of entries that share a finding and not its numbers
    "scale": "scale {ratio} times the file's",
    "frozen": "constant while the source moves",
}
MOTION = {
    "order": "they follow the commands of {found}",
    "sign": "moves against its command",
}
FRAMES = {
    "world": "the world's axes", "body": "the body's axes", "inverse": "axes turned by the inverse rotation",
    "order": "axes of a quaternion read in another order",
}  # fmt: skip
WHOLE = {"golden": "golden pairs", "clock": "rate of control"}
WHY = {
    "unknown": "the manifest does not name its source",
    "no_source": "the log has no channel that it follows from",
    "not_logged": "it is not in the log",
    "still": "the log does not move it",
    "noise": "noise hides its relation",
}
NOTES = {
    "no_actions": "no actions in the log: the policy's answers are not compared",
    "no_observations": "no complete observation in the log: the policy's answers are not compared",
    "no_commands": "no commands in the log (ctrl:<actuator>): scale, offset and order of commands are unknown",
    "rebuilt": "no observations in the log: the actions follow from the logged state as the manifest says",
    "rebuilt_unlike": (
        "no observations in the log, and no single mistake that was tried explains the actions: several mistakes, "
        "another policy, or noise of the log; log the policy's observations (observation:<name>), which separate them"
    ),
    "not_rebuilt": "no observations in the log, and its state does not give all of them: log observation:<name>",
    "no_scale": "commands are no multiples of the actions: they are not compared",
    "log_is_normalised": "the log holds normalised observations; the actions fit them",
}

NOTHING = (
    "error: nothing of observations, actions and commands could be compared. Log observation:<name> and "
    "action:<actuator> while the robot moves, with the names in the file, and check again (docs/export.md)"
)


def sentence(finding: Finding) -> str:
    """One line of what differs, without the name of the entry."""
    found, expected = finding.found, finding.expected
    kind = "early" if finding.kind == "delay" and float(found or 0) < 0 else finding.kind
    shown = abs(found) if kind in ("early", "delay", "scale") and isinstance(found, float) else found
    if finding.kind == "order" and len(finding.entries) == 2:
        return SWAPPED if finding.part != "motion" else f"drives {SWAPPED}"
    unequal = len({(_text(found), _text(expected)) for found, expected in finding.each.values()}) > 1
    if unequal and finding.kind in UNEQUAL:
        return UNEQUAL[finding.kind].format(ratio=_text(float(found or 0) / float(expected or 1)))
    if finding.part == "motion":
        return MOTION[kind].format(entries=listed(finding.entries, most=MOST), found=found)
    return SENTENCES[kind].format(
        found=_text(shown),
        expected=_text(expected),
        entries=listed(finding.entries, most=MOST),
        share=percent(found) if isinstance(found, float) else "",
        frame=FRAMES.get(str(found), ""),
        pose="subtracted" if finding.part == "observation" else "added",
    )


def evidence(finding: Finding) -> str:
    """Error now and if the finding is mended, as shares of the variance; "" where it is not known."""
    if finding.left is None or finding.before is None:
        return ""
    now = percent(finding.before) if finding.before <= 1 else "over 100 %"
    return f"{now}, {percent(round(finding.left, 4))}"


def right(part: str, names: Sequence[str]) -> str:
    """Write what was compared and is right."""
    return WHOLE.get(part) or f"{part}, {len(names)} entr{'y' if len(names) == 1 else 'ies'}"


def where(finding: Finding) -> str:
    """Entries of a finding, or its part."""
    return f"{finding.part} {listed(finding.entries, most=MOST)}".strip()


def why(entry: str, reason: str) -> str:
    """Why an entry cannot be told."""
    return f"{entry}: {WHY[reason]}"


def note(text: str) -> str:
    """Write what else a user has to know."""
    key, *rest = text.split()
    if key == "lacks":
        if rest[0] == "observation_meaning":
            return (
                "the file was exported by an older version and does not say what its observations mean: they are "
                "compared with nothing but the policy's answers; export it again, or give observation_meaning in "
                "--manifest FILE"
            )
        return f"the file has no {rest[0]}; export it again"
    if key in ("every_nth", "slower_or_nth"):
        n, here, there = rest
        slower = "" if key == "every_nth" else "control is slower, or "
        return f"rows are at {here} Hz in place of {there} Hz: {slower}the log has every {ordinal(int(n))} step only"
    return NOTES[key]


def shows(result: Result) -> bool:
    """Whether anything of observations, actions and commands was compared."""
    return any(result.compared.get(part) for part in ("observation", "action", "command"))


def verdict(result: Result) -> str:
    """Write the last line."""
    if result.findings:
        n = len(result.findings)
        return f"{n} thing{'s' if n > 1 else ''} of the deployed policy differ{'' if n > 1 else 's'} from its file"
    if unlike(result):
        return "differs: the actions do not follow from the logged state"
    if not shows(result):
        return NOTHING
    if unsettled(result):
        return "unknown: the rate of control (see the note); what else was compared is right. Log every step"
    if result.untold:
        hidden = listed(list(result.untold), most=MOST)
        return f"the deployed policy is as its file says, except {hidden}, which the log does not show"
    return "the deployed policy is as its file says"


def unlike(result: Result) -> bool:
    """Whether the actions follow from the logged state neither by the file nor by a mistake that was tried."""
    return "rebuilt_unlike" in result.notes


def unsettled(result: Result) -> bool:
    """Whether control may be slower than the file says: nothing shows that the log lacks steps."""
    return any(text.startswith("slower_or_nth") for text in result.notes)


def outcome(result: Result) -> str:
    """Return the verdict as a word: differs, right, unknown (the rate of control), or not compared."""
    if result.findings or unlike(result):
        return "differs"
    if not shows(result):
        return "not compared"
    return "unknown" if unsettled(result) else "right"


def _text(value: float | str | None) -> str:
    return compact(value, 3) if isinstance(value, int | float) else str(value or "")
