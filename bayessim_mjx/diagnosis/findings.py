"""All that a diagnosis computed, before it is put into words; its stages, and who observes it while it runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, TypeVar

from bayessim_mjx.diagnosis.evidence.selecting import Selection
from bayessim_mjx.diagnosis.logcheck.links import Link
from bayessim_mjx.diagnosis.phrases import notes
from bayessim_mjx.diagnosis.residual.black_boxes import Flexible
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance
from bayessim_mjx.diagnosis.residual.frequency import Heard
from bayessim_mjx.diagnosis.residual.where import Located
from bayessim_mjx.diagnosis.selection.heldout import Prediction
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.numbers import Budget, Progress
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
        """Return the findings with the result of one more stage."""
        return replace(self, parts=MappingProxyType({**self.parts, type(part): part}))

    def part(self, kind: type[T]) -> T | None:
        """Return the result of the stage whose part has this class; None if it did not run or found nothing."""
        return self.parts.get(kind)


class Observer:
    """What a diagnosis calls while it runs; every method does nothing unless a subclass overrides it."""

    def progress(self, text: str, done: int, total: int) -> None:
        """Take the name of a part, when it begins and while it goes on, and how much of it is done."""

    def note(self, text: str) -> None:
        """Take a warning that is known before the search."""

    def early(self, lines: Sequence[str]) -> None:
        """Take what the logs show before any simulation, in lines."""

    def known(self, setup: Setup, state: SearchState | None) -> None:
        """Take what was fitted so far: before the search (None) and after each part of it."""

    def verdict(self, found: Findings) -> None:
        """Take the findings before the optional stages."""


@dataclass(frozen=True)
class Stage:
    """One stage: its name, which is shown while it runs, and `run(findings, say) -> findings`.

    Attributes:
        optional: the verdict does not need it; its failure becomes a warning.
        patient: it is left out if the time is over.
        beside: it needs no result of other such stages, and adds only its own part. Such stages run together, as each
            compiles a small program, which leaves cores free.
    """

    name: str
    run: Callable[[Findings, Progress], Findings]
    optional: bool = False
    patient: bool = False
    beside: bool = False

    def after(self, found: Findings, say: Progress, time_left: Budget = Budget()) -> Findings:  # noqa: B008  # immutable
        """Return the findings after this stage; without it and with a note where it failed or the time was over.

        The verdict stands: a missing picture or proposal must not lose it.
        """
        if (self.patient or self.optional) and time_left.late:
            return replace(found, warnings=notes.out_of_time(found.warnings, self.name))
        try:
            return self.run(found, say)
        except Exception as error:
            if not self.optional:
                raise
            return replace(found, warnings=(*found.warnings, notes.failed(self.name, error)))


def carry_out(stages: Sequence[Stage], found: Findings, time_left: Budget, observer: Observer) -> Findings:
    """Run all stages; the observer gets the verdict once all stages that are not optional have run.

    Under a limit of time they run one after the other, and a stage is left out if the time is over at its turn.
    """
    beside = [] if time_left.limited else [s for s in stages if s.beside]
    alone = [s for s in stages if s not in beside]
    for stage in (s for s in alone if not s.optional):
        observer.progress(stage.name, 0, 1)
        found = stage.after(found, observer.progress, time_left)
    if beside:
        found = _together(beside, found, observer)
    else:
        observer.verdict(found)
    for stage in (s for s in alone if s.optional):
        observer.progress(stage.name, 0, 1)
        found = stage.after(found, observer.progress, time_left)
    return found


BESIDE = "checking and locating the answer"  # what stages do that run together


def _together(stages: Sequence[Stage], found: Findings, observer: Observer) -> Findings:
    """Run each stage on a thread: compilation and simulation release Python's lock."""
    done: list[Stage] = []

    def one(stage: Stage) -> Findings:
        after = stage.after(found, lambda text, done, total: None)
        done.append(stage)
        observer.progress(BESIDE, len(done), len(stages))
        return after

    observer.progress(BESIDE, 0, len(stages))
    with ThreadPoolExecutor(len(stages)) as pool:
        running = {stage.name: pool.submit(one, stage) for stage in stages}
        needed = [running[s.name] for s in stages if not s.optional]
        observer.verdict(_joined(found, needed))
    return _joined(found, running.values())


def _joined(found: Findings, running: Iterable[Future[Findings]]) -> Findings:
    """Return the findings with the parts and warnings of stages that began with `found`."""
    each = [future.result() for future in running]
    parts = {kind: part for after in each for kind, part in after.parts.items()}
    warnings = [text for after in each for text in after.warnings[len(found.warnings) :]]
    both = {**found.parts, **parts}
    return replace(found, parts=MappingProxyType(both), warnings=(*found.warnings, *warnings))
