"""The verdict in words: the texts of its sentences, and the numbers that fill them in."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bayessim_mjx.diagnosis import phrases, tolerance
from bayessim_mjx.diagnosis.evidence.selecting import Rival
from bayessim_mjx.diagnosis.evidence.sets import Weighed
from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.gap import of_one, of_rms
from bayessim_mjx.diagnosis.result import FoundEffect, Gap
from bayessim_mjx.diagnosis.selection.models import BASE
from bayessim_mjx.diagnosis.summary import first_look
from bayessim_mjx.diagnosis.summary.left_in_words import flexible_in_words
from bayessim_mjx.diagnosis.summary.verdict import Verdict
from bayessim_mjx.quantities import extent, listed, percent

HEADS = {
    "no_gap": "No gap above the noise: the logs differ from the simulator by {nominal}.",
    "parameters": "Only parameters are off, as far as these logs tell: recalibrated, the gap falls from {nominal} to "
    "{calibrated}.",
    "noise": "The noise is larger than estimated: what the recalibrated simulator leaves, {calibrated}, nothing "
    "predicts, and no force leaves such a trace.",
    "effects": "The simulator lacks {named}.",
    "ambiguous": "The simulator lacks something like {named}, but these logs fit other explanations as well.",
    "unexplained": "Something is missing that no effect of the library explains.",
}
ABOVE = {  # where the residual is above the noise
    "no_gap": "The logs differ from the simulator by {nominal}. That is more than the noise, but too little for these "
    "logs to tell what is missing.",
    "parameters": "The parameters are off: recalibrated, the gap falls from {nominal} to {calibrated}. That is more "
    "than the noise, but too little for these logs to tell what is missing.",
}
PARTLY = (
    "Partly explained: {named} {close} {realised} of the squared gap above the noise, but more than the tolerance "
    "remains at {beyond}."
)
REST = {
    "effects": "The simulator lacks {named}, and more than the tolerance remains at {beyond}.",
    "ambiguous": "The simulator lacks something like {named}, but these logs fit other explanations as well, and more "
    "than the tolerance remains at {beyond}.",
}
IMPERFECT = (
    "No candidate closes what remains, {remains_of} of the squared gap: the law is not quite that of the real system."
)
NEAREST = "Of the library, {named} {come} nearest"
ON_TOP = "; a force that {they_lack} makes {remains} of the gap"
FALLS = (
    "With {them} the recalibrated simulator's gap falls from {calibrated} to {with_effects} on held-out {held}. "
    "Before {they} fitted, {predicted} of the squared gap above the noise was predicted to close; {realised} did."
)
ELSEWHERE = (
    "Where the effects are chosen anew without each operating condition in turn, they close {elsewhere} of the gap of "
    "the condition that was left out."
)
NESTED = (
    "For each operating condition the effects were chosen and fitted without it; the costs behind the choice were not, "
    "so these shares may be a little too high."
)
IN_SAMPLE = (
    "These numbers are in sample: one log is one operating condition, parts of it were held out, and nothing tells how "
    "they hold in another condition."
)
WITHIN = "What remains is within the tolerance at every joint: {within}."
PROBABLE = (
    "Probability of this explanation among all that were fitted: {share}; of the others that stand beside it: "
    "{others}; of the known parameters alone: {nothing}."
)
HIDDEN = (
    "Beside {them} these logs would not show {hidden}: parameters of what is named do the same, and stand for both "
    "where both are there."
)
STANDS_FOR = (
    "The data sheet may be wrong at {parameters}, or the simulator lacks {effects}: both move the robot alike. "
    "--accuracy weighs the two."
)
BUILDS_UP = (
    "Over whole logs the error grows to {times} times what noise, start and parameters make likely, though within "
    "{window} it hardly shows: the law, or the simulator's time step, is not quite right."
)
BENT = (
    "This needs {far} of {known} known parameters far from the data sheet, by chance less often than in 1 of 10 000 "
    "robots even if it is half as inaccurate again as stated: something else may be missing in their place, or the "
    "data sheet is not this robot's (--accuracy, --parameters)."
)
OF_SENSORS = "What remains has the covariance of noise of the sensors, {colour}."
CHANCE = (
    "What remains, {calibrated}, no candidate and no flexible force predicts on held-out {held}: process noise, an "
    "input that was not logged, or noise larger than estimated."
)

COASTS = (
    "Joints that just keep their speed in a window, without any simulator, are {coasting} noise sd off, less than the "
    "recalibrated simulator's {calibrated}{more}: its forces are far off, or hardly show in windows as short as these."
)
COASTS_CLOSED = "; of that squared gap the effects close {closed}"
STUCK = "At a bound, where they stand in for something else or their range is too narrow: {named}."
FAR = "Far from the data sheet: {named}."


@dataclass(frozen=True)
class Limits:
    """What is worth a sentence, and how much of it is told."""

    listed_joints: int = 6  # joints told one by one


LIMITS = Limits()
SELDOM = 1e-6  # a smaller probability has no number


def sentences(
    verdict: Verdict,
    effects: list[FoundEffect],
    parameters: dict[str, dict[str, Any]],
    found: Findings,
    far: Gap,
) -> list[str]:
    """The verdict, most important first."""
    name, cut = verdict.name, found.selection.state.fitter.simulator.windows
    texts = verdict_in_words(name, effects, far, verdict.remains)
    far_off, known = verdict.bent
    texts += [BENT.format(far=far_off, known=known)] if known else []
    if verdict.builds_up:
        texts.append(BUILDS_UP.format(times=f"{verdict.builds_up:.2g}", window=f"{cut.steps * cut.dt:.2g} s"))
    texts += [_coasting(far, bool(effects)), _probable(found.selection.weighed)]
    if found.selection.ambiguous:
        texts += [_instead(e, found.selection.rivals.get(f"{e.name}@{e.where}", ())) for e in effects]
    texts += [_hidden(found.selection.hidden, len(effects))]
    if verdict.noise is not None and (name == "noise" or far.beyond):
        texts.append(_of_sensors(verdict.noise.memory * cut.steps * cut.dt))
    elif not effects and found.flexible_winner is not None and not found.flexible_winner.condition.significant:
        texts.append(CHANCE.format(calibrated=stage_in_words(far, "calibrated"), held=_held(far)))
    if name == "unexplained" and found.flexible_winner is not None:
        texts += [f"{text[:1].upper()}{text[1:]}." for text in flexible_in_words(found.flexible_winner, cut.blocks)]
    texts += [first_look.apart(found.setup.look)]
    texts += [f"At its bound: {phrases.missing(e.name, e.where)}. {e.sentence}" for e in effects if _at_bound(e)]
    texts += _remarks(parameters)
    return [text for text in texts if text]


def _remarks(parameters: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What is remarked of known parameters: a sentence for each, but one for all at a bound and for all far off."""
    stuck: dict[str, str] = {}
    far: dict[str, str] = {}
    texts = []
    for name, about in parameters.items():
        value, text, sheet = f"{name} {about['mean']:.4g}", about["structural"], about.get("data_sheet")
        if text == phrases.stuck(about.get("simulated", about["mean"])):
            stuck[value] = f"{name} {text}."
        elif text:
            texts.append(f"{name} {text}.")
        if sheet:
            far[f"{value} ({about['away']:.1f} sd)"] = f"{name} {sheet}."
    for together, sentence in ((stuck, STUCK), (far, FAR)):
        texts += together.values() if len(together) < 2 else [sentence.format(named=listed(list(together)))]
    same = {name: about["same_as"] for name, about in parameters.items() if about.get("same_as")}
    labels = [label for each in same.values() for label in each]
    texts += [STANDS_FOR.format(parameters=listed(list(same)), effects=_any_of(labels))] if same else []
    return texts


