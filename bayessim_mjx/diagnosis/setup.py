"""What is fixed before any fit: usable logs, the model and its time step, windows, candidates, noise, tolerance."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import tolerance
from bayessim_mjx.diagnosis.equation_error import leads
from bayessim_mjx.diagnosis.equation_error.look import Look
from bayessim_mjx.diagnosis.fitting import (
    candidates,
    command_shift,
    discretisation,
    lean,
    observation,
    scales,
    stepping,
    windows,
)
from bayessim_mjx.diagnosis.fitting.centred_commands import physics_of
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.fitting.robot import Robot
from bayessim_mjx.diagnosis.fitting.simulator import Simulator
from bayessim_mjx.diagnosis.logcheck import gate, noise
from bayessim_mjx.diagnosis.selection.tried import Settings
from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.logs.log import Log
from bayessim_mjx.logs.resample import resample
from bayessim_mjx.physics import Physics

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cutting:
    """How logs are cut into windows, and how many are simulated."""

    window: float = 0.5  # s
    # of it, tried in turn while the time step with contacts is worth more than `lottery` noises
    shorter: tuple[float, ...] = (1.0, 0.5, 0.25)
    lottery: float = 5.0
    shortest_window: int = 8  # control steps
    longest_window: int = 100  # control steps, or as many as `long` s hold
    long: float = 0.4  # s
    shortest: float = 0.0005  # s, control period of the diagnosis; faster logs are resampled
    limits: tuple[tuple[int, int], ...] = ((1, 160), (3, 96), (7, 64), (100, 48))  # (up to so many dofs, windows)
    # sub-steps of one simulation of all windows; half of it for robots of more than `many` dofs
    budget: int = 24000
    many: int = 3
    dearest: float = 4.0  # budgets, where the time step is worth more than the tolerance
    fewest: int = 24  # windows that are simulated whatever the budget
    least: int = 6  # windows: with fewer nothing can be held out


CUTTING = Cutting()
# of a first answer, for any robot; how often it differs from the whole search's was not counted
QUICK = Settings(singles=12, screened=12, starts=4, iterations=8)
SHIFT_FACTOR = 4  # times the coarsest sub-steps, the finest by which a shift of commands is looked for


class TooLittleData(Exception):
    """There is something to look at, but not enough to hold anything out; the text says what is missing."""


@dataclass(frozen=True, eq=False)
class Setup:
    """Everything that is fixed before any fit."""

    robot: Robot
    physics: Physics
    gate: gate.Gate
    floors: noise.Floors
    fitter: Fitter
    candidates: tuple[candidates.Candidate, ...]
    scales: scales.Scales
    settings: Settings
    seed: int
    tolerance: tolerance.Tolerance
    warnings: tuple[str, ...] = ()
    said: tuple[str, ...] = ()  # of the warnings, what is said before the search
    discretisation: discretisation.Discretisation | None = None
    look: Look = Look()

    @property
    def logs(self) -> tuple[Log, ...]:
        return self.gate.usable


def control_period(robot: Robot, logs: Sequence[Log]) -> float:
    """s: the task's, else the logs' own, or a multiple of it that is not too short to simulate."""
    if robot.control_dt is not None:
        return robot.control_dt
    period = float(np.median([log.period for log in logs]))
    return period * max(1, int(np.ceil(CUTTING.shortest / period - 1e-6)))


def prepare(
    robot: Robot,
    logs: Sequence[Log],
    effects: str | Sequence[str | type[Effect]] = "all",
    *,
    group: str | None = None,
    seed: int = 0,
    settings: Settings | None = None,
    quick: bool = False,
    tolerated: Sequence[str] = (),
    notes: Sequence[str] = (),
    seen_first: Callable[[Look], None] = lambda seen: None,
) -> Setup:
    """Everything up to the first simulation.

    Args:
        robot, logs, effects, group, seed, tolerated: see `run.diagnose`.
        settings: budgets of the search; None: by the robot's size; quick: as small as is sensible, few windows.
        notes: what was noticed before, first among the warnings.
        seen_first: called with what the logs tell before any simulation.

    Raises:
        UserError: unknown effects, no usable log, a tolerance that cannot be read.
        TooLittleData: too few windows.
    """
    asked = tolerance.read(tolerated, robot.mj_model)
    dt = control_period(robot, logs)
    told = [*notes]
    seen, before = leads.checked(logs, robot, dt, told, seen_first)
    seen = seen.of_logs(observation.completed(seen.demand(), robot.mj_model))
    usable, robot = seen.usable, lean.lean(robot, seen.usable, dt)
    told += [*seen.warnings, *(f"{text} (found, not assumed)" for text in seen.findings)]
    floors = noise.floors(usable)
    kinds = candidates.kinds_of(effects)
    size = scales.measure(robot.mj_model, [resample(log, dt) for log in usable], robot.rating)
    stack, left_out = candidates.stack(kinds, size)
    limit = tolerance.judge(robot.mj_model, 2 * size.travel, _noise(usable), asked).limit
    delivered = float(robot.mj_model.opt.timestep)
    steps = stepping.stepping(
        robot, dt, usable, lambda own, first: _measured(own, usable, group, seen.use_qvel, first, limit)
    )
    cuts, step = steps.cuts, steps.worth
    shift = _shift(cuts, step, size)
    lead = 0.0 if shift is None else shift.lead
    seen = seen.shifted(lead) if lead else seen
    robot = step.robot(steps.robot)
    physics = physics_of(robot, dt, stack)
    most = _limit(physics, step.errors.cut.steps if step.errors else cuts(1).steps, quick)
    cut = step.noisier(cuts(step.factor, limit=most, centred=False, late=lead))
    base = candidates.base_coordinates(robot.space, robot.accuracy, robot.assumed)
    fitter = Fitter(Simulator(physics, cut), base, physics.space.nominal)
    led = leads.lead(candidates.enumerate_candidates(physics), before)
    allowed = tolerance.judge(robot.mj_model, 2 * size.travel, cut.sigma_q, asked)
    settings = dataclasses.replace(settings or _settings(robot, quick), **_known(step, allowed, fitter), **led.order)
    said = [*steps.said(), *_faster(seen.usable, delivered, dt)]
    said += [] if shift is None else shift.told(float(np.median([log.period for log in logs])))
    told += [*said, *floors.warnings, *steps.warnings(), *(f"not tried: {text}" for text in left_out)]
    told += [*_few_conditions(cut), *allowed.warnings(), *led.sentences()]
    fixed = (robot, physics, seen, floors, fitter, led.candidates, size, settings, seed, allowed)
    return Setup(*fixed, tuple(told), tuple(said), step, before)


def _settings(robot: Robot, quick: bool = False) -> Settings:
    """Budgets for the robot's size; criteria are the same for all."""
    if quick:
        return QUICK
    big = robot.mj_model.nv > CUTTING.many
    return Settings(singles=16, screened=24, starts=8) if big else Settings()


