"""The diagnosis from logs to result: what was logged, the selection, and the stages after it, one after the other."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import mujoco
from threadpoolctl import threadpool_limits

from bayessim_mjx.diagnosis import resumed
from bayessim_mjx.diagnosis.evidence import selecting
from bayessim_mjx.diagnosis.experiment import propose
from bayessim_mjx.diagnosis.findings import Findings, Progress, Where
from bayessim_mjx.diagnosis.fitting.cutting import TooLittleData
from bayessim_mjx.diagnosis.fitting.robot import Robot, Source, robot_of
from bayessim_mjx.diagnosis.logcheck.links import links as links_of
from bayessim_mjx.diagnosis.residual import black_boxes, frequency, where
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance, estimate
from bayessim_mjx.diagnosis.residual.flexible import Flexible, flexible
from bayessim_mjx.diagnosis.result import Diagnosis
from bayessim_mjx.diagnosis.selection import budget, heldout
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.tried import Settings, Tried
from bayessim_mjx.diagnosis.setup import Setup, prepare
from bayessim_mjx.diagnosis.stages import Stage, carry_out
from bayessim_mjx.diagnosis.summary import assemble, finer_steps, first_look, whole_logs
from bayessim_mjx.diagnosis.summary.files import Files
from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.logs import read_logs
from bayessim_mjx.logs.log import Log

Effects = str | Sequence[str | type[Effect]]


def how_far(found: Findings, say: Progress) -> Findings:
    """With the held-out motion of the simulator as delivered, recalibrated and with the effects."""
    fitter, base, model = found.setup.fitter, found.selection.base, found.model
    predictions = {
        "nominal": heldout.nominal(fitter, found.selection.nominal),
        "calibrated": heldout.predict(fitter, base),
    }
    predictions["with_effects"] = heldout.predict(fitter, model) if model.effects else predictions["calibrated"]
    return replace(found, predictions=MappingProxyType(predictions))


def none_of_these(found: Findings, say: Progress) -> Findings:
    """With the force that is missing, what a flexible force makes of it, and which links of the chain are sound."""
    base, model, setup = found.selection.base, found.model, found.setup
    missing = estimate(setup.fitter, base.fit) if found.selection.above_noise(base) else None
    on_base = _flexible(found, base, missing)
    on_winner = _flexible(found, model) if model.effects else on_base
    links = tuple(link for log in setup.logs[:1] for link in links_of(log, setup.robot.mj_model, setup.gate.timing))
    return replace(found, disturbance=missing, flexible_base=on_base, flexible_winner=on_winner, links=links)


def _flexible(found: Findings, model: Model, missing: Disturbance | None = None) -> Flexible | None:
    """The flexible force on a model whose gap is above the noise."""
    if not found.selection.above_noise(model):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return flexible(found.setup.fitter, model.fit, missing)


def where_it_lies(found: Findings, say: Progress) -> Findings:
    """With the places of the recalibrated simulator's gap, maps of the missing force and its spectra."""
    if found.disturbance is None:
        return found
    fitter, fit = found.setup.fitter, found.selection.base.fit
    located = where.locate(fitter, fit, found.disturbance, seed=found.setup.seed)
    return found.having(Where(located, frequency.analyse(fitter, fit, found.disturbance)))


def rivals_without_physics(found: Findings, say: Progress) -> Findings:
    """With what a network and a formula close of the gap, beside the named effects."""
    if found.disturbance is None:
        return found
    selection, named = found.selection, found.model.fit if found.model.effects else None
    boxes = black_boxes.race(found.setup.fitter, selection.base.fit, named, found.disturbance, selection.noise)
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


# its matrices are small: BLAS's threads take longer than one, and many times that where other processes want the cores
@threadpool_limits.wrap(limits=1, user_api="blas")
def investigate(
    robot: Robot,
    logs: Sequence[Log],
    effects: Effects = "all",
    *,
    group: str | None = None,
    seed: int = 0,
    settings: Settings | None = None,
    minutes: float | None = None,
    quick: bool = False,
    verdict_only: bool = False,
    remember: Path | None = None,
    tolerated: Sequence[str] = (),
    notes: Sequence[str] = (),
    stages: Sequence[Stage] | None = None,
    progress: Progress | None = None,
    keep: Callable[[Setup, Tried | None], None] | None = None,
    verdict: Callable[[Findings], None] | None = None,
    early: Callable[[Sequence[str]], None] | None = None,
) -> Findings:
    """The whole computation, before anything is put into words or written.

    Args:
        robot: the model with the parameters that it may recalibrate.
        logs, effects, group, minutes, quick, seed, progress: see `diagnose`; tolerated: tolerance.
        settings: budgets of the search; None: by the robot's size. verdict_only: without the optional stages.
        remember: folder for the fits of the search, so that a killed one goes on where it was.
        notes: what was noticed while model and logs were read, for the warnings.
        stages: after the selection, optional ones last; None: `STAGES`.
        keep: called with what is known while the search goes on: the setup, and after each part what was tried.
        verdict: called with the findings before the optional stages.
        early: called with what the logs tell before any simulation, in lines.

    Raises:
        UserError: nothing usable. TooLittleData: nothing could be held out.
    """
    say = progress or (lambda text, done, total: None)
    known, tell = keep or (lambda setup, tried: None), early or (lambda lines: None)
    say("looking at the logs", 0, 1)
    time_left = budget.begun(minutes)
    asked: dict[str, Any] = {"group": group, "seed": seed, "settings": settings, "tolerated": tolerated, "notes": notes}
    asked |= {"budget": time_left}
    setup = prepare(robot, logs, effects, quick=quick, **asked, seen_first=lambda seen: tell(first_look.lines(seen)))
    setup = resumed.remembering(_within(setup, time_left), remember)
    for text in setup.said:
        say(text, 0, 1)
    known(setup, None)
    given = setup.fitter, setup.candidates, setup.settings
    found = Findings(setup, selecting.select(*given, say, lambda tried: known(setup, tried)))
    resumed.ended(setup)
    stages = [s for s in (STAGES if stages is None else stages) if not (s.optional and (quick or verdict_only))]
    return carry_out(stages, found, say, time_left, verdict)


