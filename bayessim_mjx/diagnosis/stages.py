"""The stages after the selection: one after the other, and side by side what does not need each other."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from types import MappingProxyType

from bayessim_mjx.diagnosis.findings import Findings, Progress
from bayessim_mjx.diagnosis.selection.budget import Budget


@dataclass(frozen=True)
class Stage:
    """One stage: its name, told while it runs; `run(findings, say) -> findings`.

    Attributes:
        optional: its failure becomes a warning, as the verdict stands without it.
        patient: left out once the time is over.
        beside: it needs nothing of others that are so, and adds nothing but its part: they go on together, as each
            compiles a small program of its own, which leaves cores free.
    """

    name: str
    run: Callable[[Findings, Progress], Findings]
    optional: bool = False
    patient: bool = False
    beside: bool = False


def carry_out(
    stages: Sequence[Stage],
    found: Findings,
    say: Progress,
    time_left: Budget,
    verdict: Callable[[Findings], None] | None = None,
) -> Findings:
    """The findings with those of all stages; verdict: called with them once no stage is left that is not optional.

    Under a limit of time they go one after the other: each is left out if the time is over when its turn comes.
    """
    beside = [] if time_left.limited else [s for s in stages if s.beside]
    alone = [s for s in stages if s not in beside]
    for stage in (s for s in alone if not s.optional):
        found = _in_time(stage, found, say, time_left)
    found = _together(beside, found, say, verdict) if beside else _told(found, verdict)
    for stage in (s for s in alone if s.optional):
        found = _in_time(stage, found, say, time_left)
    return found


def _told(found: Findings, verdict: Callable[[Findings], None] | None) -> Findings:
    if verdict is not None:
        verdict(found)
    return found


def _together(
    stages: Sequence[Stage], found: Findings, say: Progress, verdict: Callable[[Findings], None] | None
) -> Findings:
    """Each on a thread: what they compile and simulate is outside of Python's lock."""
    name = ", ".join(s.name for s in stages)
    done: list[Stage] = []

    def one(stage: Stage) -> Findings:
        after = _after(stage, found, lambda text, done, total: None)
        done.append(stage)
        say(name, len(done), len(stages))
        return after

    say(name, 0, len(stages))
    with ThreadPoolExecutor(len(stages)) as pool:
        running = {stage.name: pool.submit(one, stage) for stage in stages}
        needed = [running[s.name] for s in stages if not s.optional]
        _told(_joined(found, needed), verdict)
    return _joined(found, running.values())


def _joined(found: Findings, running: Iterable[Future[Findings]]) -> Findings:
    """With the parts and warnings of stages that began with `found`."""
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
        # the verdict is there: a picture or proposal less must not lose it
        lost = f"{stage.name}: not available ({type(error).__name__}: {error})"
        return replace(found, warnings=(*found.warnings, lost))
