"""The simulator's step for a diagnosis: stable, and where sub-steps do not suffice by Runge and Kutta's method."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

from bayessim_mjx.diagnosis.fitting import stability
from bayessim_mjx.diagnosis.fitting.discretisation import Discretisation, contacts
from bayessim_mjx.diagnosis.fitting.robot import Robot
from bayessim_mjx.logs.log import Log

# (robot's physics, first=coarsest stable factor, cheaper=see `Errors`) -> (the windows, what the time step is worth)
Measured = Callable[..., tuple[Any, Discretisation]]
STAGES = 4  # of Runge and Kutta's method, each as dear as a step
TOO_LONG = "the model's time step shows beside the noise, and in the time given nothing finer can be searched with"


def _always(seconds: float) -> bool:
    return True


@dataclasses.dataclass(frozen=True)
class Stepping:
    """How the robot is simulated.

    Attributes:
        robot: with the integrator of the diagnosis; stable: its coarsest stable step.
        cuts, worth: the windows, and what the time step is worth in them.
        better: told where the integrator was changed for its accuracy.
    """

    robot: Robot
    stable: stability.Step
    cuts: Any
    worth: Discretisation
    better: tuple[str, ...] = ()

    def said(self) -> list[str]:
        """What the user is told before anything is fitted."""
        return [*self.stable.sentences(), *self.better, *self.worth.beyond()]

    def warnings(self) -> list[str]:
        """What the model's own step costs, where it can be simulated at all."""
        return self.worth.warnings() if self.stable.factor == 1 else []


def stepping(
    robot: Robot, dt: float, logs: Sequence[Log], measured: Measured, affordable: Callable[[float], bool] = _always
) -> Stepping:
    """The coarsest stable step; where what no sub-steps remove shows, and nothing can touch, RK4.

    It would count as noise else, and in a noise that is larger than the sensors' what two integrators differ by (a
    fraction of a millisecond, usually) is found as an effect.

    Args:
        affordable: whether there is time for simulations of all windows that take so many seconds each.
    """
    stable = stability.needed(robot.physics(dt).mj_model, logs)
    robot = stable.robot(robot)
    own = robot.physics(dt)
    plain = Stepping(robot, stable, *measured(own, first=stable.factor))
    if not (plain.worth.beyond() or plain.worth.shows):
        return plain
    if contacts(own) or int(own.mj_model.opt.integrator) == stability.RK4:
        return plain
    if not affordable(STAGES * plain.worth.errors.seconds if plain.worth.errors else 0.0):
        return dataclasses.replace(plain, better=(TOO_LONG,))
    model = copy.copy(robot.mj_model)
    model.opt.integrator = stability.RK4
    other = dataclasses.replace(robot, mj_model=model)
    physics = other.physics(dt)
    needs = stability.needed(physics.mj_model, logs)
    if needs.changed or not needs.reached:
        return plain
    found = measured(physics, first=needs.factor, cheaper=plain.worth.errors)
    if found[1].nats > plain.worth.nats:
        return plain
    step = 1e3 * found[1].timestep / found[1].factor
    text = f"the diagnosis simulates by RK4 at {step:.3g} ms: sub-steps of the model's integrator show in the evidence"
    return Stepping(other, dataclasses.replace(needs, joint=stable.joint), *found, better=(text,))
