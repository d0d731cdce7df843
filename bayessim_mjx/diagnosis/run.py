"""The diagnosis from logs to result: gate, known parameters, race, verdict, how far, where, next experiment."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from bayessim_mjx import effects as library
from bayessim_mjx.diagnosis import (
    bounds,
    candidates,
    channels,
    discretisation,
    gap,
    gate,
    noise,
    ridges,
    scales,
    search,
    tolerance,
    verdict,
    windows,
)
from bayessim_mjx.diagnosis.centred import physics_of
from bayessim_mjx.diagnosis.disturbance import Disturbance, estimate
from bayessim_mjx.diagnosis.fit import Fitter
from bayessim_mjx.diagnosis.flexible import Flexible, flexible
from bayessim_mjx.diagnosis.models import Model
from bayessim_mjx.diagnosis.race import Race
from bayessim_mjx.diagnosis.ridges import Ridges
from bayessim_mjx.diagnosis.robot import Robot
from bayessim_mjx.diagnosis.simulate import Simulator
from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.logs.log import Log
from bayessim_mjx.logs.resample import resample
from bayessim_mjx.physics import Physics

WINDOW = 0.5  # s
SHORTER = (1.0, 0.5, 0.25)  # of it, tried in turn while the time step with contacts is worth more than LOTTERY noises
LOTTERY = 5.0
SHORTEST_WINDOW = 8  # control steps
SHORTEST = 0.004  # s, control period of the diagnosis; faster logs are resampled
LIMITS = ((1, 160), (3, 96), (7, 64), (100, 48))  # (up to so many dofs, windows)
BUDGET = 24000  # sub-steps of one simulation of all windows; half of it for robots of more than MANY dofs
MANY = 3
FEWEST = 24  # windows that are simulated whatever the budget
LEAST = 6  # windows: with fewer nothing can be held out
Progress = Callable[[str, int, int], None]


class TooLittleData(Exception):
    """There is something to look at, but not enough to hold anything out; the text says what is missing."""


@dataclass(frozen=True, eq=False)
class Setup:
    """Everything that is fixed before the race."""

    robot: Robot
    physics: Physics
    gate: gate.Gate
    floors: noise.Floors
    fitter: Fitter
    candidates: list[candidates.Candidate]
    scales: scales.Scales
    settings: search.Settings
    seed: int
    tolerance: tolerance.Tolerance
    warnings: list[str] = field(default_factory=list)
    discretisation: discretisation.Discretisation | None = None

    @property
    def logs(self) -> tuple[Log, ...]:
        return self.gate.usable


@dataclass(frozen=True, eq=False)
class Findings:
    """All that was computed; `report_of` (see `assemble`) turns it into a Diagnosis."""

    setup: Setup
    race: search.Race
    ruling: verdict.Ruling
    predictions: dict[str, gap.Prediction]
    flexible_base: Flexible | None
    flexible_winner: Flexible | None
    disturbance: Disturbance | None
    links: list[channels.Link]
    ridges: Ridges | None = None


def control_period(robot: Robot, logs: Sequence[Log]) -> float:
    """s: the task's, else the logs' own, or a multiple of it that is not too short to simulate."""
    if robot.control_dt is not None:
        return robot.control_dt
    period = float(np.median([log.period for log in logs]))
    return period * max(1, int(np.ceil(SHORTEST / period - 1e-6)))


def prepare(
    robot: Robot,
    logs: Sequence[Log],
    effects: str | Sequence[str | type[Effect]] = "all",
    *,
    group: str | None = None,
    seed: int = 0,
    settings: search.Settings | None = None,
    tolerated: Sequence[str] = (),
) -> Setup:
    """Everything up to the first simulation.

    Raises:
        UserError: unknown effects, no usable log, a tolerance that cannot be read.
        TooLittleData: too few windows.
    """
    asked = tolerance.read(tolerated, robot.mj_model)
    dt = control_period(robot, logs)
    seen = gate.check(logs, robot.mj_model, dt)
    usable = seen.demand()
    notes = [*seen.warnings, *(f"{text} (found, not assumed)" for text in seen.findings)]
    floors = noise.floors(usable)
    kinds = [library.load(n) if isinstance(n, str) else n for n in (library.names() if effects == "all" else effects)]
    size = scales.measure(robot.mj_model, [resample(log, dt) for log in usable])
    stack, left_out = candidates.stack(kinds, size)
    own = robot.physics(dt)
    cuts, step = _measured(own, usable, group, seen.use_qvel)
    robot = step.robot(robot)
    physics = physics_of(robot, dt, stack)
    cut = step.noisier(cuts(step.factor, _limit(physics, cuts(1).steps), centred=False))
    fitter = Fitter(Simulator(physics, cut), candidates.base_coordinates(robot.space), physics.space.nominal)
    every = candidates.enumerate_candidates(physics)
    settings = dataclasses.replace(settings or _settings(robot), believed=step.believed)
    allowed = tolerance.judge(robot.mj_model, 2 * size.travel, cut.sigma_q, asked)
    notes += [*floors.warnings, *step.warnings(), *(f"not tried: {text}" for text in left_out), *_few_conditions(cut)]
    notes += allowed.warnings()
    return Setup(robot, physics, seen, floors, fitter, every, size, settings, seed, allowed, notes, step)


def _settings(robot: Robot) -> search.Settings:
    """Budgets for the robot's size; thresholds are the same for all."""
    big = robot.mj_model.nv > MANY
    return search.Settings(singles=24, pairs=5, screened=24, starts=16) if big else search.Settings()


