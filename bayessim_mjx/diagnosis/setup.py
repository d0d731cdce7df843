"""Preparation of a diagnosis: usable logs, the model and its time step, windows, candidates, noise, tolerance."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.equation_error import inverse_dynamics_check
from bayessim_mjx.diagnosis.equation_error.inverse_dynamics_check import Look, looked
from bayessim_mjx.diagnosis.fitting import (
    candidates,
    command_shift,
    discretisation,
    integrator_choice,
    observation,
    scales,
)
from bayessim_mjx.diagnosis.fitting.cutting import CUTTING, windows_of
from bayessim_mjx.diagnosis.fitting.delivered import Delivered
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.fitting.quadratic import RULES
from bayessim_mjx.diagnosis.fitting.robot import Robot, contacts, pruned
from bayessim_mjx.diagnosis.fitting.simulator import Simulator, physics_of
from bayessim_mjx.diagnosis.fitting.windows import Windows
from bayessim_mjx.diagnosis.logcheck import gate, noise, single_log
from bayessim_mjx.diagnosis.phrases import notes, time_step
from bayessim_mjx.diagnosis.request import Request, Tolerance, tolerances
from bayessim_mjx.diagnosis.selection.numbers import Budget
from bayessim_mjx.diagnosis.selection.search_state import Settings
from bayessim_mjx.effects.support.motion import AROUND
from bayessim_mjx.logs.log import Log
from bayessim_mjx.logs.resample import resample
from bayessim_mjx.odometry import stand
from bayessim_mjx.odometry.base import Base
from bayessim_mjx.physics import Physics

Array = NDArray[np.float64]


# of a first answer, for any robot; how often it differs from the answer of the whole search was not counted
QUICK = Settings(screened=12, iterations=8)


@dataclass(frozen=True, eq=False)
class Setup:
    """Everything that is fixed before any fit.

    Attributes:
        robot: as it is simulated; physics: its compiled model with all effects on offer.
        gate: the logs after the checks; look: what they show before any simulation.
        fitter: on the windows that models are fitted to; candidates: effects at their places.
        scales: sizes of motions, forces and inertias; tolerance: errors that may stay unexplained.
        discretisation: the error of the time step beside the noise.
        warnings: for the result; said: those of them that are said before the search.
    """

    robot: Robot
    physics: Physics
    gate: gate.Gate
    fitter: Fitter
    candidates: tuple[candidates.Candidate, ...]
    scales: scales.Scales
    settings: Settings
    seed: int
    tolerance: Tolerance
    warnings: tuple[str, ...] = ()
    said: tuple[str, ...] = ()
    discretisation: discretisation.Discretisation | None = None
    look: Look = Look()

    @property
    def logs(self) -> tuple[Log, ...]:
        return self.gate.usable

    @property
    def delivered(self) -> Delivered | None:
        """The model as delivered, where it is simulated by another integrator."""
        return self.discretisation.delivered if self.discretisation else None


def control_period(robot: Robot, logs: Sequence[Log]) -> float:
    """s: the task's, else the logs' own, or a multiple of it that is not too short to simulate."""
    if robot.control_dt is not None:
        return robot.control_dt
    period = float(np.median([log.period for log in logs]))
    return period * max(1, int(np.ceil(CUTTING.shortest / period - 1e-6)))


@dataclass(frozen=True, eq=False)
class _Checked:
    """Logs that passed the gate, and the robot and the control period that they are compared with.

    Attributes:
        robot: as it is simulated beside these logs (`robot.pruned`); dt: control period, s.
        look: what the logs show before any simulation; notes: warnings so far.
        bases: estimates of the motion of a floating base that was not measured.
    """

    robot: Robot
    dt: float
    gate: gate.Gate
    look: Look
    notes: tuple[str, ...]
    bases: tuple[Base, ...] = ()


@dataclass(frozen=True, eq=False)
class _Timed:
    """The robot with a time step that is fine enough, and when its commands act.

    Attributes:
        gate: with logs whose commands are moved (`Timing.moved`); cuts: windows by the factor on the sub-steps.
        notes: warnings that are said before the search; warnings: others.
    """

    robot: Robot
    gate: gate.Gate
    cuts: Callable[..., Windows]
    step: discretisation.Discretisation
    notes: tuple[str, ...]
    warnings: tuple[str, ...]

    def cut(self, physics: Physics, quick: bool) -> Windows:
        """Return the windows that models are fitted to."""
        steps = self.step.errors.cut.steps if self.step.errors else self.cuts(1).steps
        most = CUTTING.most(physics, steps, quick)
        return self.step.noisier(self.cuts(self.step.factor, limit=most, centred=False, late=self.gate.timing.moved))


def prepare(
    robot: Robot,
    logs: Sequence[Log],
    request: Request = Request(),  # noqa: B008  # immutable
    budget: Budget = Budget(),  # noqa: B008  # immutable
    looked: Callable[[Look], None] = lambda look: None,
) -> Setup:
    """Everything up to the first fit.

    Args:
        budget: the time that the search may take; looked: called with what the logs show before any simulation.

    Raises:
        UserError: unknown effects, no usable log, a tolerance that cannot be read.
        TooLittleData: too few windows.
    """
    tolerated = tolerances(request.tolerances, robot.mj_model)
    checked = _checked(robot, logs, request, looked)
    usable = checked.gate.usable
    uncompared = noise.not_compared(usable)
    size = scales.measure(checked.robot.mj_model, [resample(log, checked.dt) for log in usable], robot.rating)
    kinds = candidates.kinds_of(request.effects)
    stack, left_out = candidates.stack(kinds, size)
    allows = functools.partial(tolerated, 2 * size.travel)
    timed = _timed(checked, size, allows(noise.noise_of_positions(usable)).limit, request.group, budget)
    physics = physics_of(timed.robot, checked.dt, stack)
    cut = timed.cut(physics, request.quick)
    simulator = Simulator(physics, cut)
    base = candidates.base_coordinates(timed.robot.space, timed.robot.accuracy, timed.robot.assumed)
    fitter = Fitter(simulator, base, physics.space.nominal)
    led = inverse_dynamics_check.lead(candidates.enumerate_candidates(physics), checked.look)
    allowed = allows(cut.sigma_q)
    untried = [f"not tried: {text}" for text in left_out]
    few = [*notes.conditions(len(cut.groups), cut.blocks), *notes.below_noise(allowed)]
    units = notes.inertial(checked.bases, [stand.measure(log, robot.mj_model) for log in usable])
    warnings = [*checked.notes, *units, *timed.notes, *timed.warnings, *untried, *cut.notes]
    warnings += [*uncompared, *few]
    own = Settings(screened=CUTTING.shared(Settings.screened, int(robot.mj_model.nv)))
    settings = request.settings or (QUICK if request.quick else own)
    return Setup(
        robot=timed.robot,
        physics=physics,
        gate=timed.gate,
        fitter=fitter,
        candidates=led.candidates,
        scales=size,
        settings=dataclasses.replace(settings, believed=timed.step.believed, budget=budget),
        seed=request.seed,
        tolerance=allowed,
        warnings=(*warnings, *led.sentences()),
        said=timed.notes,
        discretisation=timed.step,
        look=checked.look,
    )


def _checked(robot: Robot, logs: Sequence[Log], request: Request, looked: Callable[[Look], None]) -> _Checked:
    """Return the logs after the gate, cut where they begin to be usable, and their notes."""
    dt, said = control_period(robot, logs), [*request.notes]
    found, look = _looked_at(logs, robot, dt, looked)
    said += [look.note] if look.note else []
    seconds = CUTTING.at_most(robot.mj_model.nv, request.quick) * (
        CUTTING.window + AROUND
    )  # that all windows hold together
    beginnings, shorter = observation.shortened(found.demand(), seconds)
    whole, bases = observation.completed(beginnings, robot.mj_model)
    found = found.of_logs(whole)
    robot = pruned(robot, found.usable, dt)
    said += [*found.warnings, *shorter, *found.findings]
    said += [] if noise.repeats(found.usable) else [notes.NO_REPEATS]
    return _Checked(robot, dt, found, look, tuple(said), bases)


def _timed(checked: _Checked, size: scales.Scales, limit: Array, group: str | None, budget: Budget) -> _Timed:
    """How finely the simulator has to step, and how far commands are shifted; limit: `[nv]`, the tolerance."""
    usable, dt = checked.gate.usable, checked.dt
    measured = functools.partial(_measured, usable=usable, group=group, use_qvel=checked.gate.use_qvel, limit=limit)
    left = (budget.seconds - budget.spent) / CUTTING.simulations  # s for one simulation of all windows
    steps = integrator_choice.choose(checked.robot, dt, usable, measured, left)
    cuts, step = steps.cuts, steps.worth
    shift = command_shift.estimate(step, cuts, size.force)
    clocked = checked.gate if shift is None else checked.gate.moved(shift.lead)
    period, timestep = float(np.median([log.period for log in usable])), float(checked.robot.mj_model.opt.timestep)
    late = shift.notes(period) if shift is not None else []
    said, warnings = time_step.sentences(steps)
    said += [*notes.rows(period, timestep, dt, dt <= 2 * CUTTING.shortest), *late]
    return _Timed(step.robot(steps.robot), clocked, cuts, step, tuple(said), tuple(warnings))


def _measured(
    own: Physics,
    usable: Sequence[Log],
    group: str | None,
    use_qvel: bool,
    limit: Array | None,
    first: int = 1,
    delivered: Delivered | None = None,
) -> tuple[Callable[..., Windows], discretisation.Discretisation]:
    """Return the windows and the error of the time step in them; shorter ones where contacts make it large.

    Args:
        limit: `[nv]`, the tolerance; None: none is known.
        first: the coarsest factor on the sub-steps that is stable: as many windows fewer are looked at.
        delivered: the model, where `own` has another integrator.
    """
    seconds = CUTTING.window
    while True:
        cuts = windows_of(own, usable, group, use_qvel, seconds, first)
        steps = cuts(1).steps
        fine = CUTTING.finest(own, len(cuts(1)), steps)
        step = discretisation.measure(own, cuts, usable, fine, first=first, limit=limit, delivered=delivered)
        if not (contacts(own) and step.lottery) or steps == RULES.parts:
            return cuts, step
        seconds /= 2


def _looked_at(logs: Sequence[Log], robot: Robot, dt: float, say: Callable[[Look], None]) -> tuple[gate.Gate, Look]:
    """Run the gate after the look, which is faster and said at once; again where the gate refuses more logs."""
    sound = [log for log in logs if not single_log.unusable(log, dt, len(logs))]
    seen = looked(sound, robot)
    if sound:
        say(seen)
    found = gate.check(logs, robot.mj_model, dt)
    if 0 < len(found.usable) < len(sound):
        seen = looked(found.usable, robot)
        say(seen)
    return found, seen
