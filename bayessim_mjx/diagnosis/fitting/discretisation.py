"""What the simulator's own time step is worth in the windows: mended by finer sub-steps, the rest counted as noise.

Simulated without effects at sub-steps h, h/2 and h/4 from the same starts; errors against h -> 0 by Richardson. With
contacts what each halving changes is mostly when something touches, anew each time: it adds up as squares do, and the
root mean square of velocities that jump a little too early or late falls with the root of the sub-step.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting import quadratic
from bayessim_mjx.diagnosis.fitting.delivered import INTEGRATORS, Delivered
from bayessim_mjx.diagnosis.fitting.robot import Robot, contacts
from bayessim_mjx.diagnosis.fitting.substep_errors import Errors, held
from bayessim_mjx.diagnosis.fitting.windows import Windows
from bayessim_mjx.diagnosis.logcheck.noise import noise_free
from bayessim_mjx.diagnosis.statistics import AT_NOISE, of_one, of_rms
from bayessim_mjx.logs.log import Channels, Log
from bayessim_mjx.physics import Physics

Array = NDArray[np.float64]


FACTORS = (
    1,
    2,
    4,
)  # on the coarsest stable sub-steps: an order and a limit take three (Richardson 1911); any is chosen
# Noises up to which an error of the time step needs no finer sub-steps: beside it a model is at the noise. And share of
# the error that the finest have to leave where none is as fine; with contacts it falls with the root of the step
ENOUGH = float(np.sqrt(AT_NOISE**2 - 1))
# Share of what is taken for noise that is the sensors': with less the estimates themselves are too coarse, and windows
# with contacts are shortened. A rule of thumb, not counted
BELIEVED = 0.2


@dataclass(frozen=True, eq=False)
class Discretisation:
    """Errors of the time step. Channels are positions, then velocities (`[2 nv]`, rad and rad/s or m and m/s).

    Attributes:
        timestep: s, the model's; factor: sub-steps of the diagnosis are `timestep / factor`.
        order: of convergence, log2 of what halving the sub-step gains.
        own: error of the simulator as delivered (commands held, no correction) from the same starts.
        settled: and after the start states have adapted; left: of the diagnosis' sub-steps, likewise adapted.
        sigma: noise of the logs; floor: what the diagnosis takes for noise.
        simulated: `[nv]`, channels that show no noise at all: logs of a simulation.
        channels: names `[nv]`.
        errors: the windows simulated without effects, for what else is asked of them.
        limit: `[nv]`, the tolerance, rad or m; None: none is known.
        integrator: of the diagnosis; delivered: the model, where the diagnosis has another integrator.
    """

    timestep: float
    factor: int
    order: float
    own: Array
    settled: Array
    left: Array
    sigma: Array
    floor: Array
    simulated: NDArray[np.bool_]
    channels: tuple[str, ...]
    errors: Errors | None = None
    limit: Array | None = None
    integrator: str = ""
    delivered: Delivered | None = None

    def robot(self, robot: Robot) -> Robot:
        """Return the robot at the sub-steps of the diagnosis."""
        return robot if self.factor == 1 else refined(robot, self.timestep / self.factor)

    def noisier(self, cut: Windows) -> Windows:
        """Windows in which what cannot be removed is noise."""
        nv = len(self.channels)
        known = np.isfinite(self.floor[:nv])
        more = np.subtract(self.floor[:nv], self.sigma[:nv], where=known, out=np.zeros(nv))
        spread = cut.spread + np.concatenate([3 * more, 10 * more])  # as of windows with this noise
        return dataclasses.replace(cut, sigma_q=self.floor[:nv], sigma_v=self.floor[nv:], spread=spread)

    @property
    def believed(self) -> float:
        """Share of what is taken for noise that is the sensors' (median over channels), at least BELIEVED."""
        own = np.isfinite(self.sigma) & ~np.tile(self.simulated, 2)
        return max(float(np.median(self.sigma[own] / self.floor[own])), BELIEVED) if own.any() else 1.0

    @property
    def lottery(self) -> bool:
        """Whether contacts make these windows too long to tell anything."""
        known = np.isfinite(self.sigma)
        return bool(np.median(self.floor[known] / self.sigma[known]) >= 1 / BELIEVED)

    def in_gap(self, nominal: float, otherwise: float) -> dict[str, float]:
        """Return the share that the delivered time step makes of the squared gap above the noise, where one is there.

        Args:
            nominal, otherwise: rms in noise standard deviations as delivered, and as the diagnosis simulates.
        """
        if self.delivered is None:
            return {}
        closed = 0.0 if of_one(nominal**2).at_noise else of_rms(nominal, otherwise).closed
        return {"otherwise": otherwise, "share": max(closed, 0.0)}

    def to_dict(self) -> dict[str, Any]:
        """For diagnosis.json: numbers by channel, in noise units and physical ones."""
        nv = len(self.channels)

        def by(values: Array) -> dict[str, float]:
            return {n: float(v) for n, v in zip(self.channels, values, strict=True)}

        return {
            "timestep": self.timestep,
            "substep": self.timestep / self.factor,
            "integrator": self.integrator,
            "delivered": self.delivered.integrator if self.delivered else self.integrator,
            "order": self.order,
            "noises": by(self.own[:nv] / self.sigma[:nv]),
            "physical": by(self.own[:nv]),
            "left": by(self.left[:nv] / self.sigma[:nv]),
            "noise": by(self.sigma[:nv]),
            "floor": by(self.floor[:nv]),
            "simulated": {n: bool(s) for n, s in zip(self.channels, self.simulated, strict=True)},
        }


