"""The first words on a verdict: badge, headline, what to do next, and a command to paste."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bayessim_mjx.diagnosis.phrases.parameters import stand_ins
from bayessim_mjx.diagnosis.result import Diagnosis
from bayessim_mjx.diagnosis.result import Verdict as Title
from bayessim_mjx.diagnosis.statistics import of_rms
from bayessim_mjx.effects.support.words import words
from bayessim_mjx.quantities import percent

MODEL = "model_with_effects.xml"
WHOLE = "a diagnosis without --quick, --minutes and --verdict_only"
BELOW, NOT_BELOW = "See below where a force is missing", f"{WHOLE.capitalize()} shows where a force is missing"


@dataclass(frozen=True)
class Verdict:
    """Badge, a headline where the diagnosis has no sentence, and the next step."""

    badge: str
    headline: str
    advice: str


VERDICTS = {
    "no_gap": Verdict(
        Title.NO_GAP.words,
        "The simulator reproduces the logs as well as their noise allows.",
        "Train on the simulator as it is. These logs say nothing about other motions: log those too.",
    ),
    "parameters": Verdict(
        Title.PARAMETERS.words,
        "Recalibrated parameters close the gap.",
        "Use the recalibrated parameters: effects.yaml holds them. These logs need no effect.",
    ),
    "noise": Verdict(
        Title.NOISE.words,
        "No model and no force predicts the residual, and it has the covariance of sensor noise.",
        "Use the recalibrated parameters: effects.yaml holds them. State the noise of the sensors (sigma: in the logs' "
        "metadata), or repair them. These logs need no effect.",
    ),
    "effects": Verdict(
        Title.EFFECTS.words,
        "The simulator lacks effects that these logs identify.",
        f"Train with the corrected simulator: effects.yaml, or {MODEL} in plain MuJoCo.",
    ),
    "ambiguous": Verdict(
        Title.AMBIGUOUS.words,
        "Several explanations fit these logs equally well.",
        "Run the next experiment: it separates the explanations. Until then, randomise over all of them.",
    ),
    "unexplained": Verdict(
        Title.UNEXPLAINED.words,
        "A part of the gap is reproducible, but no effect of the library explains it.",
        f"{BELOW}. Write its cause as an effect of your own (--effects file.py:Name).",
    ),
    "insufficient_data": Verdict(
        Title.INSUFFICIENT_DATA.words,
        "These logs do not allow a diagnosis.",
        "Repair or extend the logs as the warnings say, and diagnose again.",
    ),
}
ALIKE = Verdict(
    Title.AMBIGUOUS.words,
    VERDICTS["ambiguous"].headline,
    "Randomise over all explanations, or log another motion: none was found here that separates them.",
)
LONGER = replace(
    VERDICTS["insufficient_data"], advice="Record longer logs, as the first sentence says, and diagnose again."
)
NOT_IN_MUJOCO = (
    f"Train with the corrected simulator: effects.yaml (docs/own_robot.md shows its use in Python). {MODEL} lacks "
    "a part of it, which the warnings name."
)
UNSOUGHT = replace(
    ALIKE,
    advice=f"Randomise over all explanations, or log another motion: {WHOLE} proposes one that separates them.",
)
EITHER = replace(
    VERDICTS["parameters"],
    advice="Measure a part, such as a link's mass, and state it with --accuracy. Then diagnose again. Until then, "
    "randomise widely: effects.yaml holds one of the explanations.",
)
TIME_STEP = replace(
    VERDICTS["no_gap"],
    advice=f"Train with the integrator and the time step of the diagnosis: {MODEL} has them. These logs need no "
    "effect.",
)
PARTLY = Verdict(
    "Partly explained",
    "The named effects leave more of the gap than the tolerance.",
    f"Train with effects.yaml for the effects found. {BELOW}. Write its cause as "
    "an effect of your own (--effects file.py:Name), or allow more with --tolerance.",
)
LITTLE = Verdict(
    Title.UNEXPLAINED.words,
    VERDICTS["unexplained"].headline,
    "Check the map and the logs first (bayessim-mjx logs check): signs, units, times and exchanged columns. Do not "
    f"train with the effects: they close less than half of the gap. {BELOW}.",
)
REMAINDER = Verdict(
    "Effects and a remainder",
    "The named effects explain most of the gap; more than the tolerance remains.",
    "Train with effects.yaml. The laws are not quite those of the real system: allow the rest with --tolerance, or "
    "write a law of your own (--effects file.py:Name).",
)


def verdict_of(d: Diagnosis) -> Verdict:
    """Return the verdict's words; a remainder beside named effects has its own."""
    if d.verdict == "effects" and d.gap.beyond:
        return REMAINDER
    if d.verdict == "ambiguous" and d.next_experiment.get("name", "none") == "none":
        return ALIKE if d.next_experiment else UNSOUGHT
    if d.verdict == "insufficient_data" and not d.warnings:
        return LONGER
    if d.verdict == "no_gap" and time_step(d):
        return TIME_STEP
    if d.verdict == "parameters" and stand_ins(d.parameters):
        return EITHER
    if d.verdict == "effects" and lacks(d):
        return replace(VERDICTS["effects"], advice=NOT_IN_MUJOCO)
    found = PARTLY if d.verdict == "unexplained" and d.effects and d.gap.beyond else VERDICTS[d.verdict]
    found = LITTLE if little(d) else found
    looked = d.where or d.next_experiment  # the stages that a short diagnosis leaves out
    return found if looked else replace(found, advice=found.advice.replace(BELOW, NOT_BELOW))


