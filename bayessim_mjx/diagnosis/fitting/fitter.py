"""Multiple shooting: bounded Levenberg-Marquardt for many candidate models in lockstep, so that one call simulates all.

A fit is a value: a step gives a new one. Each has its own free coordinates; parameters common to all and start states
keep the columns of the base fit until a refresh. Residuals are whitened by the noise; windows in which the simulation
is far off everywhere are weighted down.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting import quadratic
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.quadratic import (
    Quadratic,
    Rest,
    Starts,
    blocks,
    eliminate,
    held_out,
    solve,
    weights,
)
from bayessim_mjx.diagnosis.fitting.simulator import Simulator

Array = NDArray[np.float64]
START_STEP = 0.2  # of the spread of the start states, for their finite differences
NUMBERS = 2  # independent ones that one channel of one window holds: a missing force shows as a smooth curve


@dataclass(frozen=True, eq=False)
class Fit:
    """A model fitted so far.

    Attributes:
        coordinates: free ones; values: `[k]`; offsets: `[W, s]` of the start states.
        r: whitened residuals `[W, n]`; A: `[W, n, k]`, minus their derivatives; B: `[W, n, s]` by the start states.
        weight: `[W]`; cost: weighted, priors included; damping: Levenberg's, of the next step.
        promise: by how much the next step would lower the cost if the model were linear; history: costs, step by step.
        doubt: squared misfit per independent number in the data, by which priors of stated parameters are multiplied.
        reach: `[W]`, share of their own steps that the start states make: less after one that did a window harm.
    """

    coordinates: tuple[Coordinate, ...]
    values: Array
    offsets: Array
    r: Array
    A: Array
    B: Array
    weight: Array
    cost: float
    damping: float = 1e-3
    promise: float = np.inf
    history: tuple[float, ...] = ()
    doubt: float = 1.0
    reach: Array = field(default_factory=lambda: np.ones(1))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.coordinates)

    def prior(self) -> tuple[Array, Array, Array, Array]:
        """(precision, pull, room below, room above), `[k]` each, in units of the cost."""
        precision = np.array([c.precision * (self.doubt if c.stated else 1.0) for c in self.coordinates])
        neutral = np.array([c.neutral for c in self.coordinates])
        low = np.array([c.low for c in self.coordinates]) - self.values
        high = np.array([c.high for c in self.coordinates]) - self.values
        return precision, precision * (neutral - self.values), low, high

    def belief(self) -> Array:
        """Precision of the priors `[k]` in units of the parameters, for use beside a curvature in nats."""
        return np.array([c.precision for c in self.coordinates])

    def penalty(self, values: Array, stated: bool = False) -> float:
        """Of the priors, as they are: of parameters that are stated, or of the others."""
        pairs = zip(self.coordinates, values, strict=True)
        return float(sum(c.precision * (v - c.neutral) ** 2 for c, v in pairs if c.stated == stated))

    def quadratic(self, spread: Array) -> tuple[Quadratic, Starts]:
        return eliminate(self.r, self.A, self.B, self.offsets, spread)


class Fitter:
    """Fits models on the windows of one simulator.

    Args:
        simulator: of all windows.
        base: coordinates free in every model.
        theta: `[P]`, where everything else stays (neutral).
    """

    def __init__(self, simulator: Simulator, base: Sequence[Coordinate], theta: Array) -> None:
        self.simulator, self.base, self.theta = simulator, tuple(base), np.asarray(theta, np.float64)
        windows = simulator.windows
        sigma = np.concatenate([windows.sigma_q, windows.sigma_v])
        self.used = np.isfinite(sigma)
        self.sigma = sigma[self.used]
        self.spread = windows.spread
        self.size = windows.steps * int(self.used.sum())
        joints = int((np.isfinite(windows.sigma_q) | np.isfinite(windows.sigma_v)).sum())
        self.numbers = float(NUMBERS * len(windows) * joints)

    def whiten(self, errors: Array) -> Array:
        """`[..., W, H, channels]` -> `[..., W, n]`."""
        r = errors[..., self.used] / self.sigma
        return np.clip(r, -1e6, 1e6).reshape(*errors.shape[:-2], -1)

    def vector(self, coordinates: Sequence[Coordinate], values: Array) -> Array:
        """theta `[P]`."""
        theta = self.theta.copy()
        for c, v in zip(coordinates, values, strict=True):
            theta[list(c.index)] = v
        return theta

    def _differences(
        self, coordinates: Sequence[Coordinate], values: Array, which: Sequence[int]
    ) -> tuple[list[Array], list[float]]:
        """Shifted thetas for the columns `which`, and the shifts."""
        thetas, steps = [], []
        for i in which:
            c = coordinates[i]
            step = c.step if values[i] + c.step <= c.high else -c.step
            shifted = values.copy()
            shifted[i] += step
            thetas.append(self.vector(coordinates, shifted))
            steps.append(step)
        return thetas, steps

    def start_columns(self, theta: Array, offsets: Array, r: Array) -> Array:
        """B `[W, n, s]` at theta."""
        s = offsets.shape[1]
        h = START_STEP * self.spread
        moved = offsets[None] + (np.eye(s) * h)[:, None, :]
        shifted = self.whiten(self.simulator.run(np.repeat(theta[None], s, 0), moved))
        return np.ascontiguousarray(np.moveaxis((r[None] - shifted) / h[:, None, None], 0, -1))

    def begin(
        self, coordinates: Sequence[Coordinate], values: Array | None = None, offsets: Array | None = None
    ) -> Fit:
        """A fit with fresh columns for everything."""
        coordinates = tuple(coordinates)
        values = np.array([c.neutral for c in coordinates]) if values is None else np.asarray(values, float)
        offsets = np.zeros((len(self.simulator.windows), len(self.spread))) if offsets is None else offsets
        fit = Fit(coordinates, values, offsets, np.empty(0), np.empty(0), np.empty(0), np.ones(len(offsets)), np.inf)
        return self.refresh(fit)

    def refresh(self, fit: Fit) -> Fit:
        """Residuals and all columns anew at the fit's point."""
        theta = self.vector(fit.coordinates, fit.values)
        thetas, steps = self._differences(fit.coordinates, fit.values, range(len(fit.coordinates)))
        offsets = np.repeat(fit.offsets[None], 1 + len(thetas), 0)
        r = self.whiten(self.simulator.run(np.stack([theta, *thetas]), offsets))
        B = self.start_columns(theta, fit.offsets, r[0])
        new = replace(fit, r=r[0], A=quadratic.columns(r[0], r[1:], steps), B=B, weight=weights(r[0]))
        new = replace(new, doubt=self._doubt(self._data(new, new.r, new.offsets)))
        return replace(new, cost=self.cost(new, new.r, new.offsets, new.values))

    def cost(self, fit: Fit, r: Array, offsets: Array, values: Array) -> float:
        """Of data and priors. Those of stated parameters belong to errors of unknown size: data * exp(prior / numbers).

        That is the likelihood with the size of the errors at its best, n log(data) + prior, as a cost.
        """
        data = self._data(fit, r, offsets)
        stated = fit.penalty(values, stated=True) / self.numbers
        return data + fit.penalty(values) + self.numbers * self._doubt(data) * float(np.expm1(min(stated, 50.0)))

    def _data(self, fit: Fit, r: Array, offsets: Array) -> float:
        return float(fit.weight @ self._each(r, offsets))

    def _doubt(self, data: float) -> float:
        """Squared misfit per independent number; under a perfect model the noise's own."""
        return max(data, float(self.size * len(self.simulator.windows))) / self.numbers

    def _each(self, r: Array, offsets: Array) -> Array:
        return np.sum(r**2, 1) + np.sum((offsets / self.spread) ** 2, 1)

    def derive(self, fit: Fit, extra: Sequence[Coordinate], values: Array) -> Fit:
        """A fit with more coordinates, starting at `values` for these; its first columns come with the first step."""
        own = tuple(fit.coordinates) + tuple(extra)
        blank = np.zeros((*fit.r.shape, len(extra)))
        start, columns = np.concatenate([fit.values, values]), np.concatenate([fit.A, blank], 2)
        return Fit(own, start, fit.offsets, fit.r, columns, fit.B, fit.weight, np.inf, doubt=fit.doubt)

    def iterate(
        self,
        fits: Sequence[Fit],
        iterations: int,
        fresh: Callable[[Fit], Sequence[int]],
        tolerance: float = 1e-3,
        progress: Callable[[int], None] | None = None,
        keep: Callable[[int, Sequence[Fit], Sequence[int]], Sequence[int]] | None = None,
    ) -> list[Fit]:
        """Levenberg-Marquardt in lockstep -> the fits where they came to, in order.

        Args:
            fits: to be fitted; iterations: steps at most.
            fresh: columns of a fit that are differenced anew at every point.
            tolerance: a fit rests when three steps gain less than this share of its cost.
            progress: told how many fits still run.
            keep: (steps made, all fits, indices of those that run) -> indices of those worth going on with.
        """
        now, trial = list(fits), [(f.values, f.offsets) for f in fits]
        running: Sequence[int] = range(len(now))
        for made in range(iterations + 1):
            if not running:
                return now
            plans, thetas, offsets = [], [], []
            for i in running:
                values, x = trial[i]
                which = list(fresh(now[i]))
                shifted, steps = self._differences(now[i].coordinates, values, which)
                plans.append((i, which, steps))
                thetas += [self.vector(now[i].coordinates, values), *shifted]
                offsets += [x] * (1 + len(shifted))
            r = self.whiten(self.simulator.run(np.stack(thetas), np.stack(offsets)))
            at = 0
            for i, which, steps in plans:
                own = r[at : at + 1 + len(which)]
                at += 1 + len(which)
                now[i] = self._stepped(now[i], *trial[i], own, which, steps)
                now[i], trial[i] = self._propose(now[i])
            running = [i for i in running if not _settled(now[i], tolerance)]
            running = running if keep is None else keep(made, now, running)
            if progress is not None:
                progress(len(running))
        return now

    def _stepped(
        self, fit: Fit, values: Array, x: Array, r: Array, which: Sequence[int], steps: Sequence[float]
    ) -> Fit:
        """The fit at a trial point where that is better, else more damped where it was."""
        cost = self.cost(fit, r[0], x, values)
        if cost < fit.cost or not np.isfinite(fit.cost):
            A = fit.A.copy()
            if np.isfinite(fit.cost) and len(which) < len(fit.coordinates):
                _broyden(A, fit, values, x, r[0], which)
            A[:, :, which] = quadratic.columns(r[0], r[1:], steps)
            doubt = self._doubt(self._data(fit, r[0], x))
            fit = replace(fit, values=values, offsets=x, r=r[0], A=A, cost=cost, doubt=doubt)
            damping, reach = max(fit.damping / 5, 1e-7), np.minimum(2 * fit.reach, 1.0)
        else:
            # near a contact a start state's full step may be far too long, and no damping of the parameters shortens it
            harmed = self._each(r[0], x) > self._each(fit.r, fit.offsets)
            damping, reach = fit.damping * 6, np.where(harmed, 0.25, 1.0) * fit.reach
        return replace(fit, damping=damping, reach=reach, history=(*fit.history, fit.cost))

    def _propose(self, fit: Fit) -> tuple[Fit, tuple[Array, Array]]:
        """(the fit with its next step's promise, the point to be tried next: values and offsets)."""
        q, starts = fit.quadratic(self.spread)
        g, S = q.weighted(fit.weight)
        precision, pull, low, high = fit.prior()
        S = S + np.diag(precision)
        p = solve(S + fit.damping * np.diag(np.diag(S)), g + pull, low, high)
        by_starts = self._data(fit, fit.r, fit.offsets) - float(fit.weight @ q.c)
        promise = by_starts + float(2 * (g + pull) @ p - p @ S @ p)
        moved = fit.offsets + np.reshape(fit.reach, (-1, 1)) * starts.step(fit.A, p)
        return replace(fit, promise=promise), (fit.values + p, moved)

    def scores(self, fit: Fit, group: NDArray[np.int64] | None = None) -> tuple[Array, Array]:
        """Held-out costs `[W]` (unweighted) and estimates without each condition, relative to the fit `[G, k]`."""
        q, starts = fit.quadratic(self.spread)
        precision, pull, low, high = fit.prior()
        group = self.simulator.windows.group if group is None else group
        watched = np.arange(len(self.base), len(fit.coordinates))
        split = functools.partial(blocks, q, starts, fit.r, fit.A)
        return held_out(q, group, fit.weight, precision, pull, low, high, watched, split)

    def told_alone(self, fit: Fit) -> list[bool]:
        """Of each condition, whether it alone tells a parameter of an effect (a limit that is reached there only)."""
        q, _ = fit.quadratic(self.spread)
        tells = Rest(q, fit.weight, *fit.prior()).told_by(np.arange(len(self.base), len(fit.coordinates)))
        group = self.simulator.windows.group
        return [tells(group == name) for name in np.unique(group)]


