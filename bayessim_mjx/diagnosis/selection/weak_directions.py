"""Directions in the parameters that the data hardly tell: their curvature as simulated, and what decides along them.

Where two laws do the same (a stronger motor on a heavier link), columns by finite differences still differ, by their
own errors, and these would pass for knowledge; and a fit stops wherever it came to such a ridge. Along it the costs are
simulated, and the fit moves to what was believed beforehand: known parameters near their nominal values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.quadratic import eliminate
from bayessim_mjx.diagnosis.selection.models import Model, scored

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rules:
    """When the data hardly tell a direction, and how it is followed."""

    uniform: float = 0.289  # standard deviation of a uniform distribution, of its range
    # of the largest curvature, in units of `uniform` ranges: there the columns' own errors may decide
    weak: float = 0.001
    involved: float = 0.1  # share of an effect's variance that comes from a direction
    # directions, moves along them, Newton steps in all others
    most: int = 6
    rounds: int = 2
    steps: int = 2
    shares: tuple[float, ...] = (1.0, 0.5, 0.25)  # of the step along the ridges, tried in turn
    reach: float = 1.5  # in units of `uniform`: how far along a direction is simulated, and nearer by,
    shows: float = 9.0  # where the columns promise so many times the rise that says nothing
    nats: float = 2.0  # of log-likelihood, and
    # of the cost: a smaller rise is no knowledge (single precision alone brings as much)
    rounding: float = 0.005


RULES = Rules()


@dataclass(frozen=True, eq=False)
class Ridges:
    """Curvature of the cost as simulated.

    Attributes:
        ways: `[k, m]`, unit steps in the parameters' units; differenced, simulated: `[m]`, by columns and by rollouts.
    """

    ways: Array
    differenced: Array
    simulated: Array

    def corrected(self, S: Array, scale: Array) -> Array:
        """`[k, k]` curvature S with what was simulated along the ridges, where that is less."""
        units = self.ways / scale[:, None] ** 2  # to covectors: ways are scale * (unit eigenvectors)
        return np.asarray(S - (units * np.maximum(self.differenced - self.simulated, 0.0)) @ units.T)


def scales(fit: Fit) -> Array:
    """Standard deviations `[k]` of uniform distributions over the parameters' ranges."""
    return np.array([RULES.uniform * (c.high - c.low) for c in fit.coordinates])


def beliefs(fit: Fit, base: int) -> Array:
    """Precisions `[k]` of what was believed beforehand: the first `base` parameters at least as a uniform one."""
    precision = fit.belief()
    precision[:base] = np.maximum(precision[:base], 1.0 / scales(fit)[:base] ** 2)
    return precision


def inflation(model: Model) -> float:
    """Squared misfit per effective residual: by how much less the data know than independent noise would tell."""
    count = model.fit.r.size
    return max(model.total / count, 0.5) * count / model.samples


def settled(fitter: Fitter, model: Model) -> tuple[Model, Ridges]:
    """The model moved along its ridges to what was believed beforehand, and the curvature along them there."""
    for _ in range(RULES.rounds):
        found = _Profile(fitter, model)
        moved = found.moved()
        if moved is None:
            return model, found.ridges
        model = moved
    return model, _Profile(fitter, model).ridges