def _known(step: discretisation.Discretisation, allowed: tolerance.Tolerance, fitter: Fitter) -> dict[str, Any]:
    """What a decision has to know of the noise and of the tolerance."""
    return {"believed": step.believed, "tolerated": allowed.surely(len(fitter.sigma))}


def _noise(logs: Sequence[Log]) -> Array:
    """Noise of positions `[nv]`, pooled over logs."""
    return np.asarray(np.sqrt(np.mean([log.sigma_dofs**2 for log in logs], axis=0)))


def _measured(
    own: Physics,
    usable: Sequence[Log],
    group: str | None,
    use_qvel: bool,
    first: int = 1,
    limit: Array | None = None,
) -> tuple[Callable[..., windows.Windows], discretisation.Discretisation]:
    """The windows, and what the time step is worth in them; shorter ones where contacts make longer ones a lottery.

    Args:
        first: the coarsest factor on the sub-steps that is stable: as many windows fewer are looked at.
        limit: `[nv]`, the tolerance: steps are made finer than the budget allows until they are worth less; None: they
            are not, and `first` is 1.
    """
    for share in CUTTING.shorter:
        cuts = _windows(own, usable, group, use_qvel, share * CUTTING.window, first)
        finest = [_finest(own, len(cuts(1)), cuts(1).steps, budget) for budget in (1.0, CUTTING.dearest)]
        more: dict[str, Any] = {} if limit is None else {"first": first, "limit": limit, "utmost": finest[1]}
        step = discretisation.measure(own, cuts, usable, finest[0], **more)
        known = np.isfinite(step.sigma)
        worth = float(np.median(step.floor[known] / step.sigma[known]))
        if worth < CUTTING.lottery or not discretisation.contacts(own) or cuts(1).steps <= CUTTING.shortest_window:
            break
    return cuts, step


