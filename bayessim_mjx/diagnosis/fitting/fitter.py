"""Multiple shooting: bounded Levenberg-Marquardt for many candidate models in lockstep, so that one call simulates all.

A fit is a value: a step gives a new one. Each has its own free coordinates; parameters common to all and start states
keep the columns of the base fit until a refresh. Residuals are whitened by the noise; windows in which the simulation
is far off everywhere are weighted down.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting import quadratic
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fit import REACH, Fit, broyden, settled
from bayessim_mjx.diagnosis.fitting.quadratic import blocks, held_out, solve, weights
from bayessim_mjx.diagnosis.fitting.simulator import Simulator

__all__ = ["Fit", "Fitter", "weights"]
Array = NDArray[np.float64]
# Of the largest curvature by ranges, by which each number is damped. Measured at 3240de4: of 0, .003, .01, .03, .1, .3
# and 1, from four far starts of a payload and a bias, 2, 2, 4, 2, 3, 4 and 3 arrive; 1 finds no limit beside play
DAMPED = 0.01
NUMBERS = 2  # independent ones that a window's channel holds: a missing force is a smooth curve; a rule of thumb
# Share of the promised gain from which on a step shows that its columns hold (Fletcher, Practical Methods of
# Optimization, 1987, sec. 5.1)
TRUSTED = 0.75


@dataclass(frozen=True, eq=False)
class Trial:
    """A point that a fit tried.

    Attributes:
        values: `[k]`; offsets: `[W, s]`; r: `[W, n]`, residuals; cost.
        better: whether it is better than where the fit is; predicted: whether it gains what the columns promised.
        which: columns that were differenced anew, at a better point; columns: `[W, n, k]`, these.
    """

    values: Array
    offsets: Array
    r: Array
    cost: float
    better: bool
    predicted: bool
    which: Sequence[int]
    columns: Array


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
        if simulator.starts > len(windows.spread):  # of motors, at first: a joint's speed, and a control step of it
            speed = np.sqrt(np.mean(np.asarray(windows.batch.qvel, np.float64) ** 2, axis=(0, 1)))
            motors = np.maximum(np.concatenate([windows.dt * speed, speed]), windows.spread)
            self.spread = np.concatenate([windows.spread, motors])
        self.measured = windows.measured / windows.measured.mean()  # by which windows weigh, one on average
        self.size = windows.steps * int(self.used.sum())
        joints = int((np.isfinite(windows.sigma_q) | np.isfinite(windows.sigma_v)).sum())
        self.numbers = float(NUMBERS * len(windows) * joints)

    def whiten(self, errors: Array) -> Array:
        """`[..., W, H, channels]` -> `[..., W, n]`."""
        r = (errors if self.used.all() else errors[..., self.used]) / self.sigma
        return np.clip(r, -1e6, 1e6, out=r).reshape(*errors.shape[:-2], -1)

    def rate(self) -> Array:
        """`[W, n]`, how fast what residuals compare changes by the logs, noise sd a second."""
        cut = self.simulator.windows
        rows = cut.start[:, None] + 1 + np.arange(cut.steps)
        speed = np.stack([cut.logs[log].qvel[own] for log, own in zip(cut.log, rows, strict=True)])
        both = np.concatenate([speed, np.gradient(speed, cut.dt, axis=1)], 2)
        return np.asarray((both[..., self.used] / self.sigma).reshape(len(speed), -1))

    def vector(self, coordinates: Sequence[Coordinate], values: Array) -> Array:
        """theta `[P]`."""
        theta = self.theta.copy()
        for c, v in zip(coordinates, values, strict=True):
            theta[list(c.index)] = v
        return theta

    def _shifts(self, fit: Fit, values: Array, which: Sequence[int], steps: Array) -> list[Array]:
        """Thetas with one number moved by its step each."""
        return [self.vector(fit.coordinates, values + np.where(np.arange(len(values)) == i, steps, 0.0)) for i in which]

    def start_columns(
        self,
        theta: Array,
        offsets: Array,
        r: Array,
        spread: Array | None = None,
        which: NDArray[np.bool_] | None = None,
    ) -> Array:
        """B `[W, n, s]` at theta; which: `[s]`, columns that are simulated, None: all that act; the others are 0."""
        spread = self.spread if spread is None else spread
        h = quadratic.RULES.change * np.clip(spread, self.spread / REACH, self.spread * REACH)
        own = np.flatnonzero(self.simulator.loose(theta) if which is None else which)
        moved = offsets[None] + np.diag(h)[own, None, :]
        B = np.zeros((*r.shape, len(h)))
        shifted = self.whiten(self.simulator.run(np.repeat(theta[None], len(own), 0), moved))
        B[:, :, own] = quadratic.columns(r, shifted, h[own])
        return B

    def begin(
        self, coordinates: Sequence[Coordinate], values: Array | None = None, offsets: Array | None = None
    ) -> Fit:
        """Return a fit with fresh columns for everything."""
        coordinates = tuple(coordinates)
        values = np.array([c.neutral for c in coordinates]) if values is None else np.asarray(values, float)
        offsets = np.zeros((len(self.simulator.windows), len(self.spread))) if offsets is None else offsets
        none, even = np.empty(0), np.ones(len(offsets))
        return self.refresh(Fit(coordinates, values, offsets, none, none, none, even, np.inf, spread=self.spread))

    def refresh(self, fit: Fit) -> Fit:
        """Residuals and all columns anew at the fit's point: central differences where ranges have room."""
        theta, every = self.vector(fit.coordinates, fit.values), range(len(fit.values))
        loose = self.simulator.loose(theta)
        fit = replace(fit, offsets=np.where(loose, fit.offsets, 0.0), spread=np.where(loose, fit.spread, self.spread))
        steps = fit.inward(fit.values, fit.steps())
        both = [i for i in every if fit.coordinates[i].low <= fit.values[i] - steps[i] <= fit.coordinates[i].high]
        thetas = [theta, *self._shifts(fit, fit.values, every, steps), *self._shifts(fit, fit.values, both, -steps)]
        r = self.whiten(self.simulator.run(np.stack(thetas), np.repeat(fit.offsets[None], len(thetas), 0)))
        A = quadratic.columns(r[0], r[1 : 1 + len(every)], steps)
        A[:, :, both] = (A[:, :, both] + quadratic.columns(r[0], r[1 + len(every) :], -steps[both])) / 2
        B, weight = self.start_columns(theta, fit.offsets, r[0], fit.spread), weights(r[0]) * self.measured
        motors = np.flatnonzero(loose)[len(self.simulator.windows.spread) :]
        spread = quadratic.learnt_spread(r[0], B, fit.offsets, fit.spread, weight, motors)
        new = replace(fit, r=r[0], A=A, B=B, weight=weight, spread=spread)
        new = replace(new, doubt=self._doubt(self._data(new, new.r, new.offsets)))
        return replace(new, cost=self.cost(new, new.r, new.offsets, new.values))

    def anew(self, fit: Fit) -> Fit:
        """All columns anew where the fit is, by one-sided differences: a step that is refused needs no better ones."""
        theta, steps = self.vector(fit.coordinates, fit.values), fit.inward(fit.values, fit.steps())
        A, B = fit.A, self.start_columns(theta, fit.offsets, fit.r, fit.spread)
        if len(steps):
            thetas = np.stack(self._shifts(fit, fit.values, range(len(steps)), steps))
            r = self.whiten(self.simulator.run(thetas, np.repeat(fit.offsets[None], len(thetas), 0)))
            A = quadratic.columns(fit.r, r, steps)
        return replace(fit, A=A, B=B, history=(*fit.history, fit.cost), damping=Fit.damping, reach=np.ones(1))

    def cost(self, fit: Fit, r: Array, offsets: Array, values: Array) -> float:
        """Of data and priors. Those of stated parameters belong to errors of unknown size: data * exp(prior / numbers).

        That is the likelihood with the size of the errors at its best, n log(data) + prior, as a cost.
        """
        data = self._data(fit, r, offsets)
        stated = fit.penalty(values, stated=True) / self.numbers
        return data + fit.penalty(values) + self.numbers * self._doubt(data) * float(np.expm1(min(stated, 50.0)))

    def _data(self, fit: Fit, r: Array, offsets: Array) -> float:
        return float(fit.weight @ _each(fit, r, offsets))

    def _doubt(self, data: float) -> float:
        """Squared misfit per independent number; under a perfect model the noise's own."""
        return max(data, float(self.size * len(self.simulator.windows))) / self.numbers

    def derive(self, fit: Fit, extra: Sequence[Coordinate], values: Array) -> Fit:
        """Return a fit with more coordinates, starting at `values`; its first columns come with the first step."""
        own = tuple(fit.coordinates) + tuple(extra)
        blank = np.zeros((*fit.r.shape, len(extra)))
        start, columns = np.concatenate([fit.values, values]), np.concatenate([fit.A, blank], 2)
        new = Fit(own, start, fit.offsets, fit.r, columns, fit.B, fit.weight, np.inf)
        return replace(new, doubt=fit.doubt, spread=fit.spread)

    def _with_motors(self, fit: Fit) -> Fit:
        """Return a new fit with columns of motors that its first point sets loose."""
        if np.isfinite(fit.cost):
            return fit
        theta, count = self.vector(fit.coordinates, fit.values), len(self.simulator.windows.spread)
        new = self.simulator.loose(theta) & (np.arange(len(self.spread)) >= count) & ~fit.B.any((0, 1))
        if not new.any():
            return fit
        r = self.whiten(self.simulator.run(theta[None], fit.offsets[None]))[0]
        return replace(fit, B=fit.B + self.start_columns(theta, fit.offsets, r, fit.spread, new))

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
        now = [self._with_motors(fit) for fit in fits]
        trial = [(f.values, f.offsets) for f in now]
        running: Sequence[int] = range(len(now))
        old = {i for i in running if not np.isfinite(now[i].cost)}  # fits with columns of a point before
        for made in range(iterations + 1):
            if not running:
                return now
            asked = {i: list(fresh(now[i])) for i in running}
            for i, tried in self._tried(now, trial, asked).items():
                if tried.better or i not in old:
                    now[i] = self._stepped(now[i], tried)
                    old |= {i} if tried.better else set()
                else:
                    now[i] = self.anew(now[i])
                    old -= {i}
                now[i], trial[i] = self._propose(now[i])
            running = [i for i in running if not settled(now[i], tolerance)]
            running = running if keep is None else keep(made, now, running)
            if progress is not None:
                progress(len(running))
        return now

    def _tried(
        self, fits: Sequence[Fit], trial: Sequence[tuple[Array, Array]], asked: Mapping[int, Sequence[int]]
    ) -> dict[int, Trial]:
        """Simulate trial points, and columns at better ones that old columns did not predict.

        An accelerator simulates both in one call. On a CPU each world costs as much in a small call as in a large one.

        Args:
            asked: {fit: columns that are differenced anew}.
        """
        apart = getattr(self.simulator, "apart", False)
        found = self._simulated(fits, {i: (*trial[i], () if apart else which) for i, which in asked.items()})
        tried = {i: self._trial(fits[i], trial[i], parts) for i, parts in found.items()}
        new = {i: (*trial[i], asked[i]) for i, one in tried.items() if apart and one.better and not one.predicted}
        for i, (moved, which, steps) in self._simulated(fits, new, alone=True).items():
            tried[i] = replace(tried[i], which=which, columns=quadratic.columns(tried[i].r, moved, steps))
        return tried

    def _simulated(
        self, fits: Sequence[Fit], points: Mapping[int, tuple[Array, Array, Sequence[int]]], alone: bool = False
    ) -> dict[int, tuple[Array, Sequence[int], Array]]:
        """{fit: (residuals, columns, their steps)} in one call: of points and shifted ones; alone: of those only.

        Args:
            points: {fit: (values, offsets, columns that are differenced there)}.
        """
        thetas, offsets, sizes, steps = [], [], [], {}
        for i, (values, x, which) in points.items():
            moves = fits[i].inward(values, fits[i].usual)
            shifted, steps[i] = self._shifts(fits[i], values, which, moves), moves[list(which)]
            own = shifted if alone else [self.vector(fits[i].coordinates, values), *shifted]
            thetas += own
            offsets += [x] * len(own)
            sizes.append(len(own))
        if not thetas:
            return {}
        r = self.whiten(self.simulator.run(np.stack(thetas), np.stack(offsets)))
        parts = np.split(r, np.cumsum(sizes)[:-1])
        return {i: (part, points[i][2], steps[i]) for i, part in zip(points, parts, strict=True)}

    def _trial(self, fit: Fit, point: tuple[Array, Array], found: tuple[Array, Sequence[int], Array]) -> Trial:
        """Judge a trial point by its residuals (`r[0]`); the others are at shifted values."""
        (values, x), (r, which, steps) = point, found
        cost = self.cost(fit, r[0], x, values)
        gain, new = fit.cost - cost, not np.isfinite(fit.cost)
        better, predicted = gain > 0 or new, not new and gain > TRUSTED * fit.promise
        if predicted or not better:
            which, steps = (), steps[:0]
        return Trial(
            values, x, r[0], cost, better, predicted, which, quadratic.columns(r[0], r[1 : 1 + len(which)], steps)
        )

    def _stepped(self, fit: Fit, tried: Trial) -> Fit:
        """Return the fit at a trial point where that is better, else more damped where it was."""
        if tried.better:
            A = fit.A.copy()
            if np.isfinite(fit.cost) and len(tried.which) < len(fit.coordinates):
                broyden(A, fit, tried.values, tried.offsets, tried.r, tried.which)
            A[:, :, tried.which] = tried.columns
            doubt = self._doubt(self._data(fit, tried.r, tried.offsets))
            fit = replace(fit, values=tried.values, offsets=tried.offsets, r=tried.r, A=A, cost=tried.cost, doubt=doubt)
            damping, reach = max(fit.damping / 5, 1e-7), np.minimum(2 * fit.reach, 1.0)
        else:
            # near a contact a start state's full step may be far too long, and no damping of the parameters shortens it
            harmed = _each(fit, tried.r, tried.offsets) > _each(fit, fit.r, fit.offsets)
            damping, reach = fit.damping * 6, np.where(harmed, 0.25, 1.0) * fit.reach
        return replace(fit, damping=damping, reach=reach, history=(*fit.history, fit.cost))

    def _propose(self, fit: Fit) -> tuple[Fit, tuple[Array, Array]]:
        """Return (the fit with its next step's promise, the point to be tried next: values and offsets)."""
        q, starts = quadratic.eliminate(fit.r, fit.A, fit.B, fit.offsets, fit.spread, 1 / fit.reach - 1)
        g, S = q.weighted(fit.weight)
        precision, pull, low, high = fit.prior()
        S = S + np.diag(precision)
        p = solve(S + fit.damping * np.diag(_scale(fit, S)), g + pull, low, high)
        dx = starts.step(fit.A, p)
        there = fit.r - fit.A @ p - np.einsum("wns,ws->wn", fit.B, dx)
        gain = _each(fit, fit.r, fit.offsets) - _each(fit, there, fit.offsets + dx)
        promise = float(fit.weight @ gain) + float(2 * pull @ p - precision @ p**2)
        return replace(fit, promise=promise), (fit.values + p, fit.offsets + dx)

    def scores(self, fit: Fit, group: NDArray[np.int64] | None = None) -> tuple[Array, Array]:
        """Held-out costs `[W]` (unweighted) and estimates without each condition, relative to the fit `[G, k]`."""
        q, starts = fit.quadratic()
        precision, pull, low, high = fit.prior()
        group = self.simulator.windows.group if group is None else group
        watched = np.arange(len(self.base), len(fit.coordinates))
        split = functools.partial(blocks, q, starts, fit.r, fit.A)
        return held_out(q, group, fit.weight, precision, pull, low, high, watched, split)


def _each(fit: Fit, r: Array, offsets: Array) -> Array:
    """`[W]`, what windows with these residuals and start states cost."""
    return np.asarray(np.sum(r**2, 1) + np.sum((offsets / fit.spread) ** 2, 1))


def _scale(fit: Fit, S: Array) -> Array:
    """`[k]`, what a unit of damping adds to the curvatures: their own, and a share of the largest in units of ranges.

    Their own alone (Marquardt, J. SIAM 11, 1963) leaves undamped what hardly moves the residual, such as where across
    its plane a payload sits: it jumps from bound to bound, and its step's second order spoils all others' steps.
    """
    own = np.diag(S)
    width = np.array([c.high - c.low for c in fit.coordinates])
    return np.asarray(own + DAMPED * np.max(own * width**2, initial=0.0) / width**2)