class _Profile:
    """Costs along a model's ridges, minimised over the start states and all directions that the data do tell."""

    def __init__(self, fitter: Fitter, model: Model) -> None:
        self.fitter, self.model, self.fit = fitter, model, model.fit
        base, scale = len(fitter.base), scales(self.fit)
        q, _ = self.fit.quadratic(fitter.spread)
        _, S = q.weighted(self.fit.weight)
        curvature, V = np.linalg.eigh(scale[:, None] * S * scale)
        variance = V[base:] ** 2 / np.maximum(curvature, 1e-12 * curvature[-1])
        share = np.max(variance / np.maximum(variance.sum(1, keepdims=True), 1e-300), axis=0)
        flat = (curvature < RULES.weak * curvature[-1]) & (share > RULES.involved)
        self.weak = weak = np.flatnonzero(flat)[: RULES.most]
        self.every = scale[:, None] * V
        self.ways, self.columns = self.every[:, weak], self.fit.A @ self.every
        self.less = inflation(model)
        differenced = np.maximum(curvature[weak], 0.0)
        self.slopes, simulated = self._along(self._reaches(differenced, float(self.fit.weight @ q.c)))
        self.ridges = Ridges(self.ways, differenced, simulated)

    def _reaches(self, curvature: Array, cost: float) -> list[tuple[float, ...]]:
        """How far along each way is simulated.

        Far away a law may have lost all it does (a joint that does not move any more), and costs rise no longer; what
        the columns promise nearer by has to be there.
        """
        near = np.sqrt(RULES.shows * self.allowed(cost) / np.maximum(curvature, 1e-300))
        return [(float(n), RULES.reach) if n < RULES.reach else (RULES.reach,) for n in near]

    def _along(self, reaches: Sequence[tuple[float, ...]]) -> tuple[Array, Array]:
        """Slopes and curvatures `[m]` of the cost: a parabola through two more places, where it rises most."""
        slopes, curvature = np.zeros(len(reaches)), np.full(len(reaches), -np.inf)
        if not len(reaches):
            return slopes, curvature
        along = [(k, self._places(self.ways[:, k], reach)) for k, own in enumerate(reaches) for reach in own]
        points = [self.fit.values + t * self.ways[:, k] for k, ts in along for t in ts]
        fixed = [[self.weak[k]] for k, ts in along for _ in ts]
        costs, _ = self.costs([self.fit.values, *points], [self.weak, *fixed])
        for (k, (s, t)), found in zip(along, costs[1:].reshape(-1, 2), strict=True):
            rise = found - costs[0]  # = slope t + curvature t^2
            rise = np.sign(rise) * np.maximum(np.abs(rise) - self.allowed(costs[0]), 0.0)
            slope, bend = np.linalg.solve([[s, s * s], [t, t * t]], rise)
            if bend > curvature[k]:
                slopes[k], curvature[k] = slope, bend
        return slopes, np.maximum(curvature, 0.0)

    def allowed(self, cost: float) -> float:
        """A rise of the cost that says nothing."""
        return float(max(2 * RULES.nats * self.less, RULES.rounding * cost))

    def _places(self, way: Array, reach: float) -> tuple[float, float]:
        """Two places along a way, one on either side where there is room."""
        behind, ahead = self._room(way)
        if min(-behind, ahead) > 0.1 * reach:
            return max(behind, -reach), min(ahead, reach)
        end = min(ahead, reach) if ahead > -behind else max(behind, -reach)
        end = end if abs(end) > 1e-6 else 1e-6  # a corner: nowhere to go
        return end / 2, end

    def _room(self, way: Array) -> tuple[float, float]:
        """How far one can go along a way (backwards, forwards) before a parameter meets its bound."""
        _, _, low, high = self.fit.prior()
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.sort(np.stack([low / way, high / way]), axis=0)
        moving = np.abs(way) > 1e-3 * scales(self.fit)
        return float(np.max(ends[0][moving], initial=-np.inf)), float(np.min(ends[1][moving], initial=np.inf))

    def costs(self, points: Sequence[Array], fixed: Sequence[Any]) -> tuple[Array, list[Array]]:
        """Costs of the data near some values of the parameters, and the points that reach them.

        fixed: of each point, indices of the directions in which it stays where it is.
        """
        fitter, fit = self.fitter, self.fit
        low, high = (np.array([getattr(c, end) for c in fit.coordinates]) for end in ("low", "high"))
        reached, costs = [np.clip(p, low, high) for p in points], np.zeros(len(points))
        for _ in range(RULES.steps):
            thetas = np.stack([fitter.vector(fit.coordinates, p) for p in reached])
            rows = fitter.whiten(fitter.simulator.run(thetas, np.repeat(fit.offsets[None], len(thetas), 0)))
            for k, (r, stays) in enumerate(zip(rows, fixed, strict=True)):
                free = np.setdiff1d(np.arange(len(fit.values)), stays)
                q, _ = eliminate(r, self.columns[..., free], fit.B, fit.offsets, fitter.spread)
                g, S = q.weighted(fit.weight)
                step = np.linalg.lstsq(S, g, rcond=None)[0]
                costs[k] = fit.weight @ q.c - g @ step
                reached[k] = np.clip(reached[k] + self.every[:, free] @ step, low, high)
        return costs, reached

    def moved(self) -> Model | None:
        """One step to the posterior's mode along ridges where beliefs weigh more, if it costs next to nothing."""
        fit = self.fit
        known = self.ridges.simulated / self.less
        flat = np.flatnonzero(known < 1.0)
        if not len(flat):
            return None
        ways, belief = self.ways[:, flat], beliefs(fit, len(self.fitter.base))
        neutral = np.array([c.neutral for c in fit.coordinates])
        H = np.diag(known[flat]) + ways.T @ (belief[:, None] * ways)
        slope = self.slopes[flat] / self.less / 2 + ways.T @ (belief * (fit.values - neutral))
        step = np.clip(-np.linalg.solve(H, slope), -RULES.reach, RULES.reach)
        points = [fit.values, *(fit.values + ways @ (share * step) for share in RULES.shares)]
        (here, *_), reached = self.costs(points, [self.weak[flat]] * len(points))
        for point in reached[1:]:
            if np.all(np.abs(point - fit.values) <= 1e-3 * scales(fit)):
                continue
            new = self.fitter.refresh(replace(fit, values=point, history=()))
            q, _ = new.quadratic(self.fitter.spread)
            if float(new.weight @ q.c) - here <= self.allowed(here):
                return scored(self.fitter, new, self.model.effects)
        return None
