"""The verdict in words."""

from __future__ import annotations

from typing import Any

import numpy as np

from bayessim_mjx.diagnosis.result import FoundEffect, Gap
from bayessim_mjx.diagnosis.run import Findings

CLEAR = 1.2  # noise variances above which a horizon's gap is worth a share
HEADS = {
    "no_gap": "No gap above the noise: the simulator is within {nominal:.2g} noise standard deviations of the logs.",
    "parameters": "The parameters are off, the structure is right: recalibrated, the gap falls from {nominal:.3g} to "
    "{calibrated:.3g} noise standard deviations.",
    "effects": "The simulator lacks {named}.",
    "ambiguous": "The simulator lacks something like {named}; these logs cannot tell it from its rivals.",
    "unexplained": "Something is missing that no effect of the library explains.",
}
NEAREST = "Of the library {named} comes nearest; a flexible force on top of it still closes {remains:.0%} of the gap."
FALLS = (
    "With it the gap falls from {calibrated:.3g} (recalibrated) to {with_effects:.3g} noise standard deviations on "
    "held-out conditions."
)
CHANCE = (
    "What remains ({calibrated:.3g}) no candidate and no flexible force predicts on held-out conditions: process "
    "noise, an input that was not logged, or noise larger than estimated."
)


def sentences(
    name: str, effects: list[FoundEffect], parameters: dict[str, dict[str, Any]], found: Findings, remains: float
) -> list[str]:
    """The verdict, most important first."""
    steps = found.setup.fitter.simulator.windows.steps
    fill: dict[str, Any] = {k: float(np.sqrt(p.cost(steps).mean())) for k, p in found.predictions.items()}
    fill |= {"remains": remains, "named": " and ".join(f"{e.name.replace('_', ' ')} at {e.where}" for e in effects)}
    out = [HEADS[name]]
    if effects:
        out += [NEAREST, FALLS] if name == "unexplained" else [FALLS]
    if not effects and remains == 0.0 and found.race.above_noise(found.race.base):
        out.append(CHANCE)
    out = [text.format(**fill) for text in out]
    if name == "unexplained" and found.flexible_winner is not None:
        out += found.flexible_winner.text
    return out + [f"{k}: {v['structural']}." for k, v in parameters.items() if v["structural"]]


def horizon_warning(gap: Gap) -> list[str]:
    """A verdict that changes with the horizon is flagged."""
    closed = {
        row["name"]: (row["calibrated"] ** 2 - row["with_effects"] ** 2) / (row["calibrated"] ** 2 - 1.0)
        for row in gap.horizons
        if row["calibrated"] ** 2 > CLEAR
    }
    if len(closed) < 2 or max(closed.values()) - min(closed.values()) < 0.3:
        return []
    shares = ", ".join(f"{share:.0%} over {name}" for name, share in closed.items())
    return [f"the gap closed depends on the horizon: {shares}"]