def _measured(
    own: Physics, usable: Sequence[Log], group: str | None, use_qvel: bool
) -> tuple[Callable[..., windows.Windows], discretisation.Discretisation]:
    """The windows, and what the time step is worth in them; shorter ones where contacts make longer ones a lottery."""
    for share in SHORTER:
        cuts = _windows(own, usable, group, use_qvel, share * WINDOW)
        step = discretisation.measure(own, cuts, usable, _finest(own, len(cuts(1)), cuts(1).steps))
        known = np.isfinite(step.sigma)
        worth = float(np.median(step.floor[known] / step.sigma[known]))
        if worth < LOTTERY or not discretisation.contacts(own) or cuts(1).steps <= SHORTEST_WINDOW:
            break
    return cuts, step


def _windows(
    physics: Physics, logs: Sequence[Log], group: str | None, use_qvel: bool, seconds: float = WINDOW
) -> Callable[..., windows.Windows]:
    """(factor, limit) -> the windows with that many times the sub-steps of `physics`, by default the same ones."""
    dt = physics.dt
    longest = max(int(log.duration / dt) for log in logs)
    length = int(np.clip(round(seconds / dt), SHORTEST_WINDOW, 100))
    if longest < length:
        raise TooLittleData(f"the longest log has {longest} control steps of {dt:.3g} s, one window needs {length}")
    own = _limit(physics, length)

    @functools.cache
    def cuts(factor: int, limit: int = own, centred: bool = True) -> windows.Windows:
        return windows.cut(
            logs,
            physics.mj_model,
            dt,
            physics.substeps * factor,
            length,
            limit=limit,
            group=group,
            use_qvel=use_qvel,
            centred=centred,
        )

    if len(cuts(1)) < LEAST:
        raise TooLittleData(f"{len(cuts(1))} windows of {length * dt:.2g} s; holding conditions out needs {LEAST}")
    return cuts


def _limit(physics: Physics, length: int) -> int:
    """Most windows of so many control steps that are simulated at once."""
    nv = physics.mj_model.nv
    budget = BUDGET if nv <= MANY else BUDGET // 2
    limit = next(n for dofs, n in LIMITS if nv <= dofs)
    return min(limit, max(FEWEST, budget // (length * physics.substeps)))


def _finest(physics: Physics, count: int, length: int) -> int:
    """How many times the sub-steps the budget allows when at most half of `count` windows are given up for it."""
    budget = BUDGET if physics.mj_model.nv <= MANY else BUDGET // 2
    return max(1, budget // (length * physics.substeps * max(FEWEST, (count + 1) // 2)))


def _few_conditions(cut: windows.Windows) -> list[str]:
    count = len(cut.groups)
    if cut.groups[0].startswith("part 1 of"):
        blocks = "one operating condition only: blocks in time are held out, which tells little about other conditions"
        return [*cut.notes, blocks]
    return [*cut.notes, *([f"{count} operating conditions: intervals are rough"] if count < 4 else [])]


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
    predictions = {"nominal": gap.nominal(fitter, race.nominal), "calibrated": gap.predict(fitter, race.base)}
    predictions["with_effects"] = gap.predict(fitter, model) if model.effects else predictions["calibrated"]
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
    model, along = ridges.settled(race.fitter, ruling.model)
    race.models[frozenset(c.label for c in model.effects)] = race.winner = model
    return dataclasses.replace(ruling, model=model), along


def _verified(setup: Setup, race: search.Race, say: Progress) -> Model:
    """The winner without effects that do not help when held-out windows are really simulated (not by linearisation)."""
    model = race.winner
    if model.effects:
        model = gap.steadied(setup.fitter, model)
    steps = setup.fitter.simulator.windows.steps
    while model.effects:
        full = gap.predict(setup.fitter, model).cost(steps).mean()
        smaller = [gap.steadied(setup.fitter, search.without(race, model, e, say)) for e in model.effects]
        error = [gap.predict(setup.fitter, m).cost(steps).mean() for m in smaller]
        helps = [(e - full) / max(e - 1.0, 1e-9) for e in error]
        least = int(np.argmin(helps))
        if helps[least] > race.settings.more / 2:
            return model
        model = smaller[least]
    return model


def _disturbance(setup: Setup, race: search.Race) -> Disturbance | None:
    """The force that the recalibrated simulator lacks, where its gap is above the noise."""
    return estimate(setup.fitter, race.base.job) if race.above_noise(race.base) else None


def _flexible(setup: Setup, model: Model, race: search.Race, missing: Disturbance | None = None) -> Flexible | None:
    """The flexible force on a model whose gap is above the noise."""
    if not race.above_noise(model):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return flexible(setup.fitter, model.job, missing)