def _hidden(labels: Sequence[str], effects: int) -> str:
    return HIDDEN.format(them="it" if effects == 1 else "them", hidden=_any_of(labels)) if labels else ""


def _any_of(labels: Sequence[str]) -> str:
    """Effects in words, not too many."""
    every = phrases.by_law([label.split("@", 1) for label in labels])
    parts = every[: LIMITS.listed_joints]
    parts += [f"{len(every) - len(parts)} more"] if len(every) > len(parts) else []
    return listed(parts, "or")


def _probable(weighed: Weighed) -> str:
    """Of what is named."""
    if not weighed.answer:
        return ""
    others, nothing = sum(weighed.weight[k] for k in weighed.beside), weighed.weight[BASE]
    chance = percent(nothing) if nothing > SELDOM else "less than one in a million"
    return PROBABLE.format(share=percent(weighed.weight[weighed.answer]), others=percent(others), nothing=chance)


def _coasting(far: Gap, named: bool) -> str:
    """Where no simulator at all predicts better than the recalibrated one."""
    if far.coasting is None or far.coasting >= far.calibrated:
        return ""
    closed = of_rms(far.coasting, far.with_effects).closed
    more = COASTS_CLOSED.format(closed=percent(max(closed, 0.0))) if named else ""
    return COASTS.format(coasting=number(far.coasting), calibrated=number(far.calibrated), more=more)


