"""All that a diagnosis computed, before it is put into words. Frozen: a stage gives new findings with one part more."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, TypeVar

from bayessim_mjx.diagnosis.logcheck.links import Link
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance
from bayessim_mjx.diagnosis.residual.flexible import Flexible
from bayessim_mjx.diagnosis.residual.frequency import Heard
from bayessim_mjx.diagnosis.residual.where import Located
from bayessim_mjx.diagnosis.selection.heldout import Prediction
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.selected import Selection
from bayessim_mjx.diagnosis.setup import Setup

Progress = Callable[[str, int, int], None]  # (what is being done, done, total)
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Where:
    """Where the gap lies: joints, regions of the state, signatures; and what spectra of the missing force show."""

    found: Located
    spectra: tuple[Heard, ...]


@dataclass(frozen=True, eq=False)
class Findings:
    """What is known so far; `assemble.diagnosis_of` turns it into a Diagnosis.

    Attributes:
        setup, selection: what was fixed before any fit, and what the selection came to.
        predictions: {"nominal", "calibrated", "with_effects": held-out motion}.
        disturbance: the force that the recalibrated simulator lacks; None where its gap is the noise.
        flexible_base, flexible_winner: a flexible force on the recalibrated simulator, on top of the effects.
        links: of the first log's channels to each other.
        parts: what further stages found, one frozen object each, by its class.
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
        """The model of the verdict: the known parameters with the effects that are named."""
        return self.selection.answer

    def having(self, part: Any) -> Findings:
        """With what one more stage found."""
        return replace(self, parts=MappingProxyType({**self.parts, type(part): part}))

    def part(self, kind: type[T]) -> T | None:
        """What the stage found whose part is of this class; None where it did not run or found nothing."""
        return self.parts.get(kind)