def _broyden(A: Array, fit: Fit, values: Array, x: Array, r: Array, which: Sequence[int]) -> None:
    """Rank-one correction, in place, of the columns A not differenced anew, so that they explain the step just made."""
    dp = values - fit.values
    kept = [i for i in range(len(dp)) if i not in set(which)]
    if not kept or not np.any(dp[kept]):
        return
    missed = (fit.r - r) - fit.A @ dp - np.einsum("wns,ws->wn", fit.B, x - fit.offsets)
    scaled = dp[kept] / np.array([fit.coordinates[i].high - fit.coordinates[i].low for i in kept]) ** 2
    weight = scaled / max(float(scaled @ dp[kept]), 1e-300)
    share = float(scaled @ dp[kept]) / max(float(np.sum((dp / [c.high - c.low for c in fit.coordinates]) ** 2)), 1e-300)
    A[:, :, kept] += share * missed[:, :, None] * weight[None, None, :]


def _settled(fit: Fit, tolerance: float) -> bool:
    """No step is promising, or those that were accepted gain little; refused ones are no sign of convergence."""
    if fit.promise < tolerance * abs(fit.cost) / 3 or fit.damping > 1e6:
        return True
    last = list(dict.fromkeys(fit.history))[-4:]  # accepted costs
    return len(last) == 4 and np.isfinite(last[0]) and last[0] - last[-1] < tolerance * abs(last[-1])
