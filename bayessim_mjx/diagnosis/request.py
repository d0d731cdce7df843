"""What a diagnosis is asked to do with a robot and its logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bayessim_mjx.diagnosis.selection.search_state import Settings
from bayessim_mjx.effects.effect import Effect

Effects = str | Sequence[str | type[Effect]]


@dataclass(frozen=True)
class Request:
    """What is to be diagnosed, beside the robot and the logs.

    Attributes:
        effects: "all", or names or classes of the effects that are tried.
        group: metadata key of the logs that names their operating condition; None: each log is one.
        seed: of all random numbers.
        settings: sizes of the search; None: by the robot's size.
        minutes: that the diagnosis may take; None: no limit.
        quick: a first answer from few windows, without the optional stages.
        verdict_only: without the optional stages.
        tolerances: errors that may stay unexplained, as the command's flag: "0.5deg", "elbow=2mm", "3%".
        notes: warnings from reading model and logs; they come first among the warnings.
        remember: folder for the fits of the search, from which an interrupted search continues; None: none is kept.
    """

    effects: Effects = "all"
    group: str | None = None
    seed: int = 0
    settings: Settings | None = None
    minutes: float | None = None
    quick: bool = False
    verdict_only: bool = False
    tolerances: Sequence[str] = ()
    notes: Sequence[str] = ()
    remember: Path | None = None
