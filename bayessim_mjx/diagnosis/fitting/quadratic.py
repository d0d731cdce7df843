"""Least squares with free start states: each window's cost as a quadratic in the parameters, starts eliminated.

For a window with residual r, columns A (parameters) and B (start state, prior spread D, current offset x):
    |r - A p - B dx|^2 + |(x + dx) / D|^2, minimised over dx, is  c - 2 g'p + p'S p   (Schur complement).
Everything after the rollouts (steps, held-out scores, bootstraps, screening of pairs) is algebra on each window's
(c, g, S).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from bayessim_mjx.diagnosis.statistics import times

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rules:
    """How parts of the windows are held out, windows weighed, and columns differenced. Rules of thumb, not counted.

    Attributes:
        parts: in which windows that alone tell a parameter are held out; a window has as many rows at least.
        trust: share of the curvature: where no data decide, the fit stays put; first damping of a fit.
        far: standard deviations beyond which nothing is chance: 1 in 16 000 of Gaussian errors.
        change: noise sd, rms by which a finite difference changes the residuals: rounding is 2e-4 to 6e-4; one noise
            was too far where friction of the model's own is fitted beside a law of friction (measured: their sum came
            8 % too large). Of start states: share of their spread.
    """

    parts: int = 8
    trust: float = 0.001
    far: float = 4.0
    change: float = 0.3


RULES = Rules()


@dataclass(frozen=True, eq=False)
class Quadratic:
    """Costs of W windows: c `[W]`, g `[W, K]`, S `[W, K, K]`."""

    c: Array
    g: Array
    S: Array

    def subset(self, columns: NDArray[np.int64]) -> Quadratic:
        """Return some of the parameters."""
        return Quadratic(self.c, self.g[:, columns], self.S[:, columns[:, None], columns[None, :]])

    def at(self, p: Array) -> Array:
        """Costs `[W]` at p `[K]`, or at one p per window `[W, K]`."""
        if p.ndim == 1:
            return self.c - 2 * self.g @ p + _dot(p, self.S @ p)
        return self.c - 2 * _dot(self.g, p) + _dot(p, times(self.S, p))

    def of(self, w: int) -> tuple[Array, Array]:
        """g and S of one window."""
        return self.g[w], self.S[w]

    def weighted(self, w: Array) -> tuple[Array, Array]:
        """(sum of g, sum of S) with window weights `[W]`."""
        return w @ self.g, np.tensordot(w, self.S, 1)


@dataclass(frozen=True, eq=False)
class Starts:
    """The eliminated start states: what gives the best dx for a step p."""

    B: Array  # [W, n, s]
    M: Array  # [W, s, s] B'B + D^-2, inverted
    b: Array  # [W, s]

    def step(self, A: Array, p: Array) -> Array:
        """dx `[W, s]` for a step p `[K]` with columns A `[W, n, K]`."""
        along = times(self.B.mT, A @ p)
        return times(self.M, self.b - along)


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.sum(a * b, -1))


def eliminate(
    r: Array, A: Array, B: Array, x: Array, spread: Array, damping: Array | float = 0.0
) -> tuple[Quadratic, Starts]:
    """(quadratic in the parameters, starts) for r `[W, n]`, A `[W, n, K]`, B `[W, n, s]`, x `[W, s]`, spread `[s]`.

    damping: Levenberg's, of each window's start state `[W]`, as a share of its own curvature.
    """
    spread = np.broadcast_to(spread, x.shape[1:])
    own = np.flatnonzero(B.any((0, 1)))  # the others move nothing, and go back to what was measured
    B_own, x_own, D = B if len(own) == len(spread) else B[:, :, own], x[:, own], spread[own]
    bend = B_own.mT @ B_own + np.diag(1 / D**2)
    bend = bend + np.reshape(damping, (-1, 1, 1)) * bend * np.eye(len(own))
    inner = np.asarray(np.linalg.inv(bend), np.float64)
    pull = times(B_own.mT, r) - x_own / D**2
    BA = B_own.mT @ A  # products of matrices throughout: einsum takes several times as long
    MBA = inner @ BA
    c = np.sum(r**2, 1) + np.sum((x_own / D) ** 2, 1) - _dot(pull, times(inner, pull))
    g = times(A.mT, r) - times(MBA.mT, pull)
    S = A.mT @ A - BA.mT @ MBA
    M, b = np.tile(np.diag(spread**2), (len(r), 1, 1)), -x / spread**2
    M[:, own[:, None], own], b[:, own] = inner, pull
    return Quadratic(c, g, S), Starts(B, M, b)


def learnt_spread(r: Array, B: Array, x: Array, spread: Array, weight: Array, own: NDArray[np.intp]) -> Array:
    """Return the prior's standard deviations `[s]`, those of the numbers `own` as the windows make them likely.

    By expectation maximisation (Dempster, Laird and Rubin, J. R. Stat. Soc. B 39, 1977): the mean square of the start
    states' posterior, as often as windows have parts. As in `eliminate`; weight: `[W]`.
    """
    out, share = spread.copy(), weight / weight.sum()
    for _ in range(RULES.parts if len(own) else 0):
        _, starts = eliminate(r, np.zeros((*r.shape, 0)), B, x, out)
        mean = x + times(starts.M, starts.b)
        square = share @ (mean**2 + np.diagonal(starts.M, axis1=1, axis2=2))
        out[own] = np.sqrt(square[own])
    return out


def blocks(q: Quadratic, starts: Starts, r: Array, A: Array, w: int, count: int = RULES.parts) -> Quadratic:
    """One window's cost as a sum over `count` blocks of its rows, which are in the order of time.

    r `[W, n]`, A `[W, n, K]` as for `eliminate`. The start state stays eliminated by the whole window: rows of the
    projected residual and columns are summed within blocks; what the start's prior adds is shared out evenly.
    """
    B, M = starts.B[w], starts.M[w]
    own = r[w] - B @ (M @ starts.b[w])
    columns = A[w] - B @ (M @ (B.T @ A[w]))
    rows = np.array_split(np.arange(len(own)), count)
    c = np.array([own[i] @ own[i] for i in rows])
    g = np.array([columns[i].T @ own[i] for i in rows])
    S = np.array([columns[i].T @ columns[i] for i in rows])
    return Quadratic(c + (q.c[w] - c.sum()) / count, g + (q.g[w] - g.sum(0)) / count, S + (q.S[w] - S.sum(0)) / count)


def solve(S: Array, g: Array, low: Array, high: Array) -> Array:
    """argmin p'Sp - 2 g'p with low <= p <= high (S positive semidefinite), by an active set of bounds."""
    scale = 1 / np.sqrt(np.maximum(np.diag(S), 1e-300))
    values, vectors = np.linalg.eigh(S * scale[:, None] * scale[None, :])
    root = np.sqrt(np.maximum(values, 0.0) + 1e-10)
    A, b = root[:, None] * vectors.T, vectors.T @ (g * scale) / root
    p = vectors @ (b / root)
    bounds = low / scale, high / scale
    if np.any((p < bounds[0]) | (p > bounds[1])):
        p = lsq_linear(A, b, bounds, method="bvls", max_iter=20 * len(p)).x
    return np.asarray(p * scale)


Split = Callable[[int], Quadratic]


def held_out(
    q: Quadratic,
    group: NDArray[np.int64],
    weight: Array,
    precision: Array,
    pull: Array,
    low: Array,
    high: Array,
    watched: NDArray[np.int64] | None = None,
    split: Split | None = None,
) -> tuple[Array, Array]:
    """Leave-one-condition-out by one Newton step from the fit to all windows (the infinitesimal jackknife).

    Args:
        q: at the fit; group, weight: `[W]`.
        precision, pull: `[K]` of the Gaussian prior, pull = precision (mean - value).
        low, high: `[K]`, how far each parameter may move.
        watched: parameters that may be told by one condition alone (a limit only reached there, drag only felt there).
            That condition's windows are then held out in parts: extrapolating a parameter to where it first matters
            would judge its uncertainty, not the model.
        split: blocks in time of a window. One that alone tells a watched parameter is held out block by block.

    Returns:
        (costs of the held-out windows `[W]`, estimates relative to the fit `[G, K]`).
    """
    fit = Rest(q, weight, precision, pull, low, high)
    tells = fit.told_by(np.arange(0) if watched is None else watched)
    costs, moves = np.zeros(len(group)), []
    for name in np.unique(group):
        out = group == name
        if tells(out):
            own = np.flatnonzero(out)
            alone = [w for w in own if split and tells(np.arange(len(group)) == w)]
            p = fit.by_parts(np.setdiff1d(own, alone), {int(w): split(int(w)) for w in alone} if split else {}, costs)
        else:
            p = fit.step(out)
            costs[out] = q.at(p)[out]
        moves.append(p)
    return costs, np.array(moves)


def predictive(
    q: Quadratic, out: NDArray[np.bool_], weight: Array, p: Array, curvature: Array, low: Array, high: Array
) -> Array:
    """Costs of some windows together under an estimate p of the others and what that leaves open, shared out evenly.

    With r = A p + e, e of unit variance and p known to N(p_, H^-1), -2 log density of r is, but for its determinant,
    r'(I + A H^-1 A')^-1 r = min_d |r - A (p_ + d)|^2 + d'H d: the innovation of a Kalman filter (Bar-Shalom, Li and
    Kirubarajan, 2001, sec. 5.2). A parameter that the others hardly tell may then move; one that they tell may not.

    Args:
        q, weight, p: as in `held_out`; out: `[W]`, the windows; curvature: H `[K, K]`, of the others and the prior.
        low, high: `[K]`, bounds of p.

    Returns:
        Costs of the windows `out`.
    """
    g, S = q.weighted(weight * out)
    d = solve(curvature + S, g - S @ p, low - p, high - p)
    return np.asarray(q.at(p + d)[out] + d @ curvature @ d / np.count_nonzero(out))


@dataclass(frozen=True, eq=False)
class Rest:
    """Newton steps from a fit to what is left without some windows, or without blocks of them."""

    q: Quadratic
    weight: Array
    precision: Array
    pull: Array
    low: Array
    high: Array

    def curvature(
        self, out: NDArray[np.bool_], blocks: Sequence[tuple[float, Array, Array]] = ()
    ) -> tuple[Array, Array]:
        """(gradient, curvature with the prior); blocks: (weight, gradient, curvature) of parts of windows left out."""
        g, S = self.q.weighted(self.weight * ~out)
        for share, g_block, S_block in blocks:
            g, S = g - share * g_block, S - share * S_block
        return g, S + np.diag(self.precision + RULES.trust * np.diag(S))

    def told_by(self, watched: NDArray[np.int64]) -> Callable[[NDArray[np.bool_]], bool]:
        """Whether some windows (given as `[W]` flags) alone tell one of the parameters `watched`.

        The others together then tell no more of it than one part of these windows does.
        """
        known = _variances(self.curvature(np.zeros(len(self.weight), bool))[1])
        return lambda out: bool((_variances(self.curvature(out)[1]) > (1 + RULES.parts) * known)[watched].any())

    def step(self, out: NDArray[np.bool_], blocks: Sequence[tuple[float, Array, Array]] = ()) -> Array:
        g, S = self.curvature(out, blocks)
        return solve(S, g + self.pull, self.low, self.high)

    def by_parts(self, own: NDArray[np.int64], blocks: Mapping[int, Quadratic], costs: Array) -> Array:
        """Average the steps without each part of the windows `own` and the split ones; fill in their costs."""
        windows, steps = np.arange(len(self.weight)), []
        for k in range(RULES.parts if blocks else min(RULES.parts, len(own))):
            part = np.isin(windows, own[k :: RULES.parts])
            p = self.step(part, [(self.weight[w], *split.of(k)) for w, split in blocks.items()])
            costs[part] = self.q.at(p)[part]
            for w, split in blocks.items():
                costs[w] += split.at(p)[k]
            steps.append(p)
        return np.asarray(np.mean(steps, axis=0))


def _variances(S: Array) -> Array:
    """Diagonal of the inverse `[K]`; infinite where nothing is known (a limit that is never reached)."""
    scale = 1 / np.sqrt(np.maximum(np.diag(S), 1e-300))
    inverse = np.diag(np.linalg.pinv(S * scale[:, None] * scale[None, :], hermitian=True)) * scale**2
    return np.where(np.diag(S) > 0, inverse, np.inf)


def weights(r: Array) -> Array:
    """Huber weights of whole windows: those far worse than the rest (a stop, a stick phase, a push) count less."""
    each = np.sqrt(np.mean(r**2, 1))
    limit = RULES.far * np.median(each) + 1e-12
    return np.minimum(1.0, limit / np.maximum(each, 1e-300))


def columns(r: Array, shifted: Array, steps: Array) -> Array:
    """Return A `[W, n, k]`: minus the derivative of the residual."""
    if not len(steps):
        return np.zeros((*r.shape, 0))
    return np.ascontiguousarray(np.moveaxis((r[None] - shifted) / np.asarray(steps)[:, None, None], 0, -1))
