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
from bayessim_mjx.diagnosis.equation_error import proposals
from bayessim_mjx.diagnosis.equation_error.inverse_dynamics_check import Look
from bayessim_mjx.diagnosis.fitting import (
    candidates,
    command_shift,
    discretisation,
    integrator_choice,
    observation,
    pruned_model,
    scales,
    windows,
)
from bayessim_mjx.diagnosis.fitting.cutting import CUTTING, finest, most_windows, seconds_of, windows_of
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.fitting.robot import Robot
from bayessim_mjx.diagnosis.fitting.simulator import Simulator, physics_of
from bayessim_mjx.diagnosis.fitting.substep_errors import Errors
from bayessim_mjx.diagnosis.logcheck import gate, noise
from bayessim_mjx.diagnosis.selection.budget import Budget
from bayessim_mjx.diagnosis.selection.tried import Settings
from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.logs.log import Log
from bayessim_mjx.logs.resample import resample
from bayessim_mjx.physics import Physics

Array = NDArray[np.float64]


# of a first answer, for any robot; how often it differs from the whole search's was not counted
QUICK = Settings(screened=12, iterations=8)
SHIFT_FACTOR = 4  # times the coarsest sub-steps, the finest by which a shift of commands is looked for


@dataclass(frozen=True, eq=False)
class Setup:
    """Everything that is fixed before any fit."""

    robot: Robot
    physics: Physics
    gate: gate.Gate
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
    budget: Budget = Budget(),  # noqa: B008  # immutable
    seen_first: Callable[[Look], None] = lambda seen: None,
) -> Setup:
    """Everything up to the first simulation.

    Args:
        robot, logs, effects, group, seed, tolerated: see `run.diagnose`.
        settings: budgets of the search; None: by the robot's size; quick: as small as is sensible, few windows.
        notes: what was noticed before, first among the warnings.
        budget: the time that a search may take.
        seen_first: called with what the logs tell before any simulation.

    Raises:
        UserError: unknown effects, no usable log, a tolerance that cannot be read.
        TooLittleData: too few windows.
    """
    asked = tolerance.read(tolerated, robot.mj_model)
    dt = control_period(robot, logs)
    told = [*notes]
    seen, before = proposals.checked(logs, robot, dt, told, seen_first)
    beginnings, shorter = observation.shortened(seen.demand(), seconds_of(robot.mj_model.nv, quick))
    seen = seen.of_logs(observation.completed(beginnings, robot.mj_model))
    usable, robot = seen.usable, pruned_model.pruned(robot, seen.usable, dt)
    told += [*seen.warnings, *shorter, *(f"{text} (found, not assumed)" for text in seen.findings)]
    told += [] if noise.repeats(usable) else [noise.ONCE]
    size = scales.measure(robot.mj_model, [resample(log, dt) for log in usable], robot.rating)
    stack, left_out = candidates.stack(candidates.kinds_of(effects), size)
    limit = tolerance.judge(robot.mj_model, 2 * size.travel, noise.noise_of_positions(usable), asked).limit
    delivered = float(robot.mj_model.opt.timestep)
    look_at = functools.partial(_measured, usable=usable, group=group, use_qvel=seen.use_qvel, limit=limit)
    steps = integrator_choice.choose(robot, dt, usable, look_at, functools.partial(_affordable, budget))
    cuts, step = steps.cuts, steps.worth
    shift = _shift(cuts, step, size)
    seen = seen if shift is None else seen.clocked(shift.behind, shift.lead)
    robot = step.robot(steps.robot)
    physics = physics_of(robot, dt, stack)
    most = most_windows(physics, step.errors.cut.steps if step.errors else cuts(1).steps, quick)
    cut = step.noisier(cuts(step.factor, limit=most, centred=False, late=seen.timing.moved))
    base = candidates.base_coordinates(robot.space, robot.accuracy, robot.assumed)
    fitter = Fitter(Simulator(physics, cut), base, physics.space.nominal)
    led = proposals.lead(candidates.enumerate_candidates(physics), before)
    allowed = tolerance.judge(robot.mj_model, 2 * size.travel, cut.sigma_q, asked)
    settings = dataclasses.replace(settings or _settings(robot, quick), believed=step.believed)
    late = [] if shift is None else shift.told(float(np.median([log.period for log in logs])))
    said = [*steps.said(), *_faster(seen.usable, delivered, dt), *late]
    told += [*said, *steps.warnings(), *(f"not tried: {text}" for text in left_out)]
    told += [*_few_conditions(cut), *noise.not_compared(usable), *allowed.warnings(), *led.sentences()]
    fixed = (robot, physics, seen, fitter, led.candidates, size, settings, seed, allowed)
    return Setup(*fixed, tuple(told), tuple(said), step, before)


def _affordable(budget: Budget, seconds: float) -> bool:
    """Whether a search whose simulations of all windows take so many seconds each would end in time."""
    return CUTTING.simulations * seconds < budget.seconds - budget.spent


def _settings(robot: Robot, quick: bool = False) -> Settings:
    """Budgets for the robot's size."""
    if quick:
        return QUICK
    big = robot.mj_model.nv > CUTTING.many
    return Settings(screened=24) if big else Settings()


def _measured(
    own: Physics,
    usable: Sequence[Log],
    group: str | None,
    use_qvel: bool,
    limit: Array | None = None,
    first: int = 1,
    cheaper: Errors | None = None,
) -> tuple[Callable[..., windows.Windows], discretisation.Discretisation]:
    """The windows, and what the time step is worth in them; shorter ones where contacts make longer ones a lottery.

    Args:
        limit: `[nv]`, the tolerance: steps are made finer than the budget allows until they are worth less; None: they
            are not, and `first` is 1.
        first: the coarsest factor on the sub-steps that is stable: as many windows fewer are looked at.
        cheaper: see `Errors`.
    """
    for share in CUTTING.shorter:
        cuts = windows_of(own, usable, group, use_qvel, share * CUTTING.window, first)
        factors = [finest(own, len(cuts(1)), cuts(1).steps, budget) for budget in (1.0, CUTTING.dearest)]
        asked = {"first": first, "limit": limit, "utmost": factors[1], "cheaper": cheaper}
        more: dict[str, Any] = {} if limit is None else asked
        step = discretisation.measure(own, cuts, usable, factors[0], **more)
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
    if cut.blocks:
        text = "one log is one operating condition: blocks of it in time are held out, so all numbers are in sample"
        return [*cut.notes, f"{text}, and no interval between conditions is given"]
    return [*cut.notes, *([f"{count} operating conditions: intervals are rough"] if count < 4 else [])]
