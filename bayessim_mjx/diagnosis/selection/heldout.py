"""How far: held-out distance of measured and simulated motion, in noise units, at several horizons and by joint."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.fitting.delivered import Delivered
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.quadratic import RULES as HELD_OUT
from bayessim_mjx.diagnosis.fitting.quadratic import eliminate, solve
from bayessim_mjx.diagnosis.fitting.windows import Windows
from bayessim_mjx.diagnosis.selection.models import Model, told_alone
from bayessim_mjx.diagnosis.selection.numbers import EFFORT, ODDS, RELEVANCE
from bayessim_mjx.diagnosis.statistics import Gap

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Prediction:
    """A model really simulated, with the parameters found without each window's condition.

    Attributes:
        error: `[W, H, channels]`, whitened; offsets: `[W, s]`, of the start states.
    """

    error: Array
    offsets: Array

    def cost(self, steps: int, channels: slice = slice(None)) -> Array:
        """Mean square over the first steps, per window `[W]`."""
        return np.asarray(np.mean(self.error[:, :steps, channels] ** 2, axis=(1, 2)))


def predict(fitter: Fitter, model: Model) -> Prediction:
    """Simulate each condition's windows with the parameters found without it; starts re-estimated on the window."""
    _, fold = np.unique(fitter.simulator.windows.group, return_inverse=True)
    thetas = [fitter.vector(model.fit.coordinates, values) for values in model.estimates]
    each = np.array(thetas), fold, np.arange(len(fold))
    return _settled(fitter, model.fit, lambda offsets: fitter.simulator.run_each(*each, offsets))


def refitted(fitter: Fitter, model: Model) -> Model:
    """Take estimates without each condition that come of fits without it, all in lockstep.

    In the search one linear step from the common fit stands for such a fit: good enough to rank by, but where numbers
    are hardly told (a wind's sideways force) it can lead where the model is no longer linear. A condition that alone
    tells a parameter is held out in parts (`Fitter.scores`): its linear steps stay.
    """
    group, estimates = fitter.simulator.windows.group, model.estimates.copy()
    alone = zip(np.unique(group), told_alone(fitter, model.fit), strict=True)
    folds = {g: _Fold(fitter, model, group != name) for g, (name, told) in enumerate(alone) if not told}
    for _ in range(EFFORT.rounds):
        if not (running := [fold for fold in folds.values() if not fold.rests]):
            break
        thetas = np.stack([fitter.vector(fold.fit.coordinates, fold.values) for fold in running])
        seen = fitter.whiten(fitter.simulator.run(thetas, np.stack([fold.offsets for fold in running])))
        for fold, r in zip(running, seen, strict=True):
            fold.go_on(r)
    for g, fold in folds.items():
        estimates[g] = fold.found
    return replace(model, estimates=estimates)


class _Fold:
    """A fit that goes on from the common one with some of the windows alone.

    Gauss-Newton steps on the common fit's columns, not descent: at the scale of these steps costs are rough (contacts,
    dry friction, single precision), and a descent would stay where it is. A step that makes the windows much less
    likely than the common fit (`Odds.strong`) is halved. Directions that these windows do not tell stay where the
    common fit has them. It rests at a step too small to be worth a simulation.
    """

    def __init__(self, fitter: Fitter, model: Model, kept: NDArray[np.bool_]) -> None:
        fit = model.fit
        self.fitter, self.fit = fitter, replace(fit, weight=fit.weight * kept)
        cost = fitter.cost(self.fit, fit.r, fit.offsets, fit.values)
        nat = 2 * cost / (model.samples * kept.mean())
        self.limit, self.worth = cost + nat * math.log(ODDS.strong), nat * RELEVANCE.share
        self.found = fit.values
        self.values, self.offsets = self._step(fit.values, fit.offsets, fit.r)

    def go_on(self, r: Array) -> None:
        """With the residuals `[W, n]` at the values that were to be tried."""
        if self.fitter.cost(self.fit, r, self.offsets, self.values) <= self.limit:
            self.found = self.values
            self.values, self.offsets = self._step(self.values, self.offsets, r)
        else:
            self.values = (self.found + self.values) / 2
            self.offsets = (self.fit.offsets + self.offsets) / 2

    def _step(self, values: Array, offsets: Array, r: Array) -> tuple[Array, Array]:
        q, starts = eliminate(r, self.fit.A, self.fit.B, offsets, self.fit.spread)
        g, S = q.weighted(self.fit.weight)
        precision, pull, low, high = replace(self.fit, values=values).prior()
        held = HELD_OUT.trust * np.diag(S)
        pull = pull + held * (self.fit.values - values)
        H, slope = S + np.diag(precision + held), g + pull
        p = solve(H, slope, low, high)
        self.rests = bool((2 * slope - H @ p) @ p < self.worth)
        if self.rests:
            self.found = values + p
        return values + p, offsets + starts.step(self.fit.A, p)


