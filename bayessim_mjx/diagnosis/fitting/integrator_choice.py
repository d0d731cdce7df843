"""The integrator and the time step of a diagnosis: the coarsest stable step, and RK4 where nothing can touch.

What no sub-steps of a first-order integrator remove would count as noise, and in a noise that is larger than the
sensors' what two integrators differ by (a fraction of a millisecond, usually) is found as an effect.

Stability is that of MuJoCo's own step, linearised at states of the logs, without contacts and limits: the solver keeps
those stable by itself. Stiff springs, servo loops and nearly massless axes need fine steps.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.cutting import CUTTING
from bayessim_mjx.diagnosis.fitting.delivered import Delivered
from bayessim_mjx.diagnosis.fitting.discretisation import Discretisation, simulated
from bayessim_mjx.diagnosis.fitting.observation import Stepper
from bayessim_mjx.diagnosis.fitting.robot import Robot, contacts
from bayessim_mjx.effects.servo_damping import ServoDamping
from bayessim_mjx.effects.servo_stiffness import ServoStiffness
from bayessim_mjx.effects.support.site import element_names
from bayessim_mjx.logs.log import Channels, Log
from bayessim_mjx.physics.native import rubbing

Array = NDArray[np.float64]
# (robot's physics, first=coarsest stable factor) -> (the windows, the error of the time step)
GAINS = (ServoStiffness, ServoDamping)  # kp and kv: a servo's least known numbers, which move it in time
Measured = Callable[..., tuple[Any, Discretisation]]
TOO_LONG = "the model's time step shows beside the noise, and in the time given nothing finer can be searched with"
RK4, IMPLICITFAST = int(mujoco.mjtIntegrator.mjINT_RK4), int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
FINEST = 64  # sub-steps per step of the model that are tried; a rule of thumb


@dataclass(frozen=True)
class Step:
    """The coarsest stable step.

    Attributes:
        timestep: s, the model's.
        factor: sub-steps of the diagnosis are at most `timestep / factor`.
        integrator: MuJoCo's number of the one to use; changed: it is not the model's.
        joint: which asks for it; "" where the model's own step is stable.
        reached: whether any step up to the finest is stable.
    """

    timestep: float
    factor: int
    integrator: int
    changed: bool
    joint: str
    reached: bool

    def robot(self, robot: Robot) -> Robot:
        """Return the robot with the integrator."""
        if not self.changed:
            return robot
        model = copy.copy(robot.mj_model)
        model.opt.integrator = self.integrator
        return dataclasses.replace(robot, mj_model=model)


def coarsest_stable(model: mujoco.MjModel, logs: Sequence[Log], precise: bool = False) -> Step:
    """Return the coarsest stable step of a model, with its own integrator, or implicitfast where that may be coarser.

    Args:
        precise: RK4 goes before both.
    """
    own, h = int(model.opt.integrator), float(model.opt.timestep)
    fluid = model.opt.density > 0 or model.opt.viscosity > 0  # MJX has no fluid forces by implicitfast
    kinds = dict.fromkeys([RK4] * precise + [own] + [IMPLICITFAST] * (not fluid))
    cases = {kind: list(_cases(model, logs, kind)) for kind in kinds}
    factors = {kind: max((case.factor(h) for case in cases[kind]), default=1) for kind in kinds}
    best = min(kinds, key=lambda kind: factors[kind])
    joint = "" if factors[own] == 1 else _joint(model, cases[own], h)
    return Step(h, min(factors[best], FINEST), best, best != own, joint, factors[best] <= FINEST)


@dataclass(frozen=True)
class Choice:
    """How the robot is simulated.

    Attributes:
        robot: with the integrator of the diagnosis; stable: its coarsest stable step.
        cuts, worth: the windows, and the error of the time step in them.
        better: why no more accurate integrator than the model's is used, where one would matter.
    """

    robot: Robot
    stable: Step
    cuts: Any
    worth: Discretisation
    better: tuple[str, ...] = ()


def choose(robot: Robot, dt: float, logs: Sequence[Log], measured: Measured, left: float = np.inf) -> Choice:
    """Return the coarsest stable step; where nothing can touch and the logs have noise, by RK4 if there is time.

    There frictionloss needs no solver either.

    Logs of a simulation may have been made by the model's own integrator.

    Args:
        left: s that one simulation of all windows may take, for the search to end in time.
    """
    own, names = robot.physics(dt), element_names(robot.mj_model, "actuator")
    carried = {k: tuple(n for i, n in enumerate(names) if k.carries(robot.mj_model, i)) for k in GAINS}
    gains = [kind(where=where) for kind, where in carried.items() if where]  # what `command_shift` has beside its shift
    precise = not contacts(own) and not simulated(own.mj_model, logs).all()
    robot = dataclasses.replace(robot, rubbing=rubbing(robot.mj_model) if precise else ())
    stable = coarsest_stable(own.mj_model, logs, precise)
    better, more = stable.robot(robot), stable.changed and stable.integrator == RK4
    model = copy.copy(robot.mj_model)
    model.opt.timestep = own.mj_model.opt.timestep
    as_is = Delivered(model, dt)
    delivered = as_is if more and not stable.joint and as_is.plays(logs, robot.space) else None
    cuts, worth = measured(better.physics(dt, gains), first=stable.factor, delivered=delivered)
    if not more or worth.errors is None or worth.errors.seconds < left:
        return Choice(better, stable, cuts, worth)
    stable = coarsest_stable(own.mj_model, logs)
    robot = stable.robot(robot)
    return Choice(robot, stable, *measured(robot.physics(dt, gains), first=stable.factor), better=(TOO_LONG,))


@dataclass(frozen=True)
class _Case:
    """A state in a log, in which nothing touches: how steps of an integrator grow there; grows: 1/s, the motion."""

    stepper: Stepper
    qpos: Array
    qvel: Array
    row: int
    grows: float

    def step(self, h: float) -> Array:
        """One step of h s, linearised: `[2 nv, 2 nv]`."""
        self.stepper.reset()
        return self.stepper.linearised(self.qpos, self.qvel, self.row, h)[2]

    def factor(self, h: float) -> int:
        """Return the power of two to divide h by for errors to grow by e at most in a window, or 2 FINEST."""
        factor = 1
        while factor <= FINEST and not _radius(self.step(h / factor)) < np.exp(
            (self.grows + 1 / CUTTING.window) * h / factor
        ):
            factor *= 2
        return factor


def _radius(G: Array) -> float:
    return float(np.abs(np.linalg.eigvals(G)).max()) if np.isfinite(G).all() else np.inf


def _joint(model: mujoco.MjModel, cases: Sequence[_Case], h: float) -> str:
    """Return the dof that moves most in the mode that grows fastest."""
    worst = max((case.step(h) for case in cases), key=_radius)
    values, modes = np.linalg.eig(worst)
    mode = np.abs(modes[model.nv :, int(np.argmax(np.abs(values)))])
    return Channels.of(model).qvel[int(np.argmax(mode))]


def _cases(model: mujoco.MjModel, logs: Sequence[Log], integrator: int) -> Iterator[_Case]:
    """As many states of the logs as there are windows at least."""
    model = copy.copy(model)
    model.opt.integrator = integrator
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    each = max(1, CUTTING.fewest // max(len(logs), 1))
    for log in logs[: CUTTING.fewest]:
        stepper = Stepper(model, log)
        for row in np.linspace(0, len(log) - 1, each + 2).astype(int)[1:-1]:
            at = log.qpos[row], log.qvel[row], int(row)
            yield _Case(stepper, *at, _growth(stepper.accelerations(*at)))


def _growth(accelerations: Array) -> float:
    """1/s, by which motion grows, of accelerations by positions and velocities `[nv, 2 nv]`."""
    n = len(accelerations)
    A = np.vstack([np.eye(n, 2 * n, n), accelerations])
    return max(float(np.linalg.eigvals(A).real.max()), 0.0)