def time_step(d: Diagnosis) -> bool:
    """Whether the time step of the delivered simulator makes most of its squared gap."""
    return bool(d.gap.integrator.get("share", 0.0) > 0.5)


def little(d: Diagnosis) -> bool:
    """Whether effects are named that close less than half of the gap, and so do not explain it."""
    if d.verdict != "unexplained" or not d.effects:
        return False
    gap = of_rms(d.gap.calibrated, d.gap.with_effects)
    return gap.closed < gap.left


def lacks(d: Diagnosis) -> bool:
    """Whether the corrected model for plain MuJoCo lacks a part of the corrected simulator, or is not there."""
    return any(text.startswith(f"{MODEL} ") for text in d.warnings)


def headline(d: Diagnosis) -> str:
    """Return the first sentence, or the verdict's own."""
    return d.sentences[0] if d.sentences else verdict_of(d).headline


def command(d: Diagnosis, folder: str | Path) -> str:
    """Return a command to paste: train or view the corrected simulator, or the next diagnosis; "" if there is none."""
    model, data = str(d.about.get("model") or ""), [str(x) for x in d.about.get("data") or []]
    if not model or not data:
        return ""
    task, out = not model.endswith((".xml", ".mjcf")), Path(folder)
    said = ["bayessim-mjx"]
    if d.verdict == "insufficient_data" or little(d):
        said += ["logs", "check", data[0], *([] if task else ["--model", model])]
    elif d.next_experiment.get("file") and d.verdict in ("ambiguous", "unexplained"):
        again = [*data, str(out.with_name("new_logs")), "--out", str(out.with_name(f"{out.name}_2"))]
        said += ["diagnose", "--task" if task else "--model", model, "--data", *again]
    elif d.verdict == "unexplained" and not d.effects:
        return ""
    elif task:
        corrected = [] if d.verdict == "no_gap" else [f"effects={out / 'effects.yaml'}"]
        said += ["train", "--task", model, *corrected]
    elif lacks(d):
        return ""
    else:
        shown = model if d.verdict == "no_gap" and not time_step(d) else out / MODEL
        said = ["python", "-m", "mujoco.viewer", f"--mjcf={shown}"]
    return shlex.join(said)


def purpose(pasted: str) -> str:
    """Return what a command to paste is for: a viewer trains nothing."""
    return "view it" if "mujoco.viewer" in pasted else "next"


# The next experiment in words: its motion, what it separates or measures better, and what else would help


def known_payload(mass: float, place: str) -> tuple[str, str]:
    """(addition to an experiment's name, instruction for a person)."""
    return (
        f"with a known payload of {mass:g} kg on {place}",
        f"a person: fix a known mass of {mass:g} kg at the centre of {place}",
    )


def other_mount(way: str) -> tuple[str, str]:
    """Return the same of a base that is mounted another way."""
    return f"base {way}", f"a person: mount the base {way}"


def separating(effects: Iterable[str]) -> str:
    """Other experiments that separate effects, in their own words."""
    known = [f"{e.replace('_', ' ')}: {how}" for e in dict.fromkeys(effects) if (how := words(e).separates)]
    return "; ".join(known) or "a known payload, two mount orientations, or a measured effort"


def nats(evidence: float) -> str:
    """Ten or more as a whole number."""
    return f"{evidence:.0f}" if evidence >= 10 else f"{evidence:.1f}"


def nothing_safe(help: str) -> str:
    """Of a menu without a safe experiment; `help`: of `separating`."""
    return f"no experiment of the menu stays within the limits; these would help: {help}"


def run_experiment(name: str, seconds: float) -> str:
    """`run a chirp on hinge for 10 s`."""
    article = "a " if name.startswith(("slow triangle", "staircase", "chirp", "multisine")) else ""
    return f"run {article}{name} for {seconds:.0f} s"


def sharpens(action: str, parameter: str, before: float, after: float) -> str:
    """Return the gain in accuracy of a parameter, where no rival is left, as a ratio."""
    return f"{action}: it should divide the standard deviation of {parameter} by {before / after:.2g}"


def sharpens_little(best: str, parameter: str, before: float, after: float, allowed: float = 0.0) -> str:
    """Say that no experiment helps.

    Args:
        best: name of the best one, with the parameter that it measures best.
        allowed: share of the standard deviation that allows for other simulators.
    """
    if 2 * allowed**2 > 1:  # most of the variance
        share = percent(allowed)
        return f"no experiment sharpens {parameter}: {share} of its standard deviation allows for other simulators"
    left = percent(after / before)
    return (
        f"no experiment of the menu adds much; the best, {best}, leaves {left} of the standard deviation of {parameter}"
    )


def separates_nobody(labels: Sequence[str], best: str, evidence: float, help: str) -> str:
    """Why an experiment does not help, of models' titles, its name and the nats that it would give."""
    most = f"the best, {best}, is expected to give {nats(evidence)} nats"
    return f"no safe excitation separates {_apart(labels)} ({most}); these would: {help}"


def tells_apart(action: str, labels: Sequence[str], evidence: float, contested: bool, decides: float) -> str:
    """Name the models that an experiment separates; contested: whether the logs left it open; decides: nats that do."""
    times = math.ceil(decides / max(evidence, 1e-9))
    again = f"; repeat it {times} times for a decision" if 1 < times <= decides else ""
    whom = f"separates {_apart(labels)}" if contested else f"confirms {_apart(labels, 'against')}"
    return f"{action}: {whom}, expected evidence {nats(evidence)} nats{again}"


def _apart(labels: Sequence[str], word: str = "from") -> str:
    return f"{labels[0]} {word} {', or '.join(labels[1:])}"  # labels may hold an "and"