def _of_sensors(memory: float) -> str:
    """Of noise with a memory in s; 0 where it is white."""
    return OF_SENSORS.format(colour=f"correlated over about {1e3 * memory:.2g} ms" if memory else "white")


def verdict_in_words(name: str, effects: list[FoundEffect], far: Gap, remains: float = 0.0) -> list[str]:
    """Verdict, how far, and what remains against the tolerance.

    Args:
        remains: share of the gap that a force makes which the effects leave.
    """
    promised, went = (far.closed.get(k, math.nan) for k in ("predicted", "realised"))
    one = len(effects) == 1
    fill = {s: stage_in_words(far, s) for s in ("nominal", "calibrated", "with_effects")} | {
        "named": listed(phrases.by_law([(e.name, e.where) for e in effects])),
        "them": "it" if one else "them",
        "they": "it was" if one else "they were",
        "they_lack": "it lacks" if one else "they lack",
        "come": "comes" if one else "come",
        "close": "closes" if one else "close",
        "remains": percent(remains),
        "predicted": percent(promised),
        "realised": percent(went),
        "elsewhere": percent(far.closed.get("elsewhere")),
        "remains_of": percent(1.0 - went),
        "beyond": listed([_left(n, far.physical[n]) for n in _worst(far) if n in far.beyond][:3]),
        "within": _within(far),
        "held": _held(far),
    }
    partly = name == "unexplained" and effects and far.beyond
    both = bool(effects and far.beyond) and name in REST
    quoted = {"no_gap": far.nominal, "parameters": far.calibrated}.get(name, 0.0)
    heads = HEADS if of_one(quoted**2).at_noise else ABOVE
    out = [PARTLY if partly else REST[name] if both else heads[name]]
    if effects:
        more = ON_TOP if remains > 0.0 else ""
        out += [f"{NEAREST}{more}."] if name == "unexplained" and (more or not partly) else []
        out.append(FALLS)
        out += [IMPERFECT] if both and went < 1.0 else []
        out += [NESTED if far.closed.get("nested") else ""]
        out += [ELSEWHERE] if math.isfinite(far.closed.get("elsewhere", math.nan)) else []
    out += [IN_SAMPLE] if far.in_sample else []
    if name == "unexplained" and not effects:
        rest = [_left(n, far.physical[n]) for n in _worst(far) if "largest" in far.physical[n]]
        out += [f"What remains after recalibration: {listed(rest[:3])}."] if rest else []
    joints = list(far.physical)
    if len(joints) > 1 and name != "no_gap":
        out.append(_by_joint(far, bool(effects)))
    if effects and _within(far) and not far.beyond:
        out.append(WITHIN)
    return [text.format(**fill) for text in out if text]


def _held(far: Gap) -> str:
    """What was held out."""
    return "parts of the log" if far.in_sample else "conditions"


def _at_bound(effect: FoundEffect) -> bool:
    return any(v.bound not in ("", "off") for v in effect.parameters.values())


