"""The verdict in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bayessim_mjx.diagnosis.nouns import listed, missing
from bayessim_mjx.diagnosis.result import FoundEffect, Gap
from bayessim_mjx.diagnosis.run import Findings
from bayessim_mjx.diagnosis.verdict import Rival

CLEAR = 1.2  # noise variances above which a horizon's gap is worth a share
HEADS = {
    "no_gap": "No gap above the noise: the simulator is within {nominal} noise standard deviations of the logs.",
    "parameters": "The parameters are off, the structure is right: recalibrated, the gap falls from {nominal} to "
    "{calibrated} noise standard deviations.",
    "effects": "The simulator lacks {named}.",
    "ambiguous": "The simulator lacks something like {named}, but these logs fit other explanations as well.",
    "unexplained": "Something is missing that no effect of the library explains.",
}
NEAREST = "Of the library, {named} {come} nearest; "
BEATEN = "a flexible force alone predicts held-out conditions far better."
ON_TOP = "a flexible force on top of {them} still closes {remains} of the gap."
FALLS = (
    "With {them} the gap falls from {calibrated} (recalibrated) to {with_effects} noise standard deviations on "
    "held-out conditions. Of the squared gap above the noise {predicted} was promised to go before {they} added, and "
    "{realised} went."
)
CHANCE = (
    "What remains ({calibrated} noise standard deviations) no candidate and no flexible force predicts on held-out "
    "conditions: process noise, an input that was not logged, or noise larger than estimated."
)


def sentences(
    name: str, effects: list[FoundEffect], parameters: dict[str, dict[str, Any]], found: Findings, remains: float
) -> list[str]:
    """The verdict, most important first."""
    steps = found.setup.fitter.simulator.windows.steps
    level = {k: float(np.sqrt(p.cost(steps).mean())) for k, p in found.predictions.items()}
    told = verdict_in_words(name, effects, level, remains)
    if name == "ambiguous":
        told += [_instead(e, found.ruling.rivals.get(f"{e.name}@{e.where}", [])) for e in effects]
    if not effects and remains == 0.0 and found.race.above_noise(found.race.base):
        told.append(CHANCE.format(calibrated=number(level["calibrated"])))
    if name == "unexplained" and found.flexible_winner is not None:
        told += [f"{text[:1].upper()}{text[1:]}." for text in found.flexible_winner.text]
    told += [f"{k} {v['structural']}." for k, v in parameters.items() if v["structural"]]
    return [text for text in told if text]


def verdict_in_words(name: str, effects: list[FoundEffect], level: dict[str, float], remains: float) -> list[str]:
    """Verdict and how far; level: {stage: root mean square in noise standard deviations}."""
    promised, went = (sum(getattr(e, k) for e in effects) for k in ("predicted_gap_closed", "gap_closed"))
    fill = {k: number(v) for k, v in level.items()} | {
        "named": listed([missing(e.name, e.where) for e in effects]),
        "them": "it" if len(effects) == 1 else "them",
        "they": "it was" if len(effects) == 1 else "they were",
        "come": "comes" if len(effects) == 1 else "come",
        "remains": f"{remains:.0%}",
        "predicted": f"{promised:.0%}",
        "realised": f"{went:.0%}",
    }
    out = [HEADS[name]]
    if effects:
        out += [NEAREST + (ON_TOP if remains > 0.05 else BEATEN)] if name == "unexplained" else []
        out.append(FALLS)
    return [text.format(**fill) for text in out]


def number(value: float) -> str:
    """Three digits, in plain notation."""
    return f"{value:.2f}" if value < 9.995 else f"{value:.1f}" if value < 99.95 else f"{value:.0f}"


def _instead(effect: FoundEffect, rivals: Sequence[Rival]) -> str:
    """What else it could be."""
    others = [listed([missing(c.effect, c.where) for c in r.effects]) for r in rivals if not r.contains][:4]
    return f"Instead of {missing(effect.name, effect.where)} it could be {listed(others, 'or')}." if others else ""


def horizon_warning(gap: Gap) -> list[str]:
    """A verdict that changes with the horizon is flagged."""
    closed = {
        row["name"]: (row["calibrated"] ** 2 - row["with_effects"] ** 2) / (row["calibrated"] ** 2 - 1.0)
        for row in gap.horizons
        if row["calibrated"] ** 2 > CLEAR
    }
    if len(closed) < 2 or max(closed.values()) - min(closed.values()) < 0.3:
        return []
    shares = ", ".join(f"{share:.0%} ({name})" for name, share in closed.items())
    return [f"the gap closed depends on the horizon: {shares}"]
