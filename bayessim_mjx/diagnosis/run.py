"""The diagnosis from logs to result: gate, known parameters, race, verdict, how far, where, next experiment."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Sequence

import numpy as np

from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.fitting.robot import Robot
from bayessim_mjx.diagnosis.logcheck import channels
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance, estimate
from bayessim_mjx.diagnosis.residual.flexible import Flexible, flexible
from bayessim_mjx.diagnosis.selection import bounds, heldout, search, verdict, weak_directions
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.race import Race
from bayessim_mjx.diagnosis.selection.weak_directions import Ridges
from bayessim_mjx.diagnosis.setup import Setup, prepare
from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.logs.log import Log

Progress = Callable[[str, int, int], None]


def diagnose(
    robot: Robot,
    logs: Sequence[Log],
    effects: str | Sequence[str | type[Effect]] = "all",
    *,
    group: str | None = None,
    seed: int = 0,
    settings: search.Settings | None = None,
    tolerated: Sequence[str] = (),
    progress: Progress | None = None,
    keep: Callable[[Setup, Race | None], None] | None = None,
) -> Findings:
    """The whole computation.

    Args:
        robot: the model with the parameters that it may recalibrate.
        logs: recorded motion.
        effects: "all", or names (also of one's own, `path.py:Class`) or classes.
        group: metadata key of the operating conditions that are held out in turn.
        tolerated: what may stay unexplained, as `--tolerance` (`tolerance.read`).
        progress: called with (what is being done, done, total).
        keep: called with what is known so far: the setup, and after each stage the race.

    Raises:
        UserError: nothing usable. TooLittleData: nothing could be held out.
    """
    say = progress or (lambda text, done, total: None)
    say("looking at the logs", 0, 1)
    setup = prepare(robot, logs, effects, group=group, seed=seed, settings=settings, tolerated=tolerated)
    known = keep or (lambda setup, race: None)
    known(setup, None)
    race = search.run(setup.fitter, setup.candidates, setup.settings, say, lambda race: known(setup, race))
    race.winner = bounds.widened(race, _verified(setup, race, say), say)
    ruling = verdict.rule(race, say)
    ruling = dataclasses.replace(ruling, model=bounds.widened(race, ruling.model, say))
    ruling, along = _on_ridges(race, ruling)
    fitter, model = setup.fitter, ruling.model
    say("how far", 0, 1)
    predictions = {"nominal": heldout.nominal(fitter, race.nominal), "calibrated": heldout.predict(fitter, race.base)}
    predictions["with_effects"] = heldout.predict(fitter, model) if model.effects else predictions["calibrated"]
    say("none of these?", 0, 1)
    missing = _disturbance(setup, race)
    on_base = _flexible(setup, race.base, race, missing)
    on_winner = _flexible(setup, model, race) if model.effects else on_base
    links = [link for log in setup.logs[:1] for link in channels.links(log, robot.mj_model)]
    return Findings(setup, race, ruling, predictions, on_base, on_winner, missing, links, along)


def _on_ridges(race: search.Race, ruling: verdict.Ruling) -> tuple[verdict.Ruling, Ridges | None]:
    """The ruling with its model where data and beliefs together put it, and what was simulated along its ridges."""
    if not ruling.model.effects:
        return ruling, None
    model, along = weak_directions.settled(race.fitter, ruling.model)
    race.models[frozenset(c.label for c in model.effects)] = race.winner = model
    return dataclasses.replace(ruling, model=model), along


def _verified(setup: Setup, race: search.Race, say: Progress) -> Model:
    """The winner without effects that do not help when held-out windows are really simulated (not by linearisation)."""
    model = race.winner
    if model.effects:
        model = heldout.steadied(setup.fitter, model)
    steps = setup.fitter.simulator.windows.steps
    while model.effects:
        full = heldout.predict(setup.fitter, model).cost(steps).mean()
        smaller = [heldout.steadied(setup.fitter, search.without(race, model, e, say)) for e in model.effects]
        error = [heldout.predict(setup.fitter, m).cost(steps).mean() for m in smaller]
        helps = [(e - full) / max(e - 1.0, 1e-9) for e in error]
        least = int(np.argmin(helps))
        if helps[least] > race.settings.more / 2:
            return model
        model = smaller[least]
    return model


def _disturbance(setup: Setup, race: search.Race) -> Disturbance | None:
    """The force that the recalibrated simulator lacks, where its gap is above the noise."""
    return estimate(setup.fitter, race.base.fit) if race.above_noise(race.base) else None


def _flexible(setup: Setup, model: Model, race: search.Race, missing: Disturbance | None = None) -> Flexible | None:
    """The flexible force on a model whose gap is above the noise."""
    if not race.above_noise(model):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return flexible(setup.fitter, model.fit, missing)