def noise_floor(fit: Fit, noise: Array) -> Array:
    """`[W]`, mean square of white noise after start states were fitted to it: tr (I - P) S (I - P)' / n, P their hat.

    Start states take a share of the noise with them, 2 of 25 numbers of a joint whose position is measured in 25 rows.

    Args:
        noise: `[C]`, of each channel, in what was estimated from the logs; S has their squares.
    """
    _, starts = fit.quadratic()
    B, M = starts.B, starts.M
    square = np.tile(noise**2, B.shape[1] // len(noise))
    inner = np.einsum("wni,n,wnj->wij", B, square, B)
    twice = 2 * np.einsum("wij,wji->w", M, inner) - np.einsum("wij,wjk,wkl,wli->w", M, inner, M, B.mT @ B)
    return np.asarray(square.mean() - twice / len(square))


def nominal(fitter: Fitter, fit: Fit, delivered: Delivered | None = None, cuts: Sequence[Windows] = ()) -> Prediction:
    """Simulate as delivered, starts estimated.

    Args:
        delivered: the model, where the fitter has another integrator; cuts: windows with the commands that may be
            meant, of which the nearest count.
    """
    cut = fitter.simulator.windows
    if delivered is not None:
        played = [functools.partial(delivered.played, own) for own in (cut, *cuts)]
        return min((_settled(fitter, fit, errors) for errors in played), key=lambda p: float(np.sum(p.error**2)))
    theta = fitter.vector(fit.coordinates, np.array([c.neutral for c in fit.coordinates]))
    each = theta[None], np.zeros(len(cut), int), np.arange(len(cut))
    return _settled(fitter, fit, lambda offsets: fitter.simulator.run_each(*each, offsets))


def _settled(fitter: Fitter, fit: Fit, errors: Callable[[Array], Array]) -> Prediction:
    """All windows after two Newton steps of their start states; errors: changes of these `[W, s]` -> `[W, H, 2 nv]`."""
    offsets, none = fit.offsets, np.zeros((*fit.r.shape, 0))
    r = fitter.whiten(errors(offsets))
    for _ in range(2):
        _, starts = eliminate(r, none, fit.B, offsets, fit.spread)
        moved = offsets + starts.step(none, np.zeros(0))
        new = fitter.whiten(errors(moved))
        better = (np.sum(new**2, 1) < np.sum(r**2, 1))[:, None]
        r, offsets = np.where(better, new, r), np.where(better, moved, offsets)
    return Prediction(r.reshape(len(r), fitter.simulator.windows.steps, -1), offsets)


def stages(costs: dict[str, Array], group: NDArray[np.int64]) -> dict[str, Any]:
    """Root mean squares of the stages, each with a 90 % interval by operating conditions.

    Args:
        costs: {stage: `[W]` mean squares of windows}; group: `[W]`.
    """
    out: dict[str, Any] = {"ci": {}, "noise_floor": 1.0}
    for name, cost in costs.items():
        out[name] = float(np.sqrt(cost.mean()))
        out["ci"][name] = list(statistics.interval_of_rms(cost, group))
    return out


@dataclass(frozen=True, eq=False)
class Closed:
    """Share of the squared gap above the noise that a better simulator closes (`Gap.closed`), with its interval.

    Attributes:
        before, after: `[W]` mean squares of windows in units of the noise; group: `[W]`, their conditions.
        floor: `[W]`, what noise alone leaves (`noise_floor`); None: 1.
        own, every: `[W]`, what one of several effects closes of what all do, where the share is of that one alone. Then
            what undercuts the noise is nobody's, so that parts add up to the whole.
    """

    before: Array
    after: Array
    group: NDArray[np.int64]
    floor: Array | None = None
    own: Array | None = None
    every: Array | None = None

    def _sums(self, rows: Array) -> tuple[Array, Array, Array]:
        """Return sums of the gap, of the residual and of the noise, over windows with weights `[..., W]`."""
        before, after = rows @ self.before, rows @ self.after
        noise = rows.sum(-1) if self.floor is None else rows @ self.floor
        if self.own is None or self.every is None:
            return before, after, noise
        own, every = (rows @ (x * np.ones_like(self.before)) for x in (self.own, self.every))
        part = np.where(np.abs(every) > 1e-12 * rows.sum(-1), own / np.where(every == 0, 1.0, every), 0.0)
        return before, before - part * (before - np.maximum(after, noise)), noise

    @property
    def value(self) -> float:
        """`Gap.closed` of all windows."""
        return Gap(*map(float, self._sums(np.ones_like(self.before)))).closed

    def interval(self) -> tuple[float, float]:
        """90 % interval between -1 and 1, NaN of one condition and where there is no gap.

        A share s is kept where what is left, E1, could be what it says, (1 - s) E0 + s: where the logarithm of their
        ratio is no more standard errors off 0 than Student's t allows. That holds near the noise, where E1 - 1 has no
        logarithm, and near 0 alike. As many conditions count as rule the one or the other, whichever are fewer. What
        undercuts the noise shows by how much the noise was taken for too large: that error of the floor counts too.
        """
        rows, value = statistics.leave_one_out(self.group), self.value
        if len(rows) < 2 or math.isnan(value):
            return statistics.NOTHING
        (before, left, noise), without = self._sums(np.ones(len(self.before))), self._sums(rows)
        off = max(1.0 - float(self.after.sum() / noise), 0.0)  # of the floor
        left, left_without = (np.maximum(x, 1e-9) for x in (left, without[1]))

        def beyond(share: float) -> float:
            """How much farther off 0 the logarithm is than is allowed."""
            said, said_without = (
                np.maximum((1 - share) * b + share * n, 1e-9) for b, n in ((before, noise), without[::2])
            )
            counting = (np.maximum(x - y, 0.0) for x, y in ((left, left_without), (said, said_without)))
            freedom = min(float(statistics.freedom(own, statistics.RULED)) for own in counting)
            error = float(statistics.error(np.log(left_without / said_without)))
            allowed = float(statistics.quantile(freedom)) * math.hypot(error, off * share * noise / said)
            return abs(math.log(left / said)) - allowed

        def end(farthest: float) -> float:
            if beyond(value) > 0.0 or beyond(farthest) <= 0.0:
                return value if beyond(value) > 0.0 else farthest
            return float(brentq(beyond, value, farthest, xtol=np.finfo(np.float64).eps))

        return end(-1.0) if value > -1.0 else value, end(1.0)