def _shift(
    cuts: Callable[..., windows.Windows], step: discretisation.Discretisation, size: scales.Scales
) -> command_shift.Shift | None:
    """By how much commands act later or earlier than the logs say."""
    if step.errors is None or not step.errors.physics.mj_model.nu:
        return None
    factor = min(step.factor, SHIFT_FACTOR * step.errors.first)
    return command_shift.estimate(
        step.errors, lambda late: cuts(factor, late=round(late, 9)), step.floor, size.force, factor
    )


def _windows(
    physics: Physics,
    logs: Sequence[Log],
    group: str | None,
    use_qvel: bool,
    seconds: float = CUTTING.window,
    first: int = 1,
) -> Callable[..., windows.Windows]:
    """(factor, limit) -> the windows with that many times the sub-steps of `physics`, by default the same ones.

    first: the coarsest factor that will be asked for, for which the number of windows is chosen.
    """
    dt = physics.dt
    longest = max(int(log.duration / dt) for log in logs)
    longest_window = max(CUTTING.longest_window, round(CUTTING.long / dt))
    length = int(np.clip(round(seconds / dt), CUTTING.shortest_window, longest_window))
    if longest < length:
        raise TooLittleData(f"the longest log has {longest} control steps of {dt:.3g} s, one window needs {length}")
    own = max(min(CUTTING.fewest, _limit(physics, length)), _limit(physics, length) // first)

    @functools.cache
    def cuts(factor: int, limit: int = own, centred: bool = True, late: float = 0.0) -> windows.Windows:
        return windows.cut(
            [log.shifted(late) for log in logs] if late else logs,
            physics.mj_model,
            dt,
            physics.substeps * factor,
            length,
            limit=limit,
            group=group,
            use_qvel=use_qvel,
            centred=centred,
        )

    if len(cuts(1)) < CUTTING.least:
        raise TooLittleData(
            f"{len(cuts(1))} windows of {length * dt:.2g} s; holding conditions out needs {CUTTING.least}"
        )
    return cuts


def _limit(physics: Physics, length: int, quick: bool = False) -> int:
    """Most windows of so many control steps that are simulated at once."""
    if quick:
        return CUTTING.fewest
    nv = physics.mj_model.nv
    budget = CUTTING.budget if nv <= CUTTING.many else CUTTING.budget // 2
    limit = next(n for dofs, n in CUTTING.limits if nv <= dofs)
    return min(limit, max(CUTTING.fewest, budget // (length * physics.substeps)))


def _finest(physics: Physics, count: int, length: int, share: float = 1.0) -> int:
    """How many times the sub-steps `share` budgets allow when at most half of `count` windows are given up for it."""
    budget = int(share * (CUTTING.budget if physics.mj_model.nv <= CUTTING.many else CUTTING.budget // 2))
    return max(1, budget // (length * physics.substeps * max(CUTTING.fewest, (count + 1) // 2)))


def _faster(logs: Sequence[Log], timestep: float, dt: float) -> list[str]:
    """What logs faster than the simulator, or than the diagnosis goes, are told."""
    period = float(np.median([log.period for log in logs]))
    if period < dt * (1 - 1e-6) and dt <= 2 * CUTTING.shortest:
        return [f"the logs have a row every {1e3 * period:.3g} ms; one every {1e3 * dt:.3g} ms is compared"]
    if timestep > dt * (1 + 1e-6):
        text = f"the logs have a row every {1e3 * period:.3g} ms, and the model steps {1e3 * timestep:.3g} ms"
        return [f"{text}: it is simulated at {1e3 * dt:.3g} ms"]
    return []


def _few_conditions(cut: windows.Windows) -> list[str]:
    count = len(cut.groups)
    if cut.groups[0].startswith("part 1 of"):
        blocks = "one operating condition only: blocks in time are held out, which tells little about other conditions"
        return [*cut.notes, blocks]
    return [*cut.notes, *([f"{count} operating conditions: intervals are rough"] if count < 4 else [])]
