"""Multiple shooting: bounded Levenberg-Marquardt for many candidate models in lockstep, so that one call simulates all.

Each job has its own free coordinates; parameters common to all and start states keep the columns of the base fit until
a refresh. Residuals are whitened by the noise; windows in which the simulation is far off everywhere are weighted down.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.quadratic import Quadratic, Starts, blocks, eliminate, held_out, solve
from bayessim_mjx.diagnosis.fitting.simulator import Simulator

Array = NDArray[np.float64]
START_STEP = 0.2  # of the spread of the start states, for their finite differences


@dataclass(eq=False)
class Job:
    """One model being fitted.

    Attributes:
        coordinates: free ones; values: `[k]`; offsets: `[W, s]` of the start states.
        r: whitened residuals `[W, n]`; A: `[W, n, k]`, minus their derivatives; B: `[W, n, s]` by the start states.
        weight: `[W]`; cost: weighted, priors included; damping: Levenberg's.
        promise: by how much the step now tried would lower the cost if the model were linear.
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
    history: list[float] = field(default_factory=list)
    reach: Array = field(default_factory=lambda: np.ones(1))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.coordinates)

    def prior(self) -> tuple[Array, Array, Array, Array]:
        """(precision, pull, room below, room above), `[k]` each."""
        precision = np.array([c.precision for c in self.coordinates])
        neutral = np.array([c.neutral for c in self.coordinates])
        low = np.array([c.low for c in self.coordinates]) - self.values
        high = np.array([c.high for c in self.coordinates]) - self.values
        return precision, precision * (neutral - self.values), low, high

    def penalty(self, values: Array) -> float:
        return float(sum(c.precision * (v - c.neutral) ** 2 for c, v in zip(self.coordinates, values, strict=True)))

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
        return np.moveaxis((r[None] - shifted) / h[:, None, None], 0, -1)

    def begin(
        self, coordinates: Sequence[Coordinate], values: Array | None = None, offsets: Array | None = None
    ) -> Job:
        """A job with fresh columns for everything."""
        coordinates = tuple(coordinates)
        values = np.array([c.neutral for c in coordinates]) if values is None else np.asarray(values, float)
        offsets = np.zeros((len(self.simulator.windows), len(self.spread))) if offsets is None else offsets
        job = Job(coordinates, values, offsets, np.empty(0), np.empty(0), np.empty(0), np.ones(len(offsets)), np.inf)
        return self.refresh(job)

    def refresh(self, job: Job) -> Job:
        """Residuals and all columns anew at the job's point."""
        theta = self.vector(job.coordinates, job.values)
        thetas, steps = self._differences(job.coordinates, job.values, range(len(job.coordinates)))
        offsets = np.repeat(job.offsets[None], 1 + len(thetas), 0)
        r = self.whiten(self.simulator.run(np.stack([theta, *thetas]), offsets))
        job.r = r[0]
        job.A = _columns(r[0], r[1:], steps)
        job.B = self.start_columns(theta, job.offsets, job.r)
        job.weight = weights(job)
        job.cost = self.cost(job, job.r, job.offsets, job.values)
        return job

    def cost(self, job: Job, r: Array, offsets: Array, values: Array) -> float:
        return float(job.weight @ self._each(r, offsets)) + job.penalty(values)

    def _each(self, r: Array, offsets: Array) -> Array:
        return np.sum(r**2, 1) + np.sum((offsets / self.spread) ** 2, 1)

    def derive(self, job: Job, extra: Sequence[Coordinate], values: Array) -> Job:
        """A job with more coordinates, starting at `values` for these; its first columns come with the first step."""
        own = tuple(job.coordinates) + tuple(extra)
        blank = np.zeros((*job.r.shape, len(extra)))
        start, columns = np.concatenate([job.values, values]), np.concatenate([job.A, blank], 2)
        return Job(own, start, job.offsets, job.r, columns, job.B, job.weight, np.inf)

    def iterate(
        self,
        jobs: Sequence[Job],
        iterations: int,
        fresh: Callable[[Job], Sequence[int]],
        tolerance: float = 1e-3,
        progress: Callable[[int], None] | None = None,
        keep: Callable[[int, Sequence[Job]], Sequence[Job]] | None = None,
    ) -> None:
        """Levenberg-Marquardt in lockstep, in place.

        Args:
            jobs: to be fitted; iterations: steps at most.
            fresh: columns of a job that are differenced anew at every point.
            tolerance: a job rests when three steps gain less than this share of its cost.
            progress: told how many jobs still run.
            keep: (steps made, running jobs) -> those worth going on with.
        """
        state = {id(j): (j.values.copy(), j.offsets.copy()) for j in jobs}  # trial points
        active = list(jobs)
        for made in range(iterations + 1):
            if not active:
                return
            plans, thetas, offsets = [], [], []
            for job in active:
                values, x = state[id(job)]
                which = list(fresh(job))
                shifted, steps = self._differences(job.coordinates, values, which)
                plans.append((job, which, steps))
                thetas += [self.vector(job.coordinates, values), *shifted]
                offsets += [x] * (1 + len(shifted))
            r = self.whiten(self.simulator.run(np.stack(thetas), np.stack(offsets)))
            at = 0
            for job, which, steps in plans:
                own = r[at : at + 1 + len(which)]
                at += 1 + len(which)
                self._accept(job, *state[id(job)], own, which, steps)
                state[id(job)] = self._propose(job)
            active = [j for j in active if not _settled(j, tolerance)]
            active = active if keep is None else list(keep(made, active))
            if progress is not None:
                progress(len(active))

    def _accept(
        self, job: Job, values: Array, x: Array, r: Array, which: Sequence[int], steps: Sequence[float]
    ) -> None:
        cost = self.cost(job, r[0], x, values)
        if cost < job.cost or not np.isfinite(job.cost):
            if np.isfinite(job.cost) and len(which) < len(job.coordinates):
                _broyden(job, values, x, r[0], which)
            job.values, job.offsets, job.r, job.cost = values, x, r[0], cost
            job.A = job.A.copy()
            job.A[:, :, which] = _columns(r[0], r[1:], steps)
            job.damping = max(job.damping / 5, 1e-7)
            job.reach = np.minimum(2 * job.reach, 1.0)
        else:
            job.damping *= 6
            # near a contact a start state's full step may be far too long, and no damping of the parameters shortens it
            harmed = self._each(r[0], x) > self._each(job.r, job.offsets)
            job.reach = np.where(harmed, 0.25, 1.0) * job.reach
        job.history.append(job.cost)

    def _propose(self, job: Job) -> tuple[Array, Array]:
        q, starts = job.quadratic(self.spread)
        g, S = q.weighted(job.weight)
        precision, pull, low, high = job.prior()
        S = S + np.diag(precision)
        p = solve(S + job.damping * np.diag(np.diag(S)), g + pull, low, high)
        by_starts = job.cost - job.penalty(job.values) - float(job.weight @ q.c)
        job.promise = by_starts + float(2 * (g + pull) @ p - p @ S @ p)
        return job.values + p, job.offsets + np.reshape(job.reach, (-1, 1)) * starts.step(job.A, p)

    def scores(self, job: Job, group: NDArray[np.int64] | None = None) -> tuple[Array, Array]:
        """Held-out costs `[W]` (unweighted) and estimates without each condition, relative to the fit `[G, k]`."""
        q, starts = job.quadratic(self.spread)
        precision, pull, low, high = job.prior()
        group = self.simulator.windows.group if group is None else group
        watched = np.arange(len(self.base), len(job.coordinates))
        split = functools.partial(blocks, q, starts, job.r, job.A)
        return held_out(q, group, job.weight, precision, pull, low, high, watched, split)


