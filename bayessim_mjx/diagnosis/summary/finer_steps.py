"""What the simulator's time step is worth in the parameters: where they would go at finer steps.

A fit takes part of the integrator's error into its parameters. Where the posterior's mode goes to, on the same windows
simulated at a quarter of the step, tells three quarters of an error that is proportional to the step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.diagnosis.fitting.discretisation import refined
from bayessim_mjx.diagnosis.fitting.simulable import contacts
from bayessim_mjx.diagnosis.fitting.simulator import FAR, Simulator, physics_of
from bayessim_mjx.diagnosis.selection.budget import Progress
from bayessim_mjx.physics import staggered

Array = NDArray[np.float64]
# times as many steps as the fit took: a quarter of an error of first order is left, and extrapolated (Richardson 1911)
FINER = 4
FAR_OFF = 2.0  # standard deviations, beyond which a sentence gives a parameter's shift: a rule of thumb


@dataclass(frozen=True, eq=False)
class AtFinerSteps:
    """`shift`: `[k]`, what the values of the model's coordinates would change by at ever finer steps."""

    shift: Array

    def covariance(self, known: int) -> Array:
        """`[k, k]`, of all parameters together: known ones are moved by the shift, whose last part is extrapolated.

        Effects' numbers stay, as those of a simulator with this step, and are off by it one way or the other.
        """
        off = np.where(np.arange(len(self.shift)) < known, self.shift / FINER, self.shift)
        return np.outer(off, off)

    def notes(self, found: Findings, together: Array) -> list[str]:
        """For the warnings; together: `[k, k]`, covariance without it."""
        fit, own = found.model.fit, {c.name for effect in found.model.effects for c in effect.coordinates}
        each = zip(fit.coordinates, fit.values, self.shift, np.sqrt(np.diag(together)), strict=True)
        parts = [
            f"{c.name} {value + shift:.3g} in place of {value:.3g} {c.unit}".rstrip()
            for c, value, shift, sd in each
            if c.name in own and abs(shift) > FAR_OFF * sd
        ]
        text = "the time step is in the parameters: at ever finer steps they would be"
        return [f"{text} {', '.join(parts)} (counted in their intervals)"] if parts else []


def stage(found: Findings, say: Progress) -> Findings:
    """With what finer steps change; nothing where something can touch, or by an integrator of higher order."""
    robot = found.setup.robot
    if not staggered(robot.mj_model) or contacts(found.setup.physics):
        return found
    shift = _shift(found)
    return found if shift is None else found.having(AtFinerSteps(shift))


def _shift(found: Findings) -> Array | None:
    """Of the coordinates; None where finer steps cannot be simulated."""
    fit, fitter = found.model.fit, found.setup.fitter
    simulator = _simulator(found)
    space, small = found.setup.physics.space, simulator.physics.space
    theta = fitter.vector(fit.coordinates, fit.values)[[space.index(name) for name in small.names]]
    errors = simulator.run(theta[None], fit.offsets[None])
    if np.abs(errors).max() >= FAR:
        return None
    step = found.selection.estimated.step
    return (step(fitter.whiten(errors)[0]) - step(fit.r)) * FINER / (FINER - 1)


def _simulator(found: Findings) -> Simulator:
    """The windows at finer steps, with the named effects only: a small program."""
    setup, named = found.setup, {e.effect for e in found.model.effects}
    cut, step = setup.fitter.simulator.windows, float(setup.robot.mj_model.opt.timestep)
    effects = [e for e in setup.physics.effects if e.name in named]
    physics = physics_of(refined(setup.robot, step / FINER), cut.dt, effects)
    starts = list(zip(cut.log.tolist(), cut.start.tolist(), strict=True))
    own = windows.cut(
        setup.logs, physics.mj_model, cut.dt, physics.substeps, cut.steps, limit=len(cut), starts=starts, centred=False
    )
    return Simulator(physics, own)