def refined(robot: Robot, timestep: float) -> Robot:
    """Return the robot with another timestep in its model, s."""
    model = copy.copy(robot.mj_model)
    model.opt.timestep = timestep
    return dataclasses.replace(robot, mj_model=model)


def measure(
    physics: Physics,
    cuts: Callable[[int], Windows],
    logs: Sequence[Log],
    most: int,
    *,
    first: int = 1,
    limit: Array | None = None,
    delivered: Delivered | None = None,
) -> Discretisation:
    """Return the errors of `physics` (without effects) in the windows, and the sub-steps for the diagnosis.

    Args:
        cuts: factor -> the same windows with commands for that many times the sub-steps.
        logs: as recorded.
        most: the finest factor that can be afforded.
        first: the coarsest factor that is stable.
        limit: `[nv]`, the tolerance, rad or m.
        delivered: the model, where `physics` has another integrator.
    """
    start, factors = cuts(first), [first * f for f in FACTORS]
    touching = contacts(physics)
    sigma, clean = np.concatenate([start.sigma_q, start.sigma_v]), simulated(physics.mj_model, logs)
    errors = Errors(physics, start, factors[-1])
    errors.start(sigma)
    coarse, mid, fine = (errors.run(cuts(f), f) for f in factors)
    plain = errors.run(held(start), first, corrected=False)
    settle = errors.settler(sigma)
    one, two = settle(coarse - mid), settle(mid - fine)
    gain = _gain(one / sigma, two / sigma)
    truth = fine if touching else fine + (fine - mid) / max(gain - 1, 1.0)
    off = plain - truth if delivered is None else delivered.step_error(start, errors.offsets, factors[-1])
    worth = _size(one, touching) * _all(gain, touching)
    at = {f: worth / gain**k for k, f in enumerate(factors)}
    settled = _size(settle(off), touching)
    base = np.hypot(sigma, np.tile(clean, 2) * settled)  # who simulated such logs may have used this step or another
    shown = ENOUGH * np.where(np.isfinite(base), base, 0.0)
    factor = _choose({f: float(np.max(at[f] / base)) for f in factors if f <= max(first, most)})
    return Discretisation(
        timestep=float(physics.mj_model.opt.timestep),
        factor=factor,
        order=float(np.log2(gain)),
        own=_size(off, touching),
        settled=settled,
        left=at[factor],
        sigma=sigma,
        floor=np.sqrt(base**2 + np.maximum(at[factor] ** 2 - shown**2, 0.0)),
        simulated=clean,
        channels=Channels.of(physics.mj_model).qvel,
        errors=errors,
        limit=limit,
        integrator=INTEGRATORS[int(physics.mj_model.opt.integrator)],
        delivered=delivered,
    )


def simulated(model: mujoco.MjModel, logs: Sequence[Log]) -> NDArray[np.bool_]:
    """`[nv]`, channels that show no noise at all."""
    return np.array([noise_free(logs, i) for i in model.jnt_qposadr[model.dof_jntid]])


def _gain(one: Array, two: Array) -> float:
    """Return the gain of halving the sub-step in the usual window: from hardly any (chaos) to the second order's 4."""
    size = [np.sqrt(np.sum(e**2, (1, 2))) for e in (one, two)]
    ratio = np.median(size[0] / np.maximum(size[1], 1e-12))
    return float(np.clip(ratio, 1.1, 4.0))


def _all(gain: float, touching: bool) -> float:
    """Return the change by all halvings, in that of the first one: alike, or with contacts each in a way of its own."""
    return float(1 / np.sqrt(1 - gain**-2.0)) if touching else gain / (gain - 1)


def _choose(error: dict[int, float]) -> int:
    """Return the coarsest factor that is fine enough; where none is, the finest, if that gains anything."""
    coarsest, finest = min(error), max(error)
    enough = [f for f, e in error.items() if e < ENOUGH]
    return min(enough) if enough else finest if error[finest] < ENOUGH * error[coarsest] else coarsest


def _size(error: Array, touching: bool) -> Array:
    """Root mean square `[channels]` of errors `[W, H, channels]`; windows far off count less, with contacts hardly."""
    each = np.mean(error**2, axis=1)
    usual = np.median(each, axis=0)
    return np.asarray(np.sqrt(usual if touching else np.mean(np.minimum(each, quadratic.RULES.far**2 * usual), axis=0)))
