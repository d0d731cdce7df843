"""Sentences of the check, made of its findings."""

from __future__ import annotations

from collections.abc import Sequence

from bayessim_mjx.contract.evidence import Finding, Result
from bayessim_mjx.quantities import compact, listed, percent

MOST = 4  # names that a sentence lists; more only by their number
SENTENCES = {
    "order": "they show {found}",
    "frame": "in {frame}",
    "axes": "axes are turned by {found}",
    "quaternion_order": "quaternion in the order {found} in place of {expected}",
    "inverse": "quaternion is that of the inverse rotation (conjugate)",
    "command_fed_back": "previous commands are fed back in place of actions",
    "other_source": "shows {found}",
    "unrelated": "follows from no logged source",
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
    "unknown": "the manifest does not say what it follows from",
    "no_source": "the log has no channel that it follows from",
    "not_logged": "it is not in the log",
    "still": "the log does not move it",
    "noise": "noise hides its relation",
}
NOTES = {
    "no_actions": "no actions in the log: the policy's answers are not compared",
    "no_observations": "no complete observation in the log: the policy's answers are not compared",
    "no_commands": "no commands in the log (ctrl:<actuator>): scale, offset and order of commands cannot be told",
    "rebuilt": "no observations in the log: the actions follow from the logged state as the manifest says",
    "rebuilt_unlike": (
        "no observations in the log, and the actions do not follow from the logged state by any single mistake that "
        "was tried: noise, several mistakes, or another policy; log what the policy sees (observation:<name>)"
    ),
    "not_rebuilt": "no observations in the log, and its state does not give all of them: log observation:<name>",
    "no_scale": "commands are no multiples of the actions: they are not compared",
    "log_is_normalised": "the log holds normalised observations; the actions fit them",
}


def sentence(finding: Finding) -> str:
    """One line of what differs, without the name of the entry."""
    found, expected = finding.found, finding.expected
    kind = "early" if finding.kind == "delay" and float(found or 0) < 0 else finding.kind
    shown = abs(found) if kind in ("early", "delay", "scale") and isinstance(found, float) else found
    if finding.kind == "order" and len(finding.entries) == 2:
        return SWAPPED if finding.part != "motion" else f"drives {SWAPPED}"
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
    """How much of the entries' variance is unexplained before and after the finding; "" where it is not known."""
    if finding.left is None or finding.before is None:
        return ""
    return f"{percent(finding.before)} to {percent(finding.left)}"


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
    if key == "every_nth":
        n, here, there = rest
        return f"steps are {here} Hz in place of {there} Hz: control is slower, or the log has every {n}th step only"
    return NOTES[key]


def verdict(result: Result) -> str:
    """Write the last line."""
    if result.findings:
        n = len(result.findings)
        return f"{n} thing{'s' if n > 1 else ''} of the deployed policy differ{'' if n > 1 else 's'} from the contract"
    if not any(result.compared.get(part) for part in ("observation", "action", "command")):
        return "nothing of observations, actions and commands could be compared"
    if "rebuilt_unlike" in result.notes:
        return "the log does not show whether the policy is deployed as its contract says"
    return "the deployed policy is as its contract says, in all that the log shows"


def _text(value: float | str | None) -> str:
    return compact(value, 3) if isinstance(value, int | float) else str(value or "")
