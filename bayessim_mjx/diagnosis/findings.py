"""All that a diagnosis computed, before it is put into words."""

from __future__ import annotations

from dataclasses import dataclass

from bayessim_mjx.diagnosis.logcheck import channels
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance
from bayessim_mjx.diagnosis.residual.flexible import Flexible
from bayessim_mjx.diagnosis.selection import heldout, search, verdict
from bayessim_mjx.diagnosis.selection.weak_directions import Ridges
from bayessim_mjx.diagnosis.setup import Setup


@dataclass(frozen=True, eq=False)
class Findings:
    """All that was computed; `report_of` (see `assemble`) turns it into a Diagnosis."""

    setup: Setup
    race: search.Race
    ruling: verdict.Ruling
    predictions: dict[str, heldout.Prediction]
    flexible_base: Flexible | None
    flexible_winner: Flexible | None
    disturbance: Disturbance | None
    links: list[channels.Link]
    weak_directions: Ridges | None = None
