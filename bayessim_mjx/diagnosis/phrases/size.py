"""The gap of each stage in one line: over windows, over whole logs, and whether recalibration reduces it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayessim_mjx.diagnosis.phrases.advice import little
from bayessim_mjx.diagnosis.phrases.verdict import number, stage
from bayessim_mjx.diagnosis.result import Diagnosis
from bayessim_mjx.diagnosis.statistics import of_one
from bayessim_mjx.quantities import extent, finite, percent

NO_HELP = "Recalibration does not reduce the gap of these held-out windows."
QUIET = "Before and after recalibration the gap is within the noise."


def gap_line(d: Diagnosis) -> str:
    """Return the three gap numbers on one line of the terminal (the page has tiles, `report.sections`)."""
    known = [f"{stage(d.gap, s)} {words}" for s, words in _stages(d).items() if finite(getattr(d.gap, s))]
    over = f" over {d.basis['window']:.2g} s" if d.basis.get("window") else ""
    return " ".join([f"Gap{over}: {', '.join(known)}.", *_beside(d)]) if known else ""


def below_tiles(d: Diagnosis) -> str:
    """Return the time over which the tiles' numbers are taken, and the numbers over whole logs."""
    over = [f"These gaps are of windows of {d.basis['window']:.2g} s."] if d.basis.get("window") else []
    return " ".join([*over, *_beside(d)])


def no_help(d: Diagnosis) -> str:
    """Say where recalibration does not reduce the gap of motion that its fit had not seen."""
    far = d.gap
    if not (finite(far.nominal) and finite(far.calibrated) and far.calibrated > far.nominal):
        return ""
    return QUIET if of_one(far.calibrated**2).at_noise else NO_HELP


def with_effects(d: Diagnosis) -> str:
    """Name the stage with the effects: in a headline that names none they are the nearest ones."""
    near = little(d) or (d.verdict == "unexplained" and not d.gap.beyond)
    return "with the nearest effects" if near else "with the effects"


def _stages(d: Diagnosis) -> dict[str, str]:
    words = {"nominal": "as delivered", "calibrated": "recalibrated"}
    return words | ({"with_effects": with_effects(d)} if d.effects else {})


def _beside(d: Diagnosis) -> list[str]:
    """Return the sentences that stand beside the three numbers."""
    row: Mapping[str, Any] = next((h for h in d.gap.horizons if "over_likely" in h), {})  # whole logs, or parts
    sizes = [f"{size} {words}" for s, words in _stages(d).items() if (size := _whole(row, s))]
    over = "whole logs" if row.get("name") == "whole log" else f"simulations of {row.get('name')}"
    return [text for text in (f"Over {over}: {', '.join(sizes)}." if sizes else "", no_help(d)) if text]


def _whole(row: Mapping[str, Any], name: str) -> str:
    """`7.9 deg`, of several joints `2.1 % of the motion`; in noise where neither is known."""
    joints, shares = row.get("physical") or {}, row.get("shares") or {}
    if len(joints) == 1:
        (own,) = joints.values()
        return extent(own[name], own["unit"]) if finite(own.get(name)) else ""
    if finite(shares.get(name)):
        return f"{percent(shares[name])} of the motion"
    return f"{number(row[name])} noise sd" if finite(row.get(name)) else ""