def _columns(r: Array, shifted: Array, steps: Sequence[float]) -> Array:
    """A `[W, n, k]`: minus the derivative of the residual."""
    if not len(steps):
        return np.zeros((*r.shape, 0))
    return np.moveaxis((r[None] - shifted) / np.asarray(steps)[:, None, None], 0, -1)


def _broyden(job: Job, values: Array, x: Array, r: Array, which: Sequence[int]) -> None:
    """Rank-one correction of the columns that are not differenced anew, so that they explain the step just made."""
    dp = values - job.values
    kept = [i for i in range(len(dp)) if i not in set(which)]
    if not kept or not np.any(dp[kept]):
        return
    missed = (job.r - r) - job.A @ dp - np.einsum("wns,ws->wn", job.B, x - job.offsets)
    scaled = dp[kept] / np.array([job.coordinates[i].high - job.coordinates[i].low for i in kept]) ** 2
    weight = scaled / max(float(scaled @ dp[kept]), 1e-300)
    share = float(scaled @ dp[kept]) / max(float(np.sum((dp / [c.high - c.low for c in job.coordinates]) ** 2)), 1e-300)
    job.A[:, :, kept] += share * missed[:, :, None] * weight[None, None, :]


def weights(job: Job) -> Array:
    """Huber weights of whole windows: those far worse than the rest (a stop, a stick phase, a push) count less."""
    each = np.sqrt(np.mean(job.r**2, 1))
    limit = 4.0 * np.median(each) + 1e-12
    return np.minimum(1.0, limit / np.maximum(each, 1e-300))


def _settled(job: Job, tolerance: float) -> bool:
    """No step is promising, or those that were accepted gain little; refused ones are no sign of convergence."""
    if job.promise < tolerance * abs(job.cost) / 3 or job.damping > 1e6:
        return True
    last = list(dict.fromkeys(job.history))[-4:]  # accepted costs
    return len(last) == 4 and np.isfinite(last[0]) and last[0] - last[-1] < tolerance * abs(last[-1])