def stage_in_words(far: Gap, stage: str) -> str:
    """`1.2 deg (2.1 % of the motion, 27.0 noise sd)`; of several joints the share alone."""
    parts = [percent(far.shares[stage]) + " of the motion"] if stage in far.shares else []
    noises = f"{number(getattr(far, stage))} noise sd"
    if len(far.physical) == 1:
        (row,) = far.physical.values()
        return f"{extent(row[stage], row['unit'])} ({', '.join([*parts, noises])})"
    return f"{parts[0]} ({noises})" if parts else noises


def _worst(far: Gap) -> list[str]:
    """Joints, what remains against the tolerance largest first."""
    return sorted(far.physical, key=lambda n: -_against(far.physical[n]))


def _against(row: dict[str, Any]) -> float:
    return float(row["with_effects"] / row["tolerance"]) if row.get("tolerance") else 0.0


def _left(name: str, row: dict[str, Any]) -> str:
    """`elbow: 1.2 deg rms, 3.4 deg at most (2.1 % of its motion; tolerance 0.8 deg)`."""
    unit = row["unit"]
    most = f"{extent(row['with_effects'], unit)} rms, {extent(row['largest'], unit)} at most"
    part = f"{percent(row['with_effects'] / row['motion'])} of its motion; " if row["motion"] else ""
    return f"{name}: {most} ({part}tolerance {extent(row['tolerance'], unit)})"


def _within(far: Gap) -> str:
    """The joint that comes nearest to its tolerance."""
    name = next((n for n in _worst(far) if far.physical[n].get("tolerance")), "")
    if not name:
        return ""
    row = far.physical[name]
    noise, unit = row.get("noise", 0.0), row["unit"]
    above = float(tolerance.above_noise(row["with_effects"], noise))
    return f"{extent(above, unit)} above the noise, of {extent(max(row['tolerance'], noise), unit)}, at {name}"


def _by_joint(far: Gap, effects: bool) -> str:
    """`By joint, recalibrated and with the effects: elbow 1.2 deg, 0.05 deg; ...`, the worst first."""
    stages = ("calibrated", "with_effects") if effects else ("nominal", "calibrated")
    words = "recalibrated and with the effects" if effects else "as delivered and recalibrated"
    names = _worst(far)
    rows = [
        (n, [extent(far.physical[n][s], far.physical[n]["unit"]) for s in stages])
        for n in names[: LIMITS.listed_joints]
    ]
    more = f"; {len(names) - LIMITS.listed_joints} more in the table" if len(names) > LIMITS.listed_joints else ""
    return f"By joint, {words}: {'; '.join(f'{n} {a}, {b}' for n, (a, b) in rows)}{more}."


def number(value: float) -> str:
    """Three digits, in plain notation."""
    return f"{value:.2f}" if value < 9.995 else f"{value:.1f}" if value < 99.95 else f"{value:.0f}"


def _instead(effect: FoundEffect, rivals: Sequence[Rival]) -> str:
    """What else it could be, and how large it is whichever it is."""
    others = [listed(phrases.by_law([(c.effect, c.where) for c in r.effects])) for r in rivals if not r.contains][:4]
    if not others:
        return ""
    text = f"Instead of {phrases.missing(effect.name, effect.where)} it could be {listed(others, 'or')}."
    shared = effect.shared
    if not shared:
        return text
    size, low, high = (f"{shared[k]:.3g}" for k in ("mean", "low", "high"))
    which = "whichever it is" if len(shared["effects"]) == len(others) + 1 else f"as {_any_of(shared['effects'])}"
    return f"{text} Its size, {which}: {size} {shared['unit']} (90 %: {low} to {high})."


def horizon_warning(far: Gap) -> list[str]:
    """A verdict that changes with the horizon is flagged."""
    loud = [row for row in far.horizons if not of_one(row["calibrated"] ** 2).at_noise]
    closed = {row["name"]: of_rms(row["calibrated"], row["with_effects"]).closed for row in loud}
    if len(closed) < 2 or max(closed.values()) - min(closed.values()) < 0.3:
        return []
    shares = ", ".join(f"{percent(share)} ({name})" for name, share in closed.items())
    return [f"the gap closed depends on the horizon: {shares}"]
