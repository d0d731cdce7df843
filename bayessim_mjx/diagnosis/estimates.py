"""Identified numbers and effects, as a diagnosis tells and corrects them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Estimate:
    """One identified number.

    bound: "" where it lies inside its range; "at least" or "at most" (nothing larger or smaller was tried), "end" (of
    what physics allows, or of what the logs tell), "off" (it has no part in the effect). At a bound, but for "off", sd
    is NaN: an interval around the end of a range says nothing.
    """

    mean: float
    sd: float
    unit: str = ""
    bound: str = ""


@dataclass(frozen=True)
class FoundEffect:
    """An effect that reality has and the simulator has not.

    Attributes:
        name, where: of the library, of the model.
        parameters: {parameter: Estimate}.
        weight_among_rivals: probability of this effect beside `equivalent_to`, 1 together. What is there may be none
            of them. NaN where there is no rival.
        gap_closed, gap_closed_ci: its part of what all effects close, as a share of the recalibrated simulator's
            squared gap above the noise, on held-out windows, with a 90 % interval (NaN of one condition).
        equivalent_to: [{"effects": ["payload@link", ...], "gap_closed": ..., "why": sentence, "weight": probability
            among the rivals}], which these logs cannot tell from it; of an effect that contains it as a special case,
            no weight.
        shared: {"effects": labels, "mean", "low", "high", "unit", "quantities"}: how large it is, whichever of these
            effects it is (mixture of their posteriors by probability, 90 % interval); {} where they share no unit.
        sentence: for people; predicted_gap_closed: the same share as promised before any effect was fitted.
        share: of the gap closed by all effects together (Shapley).
    """

    name: str
    where: str
    parameters: dict[str, Estimate]
    weight_among_rivals: float
    gap_closed: float
    gap_closed_ci: tuple[float, float]
    equivalent_to: list[dict[str, Any]] = field(default_factory=list)
    sentence: str = ""
    predicted_gap_closed: float = math.nan
    share: float = math.nan
    shared: dict[str, Any] = field(default_factory=dict)
