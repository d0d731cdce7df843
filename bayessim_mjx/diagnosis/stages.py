"""The stages after the selection: one after the other, and side by side where none needs another's result."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import MappingProxyType

from bayessim_mjx.diagnosis.experiment import propose
from bayessim_mjx.diagnosis.findings import Findings, Observer, Where
from bayessim_mjx.diagnosis.logcheck.links import links as links_of
from bayessim_mjx.diagnosis.residual import black_boxes, frequency, where
from bayessim_mjx.diagnosis.residual.black_boxes import Flexible, flexible
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance, estimate
from bayessim_mjx.diagnosis.selection import heldout
from bayessim_mjx.diagnosis.selection.budget import Budget, Progress
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.summary import finer_steps, whole_logs


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


def how_far(found: Findings, say: Progress) -> Findings:
    """Add the held-out motion of the simulator as delivered, recalibrated and with the effects."""
    fitter, base, model = found.setup.fitter, found.selection.state.base, found.model
    predictions = {
        "nominal": heldout.nominal(fitter, found.selection.state.nominal),
        "calibrated": heldout.predict(fitter, base),
    }
    predictions["with_effects"] = heldout.predict(fitter, model) if model.effects else predictions["calibrated"]
    return replace(found, predictions=MappingProxyType(predictions))


def none_of_these(found: Findings, say: Progress) -> Findings:
    """Add the missing force, a flexible force fitted to it, and the checks of the links of the actuator chain."""
    base, model, setup = found.selection.state.base, found.model, found.setup
    missing = estimate(setup.fitter, base.fit) if found.selection.state.above_noise(base) else None
    on_base = _flexible(found, base, missing)
    on_winner = _flexible(found, model) if model.effects else on_base
    links = tuple(link for log in setup.logs[:1] for link in links_of(log, setup.robot.mj_model, setup.gate.timing))
    return replace(found, disturbance=missing, flexible_base=on_base, flexible_winner=on_winner, links=links)


def _flexible(found: Findings, model: Model, missing: Disturbance | None = None) -> Flexible | None:
    """A flexible force on top of a model; None if the model leaves no more than noise."""
    if not found.selection.state.above_noise(model):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return flexible(found.setup.fitter, model.fit, missing.linear if missing else None)


def where_it_lies(found: Findings, say: Progress) -> Findings:
    """Add the places of the recalibrated simulator's gap, maps of the missing force and its spectra."""
    if found.disturbance is None:
        return found
    fitter, fit = found.setup.fitter, found.selection.state.base.fit
    located = where.locate(fitter, fit, found.disturbance)
    return found.having(Where(located, frequency.analyse(fitter, fit, found.disturbance)))


def rivals_without_physics(found: Findings, say: Progress) -> Findings:
    """Add the shares of the gap that a network and a formula close, beside those of the named effects."""
    if found.disturbance is None:
        return found
    state, named = found.selection.state, found.model.fit if found.model.effects else None
    boxes = black_boxes.race(found.setup.fitter, state.base.fit, named, found.disturbance.linear, state.noise)
    return found if boxes is None else found.having(boxes)


STAGES = (
    Stage("how far", how_far),
    Stage("none of these?", none_of_these),
    Stage("finer steps", finer_steps.stage, patient=True, beside=True),
    Stage("whole logs", whole_logs.stage, patient=True, beside=True),
    Stage("where", where_it_lies, optional=True, beside=True),
    Stage("black boxes", rivals_without_physics, optional=True, beside=True),
    Stage("next experiment", propose.stage, optional=True, beside=True),
)


def carry_out(stages: Sequence[Stage], found: Findings, time_left: Budget, observer: Observer) -> Findings:
    """Run all stages; the observer gets the verdict once all stages that are not optional have run.

    Under a limit of time they run one after the other, and a stage is left out if the time is over at its turn.
    """
    beside = [] if time_left.limited else [s for s in stages if s.beside]
    alone = [s for s in stages if s not in beside]
    for stage in (s for s in alone if not s.optional):
        found = _in_time(stage, found, observer.progress, time_left)
    if beside:
        found = _together(beside, found, observer)
    else:
        observer.verdict(found)
    for stage in (s for s in alone if s.optional):
        found = _in_time(stage, found, observer.progress, time_left)
    return found


def _together(stages: Sequence[Stage], found: Findings, observer: Observer) -> Findings:
    """Run each stage on a thread: compilation and simulation release Python's lock."""
    name = ", ".join(s.name for s in stages)
    done: list[Stage] = []

    def one(stage: Stage) -> Findings:
        after = _after(stage, found, lambda text, done, total: None)
        done.append(stage)
        observer.progress(name, len(done), len(stages))
        return after

    observer.progress(name, 0, len(stages))
    with ThreadPoolExecutor(len(stages)) as pool:
        running = {stage.name: pool.submit(one, stage) for stage in stages}
        needed = [running[s.name] for s in stages if not s.optional]
        observer.verdict(_joined(found, needed))
    return _joined(found, running.values())


def _joined(found: Findings, running: Iterable[Future[Findings]]) -> Findings:
    """The findings with the parts and warnings of stages that began with `found`."""
    each = [future.result() for future in running]
    parts = {kind: part for after in each for kind, part in after.parts.items()}
    warnings = [text for after in each for text in after.warnings[len(found.warnings) :]]
    both = {**found.parts, **parts}
    return replace(found, parts=MappingProxyType(both), warnings=(*found.warnings, *warnings))


def _in_time(stage: Stage, found: Findings, say: Progress, time_left: Budget) -> Findings:
    if (stage.patient or stage.optional) and time_left.late:
        return replace(found, warnings=(*found.warnings, f"{stage.name}: left out, the time was over"))
    say(stage.name, 0, 1)
    return _after(stage, found, say)


def _after(stage: Stage, found: Findings, say: Progress) -> Findings:
    try:
        return stage.run(found, say)
    except Exception as error:
        if not stage.optional:
            raise
        # the verdict stands: a missing picture or proposal must not lose it
        lost = f"{stage.name}: not available ({type(error).__name__}: {error})"
        return replace(found, warnings=(*found.warnings, lost))
