"""The diagnosis from logs to result: setup, selection, and the stages after it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import jax
import mujoco
import numpy as np
from threadpoolctl import threadpool_limits

from bayessim_mjx import programs, versions
from bayessim_mjx.diagnosis.evidence import selecting
from bayessim_mjx.diagnosis.experiment import propose
from bayessim_mjx.diagnosis.findings import Findings, Observer, Stage, Where, carry_out
from bayessim_mjx.diagnosis.fitting.cutting import TooLittleData
from bayessim_mjx.diagnosis.fitting.journal import Journal, Remembering, digest
from bayessim_mjx.diagnosis.fitting.robot import Robot, Source, robot_of
from bayessim_mjx.diagnosis.logcheck.links import links as links_of
from bayessim_mjx.diagnosis.phrases import notes
from bayessim_mjx.diagnosis.request import Effects, Request
from bayessim_mjx.diagnosis.residual import black_boxes, frequency, where
from bayessim_mjx.diagnosis.residual.black_boxes import Flexible, flexible
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance, estimate
from bayessim_mjx.diagnosis.result import Diagnosis
from bayessim_mjx.diagnosis.selection import heldout, numbers
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.numbers import Progress
from bayessim_mjx.diagnosis.setup import Setup, prepare
from bayessim_mjx.diagnosis.summary import again
from bayessim_mjx.diagnosis.summary.files import Files, header
from bayessim_mjx.logs import read_logs
from bayessim_mjx.logs.log import Log


def how_far(found: Findings, say: Progress) -> Findings:
    """Add the held-out motion of the simulator as delivered, recalibrated and with the effects."""
    fitter, base, model = found.setup.fitter, found.selection.state.base, found.model
    delivered, moved, cut = found.setup.delivered, found.setup.gate.timing.moved, fitter.simulator.windows
    starts = list(zip(cut.log.tolist(), cut.start.tolist(), strict=True))
    meant = [delivered.recorded(starts, cut, found.setup.logs, moved)] if delivered and moved else []
    predictions = {
        "nominal": heldout.nominal(fitter, found.selection.state.nominal, delivered, meant),
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
    """Return a flexible force on top of a model; None if the model leaves no more than noise."""
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
    Stage("size of the gap", how_far),
    Stage("missing force", none_of_these),
    Stage("finer time steps", again.at_finer_steps, patient=True, beside=True),
    Stage("whole logs", again.over_whole_logs, patient=True, beside=True),
    Stage("place of the gap", where_it_lies, optional=True, beside=True),
    Stage("network and formula", rivals_without_physics, optional=True, beside=True),
    Stage("next experiment", propose.stage, optional=True, beside=True),
)


# its matrices are small: BLAS's threads take longer than one, and many times that where other processes want the cores
@threadpool_limits.wrap(limits=1, user_api="blas")
def investigate(
    robot: Robot,
    logs: Sequence[Log],
    request: Request = Request(),  # noqa: B008  # immutable
    observer: Observer = Observer(),  # noqa: B008  # has no state
    stages: Sequence[Stage] | None = None,
) -> Findings:
    """Compute everything, before results are put into words or written.

    Args:
        robot: the model with the parameters that it may recalibrate.
        stages: after the selection, optional ones last; None: `STAGES`.

    Raises:
        UserError: nothing usable. TooLittleData: nothing could be held out.
    """
    observer.progress("checking the logs", 0, 1)
    time_left = numbers.begun(request.minutes)
    setup = prepare(robot, logs, request, time_left, lambda look: observer.early(notes.first_look(look)))
    setup = remembering(setup, request.remember)
    for text in setup.said:
        observer.note(text)
    observer.known(setup, None)
    given = setup.fitter, setup.candidates, setup.settings
    found = selecting.select(*given, observer.progress, lambda state: observer.known(setup, state))
    if isinstance(setup.fitter, Remembering):
        setup.fitter.journal = None  # fits of later stages are not kept
    optional = not (request.quick or request.verdict_only)
    chosen = [s for s in (STAGES if stages is None else stages) if optional or not s.optional]
    return carry_out(chosen, Findings(setup, found), time_left, observer)


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
    given: list[Any] = [logs] if isinstance(logs, str | Path | Log) else list(logs)
    flags = [[texts] if isinstance(texts, str) else [*texts] for texts in (accuracy, payload, tolerance)]
    with noting() as noticed:
        robot = robot_of(model, parameters).stated(*flags[:2])
        read = all(isinstance(log, Log) for log in given)
        recorded = given if read else read_logs(given if given[1:] else given[0], robot.mj_model, map, partial=True)
    about = header(robot, model, given, recorded, flags) | {"seed": seed} | dict(about or {})
    files = Files(None if out is None else Path(out), about, progress, early)
    request = Request(
        effects=effects, group=group, seed=seed, minutes=minutes, quick=quick, verdict_only=verdict_only,
        tolerances=flags[2], notes=(*notes, *noticed), remember=files.search,
    )  # fmt: skip
    try:
        found = investigate(robot, recorded, request, files)
    except TooLittleData as reason:
        return files.insufficient(str(reason), request.notes, robot)
    return files.whole(files.result(found), robot)


def remembering(setup: Setup, folder: Path | None) -> Setup:
    """Return the setup with a fitter that stores its fits in a folder, and finds those of an interrupted search."""
    if folder is None:
        return setup
    digests = _asked(setup)
    return replace(setup, fitter=Remembering(setup.fitter, Journal(folder, *digests)))


def _asked(setup: Setup) -> tuple[str, str]:
    """Digests of what the fits depend on beside their code, and of the code: this package and the user's own effects.

    The time that they may take is no part of it.
    """
    fitter, model = setup.fitter, setup.physics.mj_model
    simulator = fitter.simulator
    raw = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, raw)
    windows = simulator.windows
    arrays = [np.asarray(leaf) for leaf in jax.tree.leaves(windows.batch)]
    arrays += [windows.group, windows.sigma_q, windows.sigma_v, windows.spread, fitter.theta, raw]
    each = [(c.label, c.coordinates, c.shapes, c.probes.tobytes()) for c in setup.candidates]
    every = replace(setup.settings, budget=numbers.Budget())
    code = versions.sources(), sorted({str(programs.source_of(type(e))) for e in setup.physics.effects})
    question = *arrays, fitter.base, each, every, simulator.lanes, jax.default_backend(), versions.versions()
    return digest(*question), digest(*code)


@contextmanager
def noting() -> Iterator[list[str]]:
    """Return a list that holds the warnings of its block, each once, when the block ends."""
    notes: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        yield notes
    notes += dict.fromkeys(str(w.message) for w in caught)
