"""The first words on a verdict: badge, headline, what to do next, and a command to paste."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path

from bayessim_mjx.diagnosis.result import Diagnosis
from bayessim_mjx.diagnosis.result import Verdict as Title

MODEL = "model_with_effects.xml"


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
        "See below where a force is missing, and write its cause as an effect of your own (--effects file.py:Name).",
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
NOT_IN_MUJOCO = (
    f"Train with the corrected simulator: effects.yaml (docs/own_robot.md shows its use in Python). {MODEL} lacks "
    "a part of it, which the warnings name."
)
UNSOUGHT = replace(
    ALIKE,
    advice="Randomise over all explanations, or log another motion: a diagnosis without --quick, --minutes and "
    "--verdict_only proposes one that separates them.",
)
PARTLY = Verdict(
    "Partly explained",
    "The named effects leave more of the gap than the tolerance.",
    "Train with effects.yaml for the effects found. See below where a force is missing. Write its cause as "
    "an effect of your own (--effects file.py:Name), or allow more with --tolerance.",
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
    if d.verdict == "effects" and lacks(d):
        return replace(VERDICTS["effects"], advice=NOT_IN_MUJOCO)
    return PARTLY if d.verdict == "unexplained" and d.effects and d.gap.beyond else VERDICTS[d.verdict]


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
    if d.verdict == "insufficient_data":
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
        shown = model if d.verdict == "no_gap" else out / MODEL
        said = ["python", "-m", "mujoco.viewer", f"--mjcf={shown}"]
    return shlex.join(said)