def _within(setup: Setup, time_left: budget.Budget) -> Setup:
    return replace(setup, settings=replace(setup.settings, budget=time_left))


def diagnose(
    model: Source,
    logs: str | Path | Log | Sequence[str | Path | Log],
    *,
    effects: Effects = "all",
    parameters: str | Path | None = None,
    map: str | Path | None = None,
    group: str | None = None,
    tolerance: str | Sequence[str] = (),
    accuracy: str | Sequence[str] = (),
    payload: str | Sequence[str] = (),
    minutes: float | None = None,
    quick: bool = False,
    verdict_only: bool = False,
    seed: int = 0,
    out: str | Path | None = None,
    progress: Progress | None = None,
    notes: Sequence[str] = (),
    about: Mapping[str, Any] | None = None,
    early: Callable[[Sequence[str]], None] | None = None,
) -> Diagnosis:
    """Where logs and simulator differ, which missing effects cause it, and how much they explain.

    Args:
        model: an MJCF file, a MuJoCo specification or model, or a `Robot`; `bayessim_mjx.diagnose` takes a task's name
            as well.
        logs: recorded motion: a folder, files (docs/logs.md), or `Log`s.
        effects: "all", or names (also of one's own, `path.py:Class`) or classes.
        parameters: YAML file with the parameters that may be recalibrated; None: damping, armature and mass.
        map: YAML file that maps the logs' columns to the model; group: metadata key of operating conditions.
        tolerance: what may stay unexplained, as the flag: "0.5deg", "elbow=2mm", "3%".
        accuracy, payload: of a data sheet, as the flags: "5%", "mass=2%"; "12kg", "tool=12".
        minutes: that it may take; what was left out is told. quick: from few windows. verdict_only: no maps and such.
        seed: of all random numbers; out: folder for what the command writes, but for the report; None: nothing.
        progress, early: called with (what is being done, done, total), and with what logs tell at once, in lines.
        notes: first among the warnings; about: entries of the report's header.

    Returns:
        The result; too little data is a verdict, not an error.

    Raises:
        UserError: model, logs, effects or tolerance are not usable.
    """
    with noting() as noticed:
        robot = robot_of(model, parameters).stated(_several(accuracy), _several(payload))
        recorded = _logs(logs, robot.mj_model, map)
    told = _told(robot, model, logs, recorded) | {"seed": seed} | dict(about or {})
    files = Files(None if out is None else Path(out), told)
    asked: Any = {"group": group, "seed": seed, "notes": [*notes, *noticed], "progress": progress}
    asked |= {"tolerated": _several(tolerance), "early": early, "minutes": minutes, "quick": quick}
    asked |= {"remember": files.search, "verdict_only": verdict_only, "keep": files.so_far, "verdict": files.verdict}
    try:
        found = investigate(robot, recorded, effects, **asked)
    except TooLittleData as reason:
        return files.whole(assemble.insufficient(str(reason), asked["notes"], told), robot)
    return files.whole(files.result(found), robot)


def _told(robot: Robot, model: Source, logs: Any, recorded: Sequence[Log]) -> dict[str, Any]:
    """Entries of the report's header."""
    return {
        "robot": robot.name, "model": str(model) if isinstance(model, str | Path) else robot.name,
        "data": _names(logs), "logs": len(recorded), "seconds": float(sum(log.duration for log in recorded)),
        "date": time.strftime("%Y-%m-%d %H:%M"),
    }  # fmt: skip


@contextmanager
def noting() -> Iterator[list[str]]:
    """A list that holds the warnings of its block, each once, when the block ends."""
    notes: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield notes
    notes += dict.fromkeys(str(w.message) for w in caught)


def _logs(logs: Any, model: mujoco.MjModel, map: str | Path | None) -> list[Log]:
    each: list[Any] = [logs] if isinstance(logs, str | Path | Log) else list(logs)
    if all(isinstance(log, Log) for log in each):
        return each
    return read_logs(each if len(each) > 1 else each[0], model, map, partial=True)


def _several(texts: str | Sequence[str]) -> Sequence[str]:
    return [texts] if isinstance(texts, str) else texts


def _names(logs: Any) -> list[str]:
    each = [logs] if isinstance(logs, str | Path | Log) else logs
    return [log.name if isinstance(log, Log) else str(log) for log in each]
