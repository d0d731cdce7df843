"""All that a diagnosis computed, before it is put into words, and who observes it while it runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, TypeVar

from bayessim_mjx.diagnosis.evidence.selecting import Selection
from bayessim_mjx.diagnosis.logcheck.links import Link
from bayessim_mjx.diagnosis.residual.black_boxes import Flexible
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance
from bayessim_mjx.diagnosis.residual.frequency import Heard
from bayessim_mjx.diagnosis.residual.where import Located
from bayessim_mjx.diagnosis.selection.heldout import Prediction
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.search_state import SearchState
from bayessim_mjx.diagnosis.setup import Setup

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Where:
    """Where the gap lies: joints, regions of the state, signatures, and spectra of the missing force."""

    found: Located
    spectra: tuple[Heard, ...]


@dataclass(frozen=True, eq=False)
class Findings:
    """All results so far; frozen: a stage returns new findings. `assemble.diagnosis_of` makes a Diagnosis of them.

    Attributes:
        setup, selection: everything fixed before any fit, and the result of the search.
        predictions: {"nominal", "calibrated", "with_effects": held-out motion}.
        disturbance: the force that the recalibrated simulator lacks; None where its gap is the noise.
        flexible_base, flexible_winner: a flexible force on the recalibrated simulator, on top of the effects.
        links: of the first log's channels to each other.
        parts: results of further stages, one frozen object each, by its class.
        warnings: of stages that failed.
    """

    setup: Setup
    selection: Selection
    predictions: Mapping[str, Prediction] = field(default_factory=lambda: MappingProxyType({}))
    disturbance: Disturbance | None = None
    flexible_base: Flexible | None = None
    flexible_winner: Flexible | None = None
    links: tuple[Link, ...] = ()
    parts: Mapping[type, Any] = field(default_factory=lambda: MappingProxyType({}))
    warnings: tuple[str, ...] = ()

    @property
    def model(self) -> Model:
        """The model of the verdict: the known parameters and the named effects."""
        return self.selection.answer

    def having(self, part: Any) -> Findings:
        """The findings with the result of one more stage."""
        return replace(self, parts=MappingProxyType({**self.parts, type(part): part}))

    def part(self, kind: type[T]) -> T | None:
        """The result of the stage whose part has this class; None if it did not run or found nothing."""
        return self.parts.get(kind)


class Observer:
    """What a diagnosis calls while it runs; every method does nothing unless a subclass overrides it."""

    def progress(self, text: str, done: int, total: int) -> None:
        """Called when a part begins and while it goes on: what is being done, and how much of it is done."""

    def early(self, lines: Sequence[str]) -> None:
        """Called with what the logs show before any simulation, in lines."""

    def known(self, setup: Setup, state: SearchState | None) -> None:
        """Called before the search (None), and after each part of it with what was fitted so far."""

    def verdict(self, found: Findings) -> None:
        """Called with the findings before the optional stages."""
