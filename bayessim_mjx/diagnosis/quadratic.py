"""Least squares with free start states: each window's cost as a quadratic in the parameters, starts eliminated.

For a window with residual r, columns A (parameters) and B (start state, prior spread D, current offset x):
    |r - A p - B dx|^2 + |(x + dx) / D|^2, minimised over dx, is  c - 2 g'p + p'S p   (Schur complement).
Everything after the rollouts (steps, held-out scores, bootstraps, screening of pairs) is algebra on each window's
(c, g, S).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
TRUST = 1e-3  # of the curvature: without a condition the fit stays put along directions that no data decide


@dataclass(frozen=True, eq=False)
class Quadratic:
    """Costs of W windows: c `[W]`, g `[W, K]`, S `[W, K, K]`."""

    c: Array
    g: Array
    S: Array

    def subset(self, columns: NDArray[np.int64]) -> Quadratic:
        """Some of the parameters."""
        return Quadratic(self.c, self.g[:, columns], self.S[:, columns[:, None], columns[None, :]])

    def at(self, p: Array) -> Array:
        """Costs `[W]` at p `[K]`, or at one p per window `[W, K]`."""
        if p.ndim == 1:
            return self.c - 2 * self.g @ p + np.einsum("i,wij,j->w", p, self.S, p)
        return self.c - 2 * np.einsum("wi,wi->w", self.g, p) + np.einsum("wi,wij,wj->w", p, self.S, p)

    def weighted(self, w: Array) -> tuple[Array, Array]:
        """(sum of g, sum of S) with window weights `[W]`."""
        return w @ self.g, np.einsum("w,wij->ij", w, self.S)


@dataclass(frozen=True, eq=False)
class Starts:
    """The eliminated start states: what gives the best dx for a step p."""

    B: Array  # [W, n, s]
    M: Array  # [W, s, s] B'B + D^-2, inverted
    b: Array  # [W, s]

    def step(self, A: Array, p: Array) -> Array:
        """dx `[W, s]` for a step p `[K]` with columns A `[W, n, K]`."""
        along = np.einsum("wns,wn->ws", self.B, A @ p)
        return np.einsum("wst,wt->ws", self.M, self.b - along)


def eliminate(r: Array, A: Array, B: Array, x: Array, spread: Array) -> tuple[Quadratic, Starts]:
    """(quadratic in the parameters, starts) for r `[W, n]`, A `[W, n, K]`, B `[W, n, s]`, x `[W, s]`, spread `[s]`."""
    M = np.linalg.inv(np.einsum("wns,wnt->wst", B, B) + np.diag(1 / spread**2))
    b = np.einsum("wns,wn->ws", B, r) - x / spread**2
    BA = np.einsum("wns,wnk->wsk", B, A)
    MBA = np.einsum("wst,wtk->wsk", M, BA)
    c = np.sum(r**2, 1) + np.sum((x / spread) ** 2, 1) - np.einsum("ws,wst,wt->w", b, M, b)
    g = np.einsum("wnk,wn->wk", A, r) - np.einsum("wsk,ws->wk", MBA, b)
    S = np.einsum("wnk,wnl->wkl", A, A, optimize=True) - np.einsum("wsk,wsl->wkl", BA, MBA, optimize=True)
    return Quadratic(c, g, S), Starts(B, M, b)


def solve(S: Array, g: Array, low: Array, high: Array) -> Array:
    """argmin p'Sp - 2 g'p with low <= p <= high (S positive semidefinite): an active set of bounds.

    Primal active set from the clipped free solution; at most 4 K passes.
    """
    k = len(g)
    scale = 1 / np.sqrt(np.maximum(np.diag(S), 1e-300))
    H = S * scale[:, None] * scale[None, :] + 1e-10 * np.eye(k)
    h, lo, hi = g * scale, low / scale, high / scale
    p = _cholesky_solve(H, h)
    if np.all((p >= lo) & (p <= hi)):
        return p * scale
    p = np.clip(p, lo, hi)
    for _ in range(200):  # projected coordinate descent with a Newton step on the free set
        free = ~(((p <= lo) & (H @ p - h > 0)) | ((p >= hi) & (H @ p - h < 0)))
        if free.any():
            target = p.copy()
            rest = h[free] - H[np.ix_(free, ~free)] @ p[~free]
            target[free] = _cholesky_solve(H[np.ix_(free, free)], rest)
            move = target - p
            with np.errstate(divide="ignore", invalid="ignore"):
                room = np.where(move > 0, (hi - p) / move, np.where(move < 0, (lo - p) / move, np.inf))
            alpha = min(1.0, float(np.min(room)))
            p = np.clip(p + alpha * move, lo, hi)
            at = np.argmin(room) if alpha < 1 else -1
            if at >= 0:
                p[at] = hi[at] if move[at] > 0 else lo[at]
            if alpha >= 1:
                slope = H @ p - h
                if np.all((slope > -1e-9) | (p >= hi)) and np.all((slope < 1e-9) | (p <= lo)):
                    break
        else:
            break
    return p * scale


def _cholesky_solve(H: Array, h: Array) -> NDArray[np.floating]:
    try:
        return np.linalg.solve(H, h)
    except np.linalg.LinAlgError:
        return np.linalg.lstsq(H, h, rcond=None)[0]


def held_out(
    q: Quadratic, group: NDArray[np.int64], weight: Array, precision: Array, pull: Array, low: Array, high: Array
) -> tuple[Array, Array]:
    """Leave-one-condition-out by one Newton step from the fit to all windows (the infinitesimal jackknife).

    Args:
        q: at the fit; group, weight: `[W]`; precision, pull: `[K]` of the Gaussian prior, pull = precision * (mean -
            value); low, high: `[K]`, how far each parameter may move.

    Returns:
        (costs of the held-out windows `[W]`, estimates relative to the fit `[G, K]`).
    """
    costs, moves = np.zeros(len(group)), []
    for name in np.unique(group):
        out = group == name
        g, S = q.weighted(weight * ~out)
        p = solve(S + np.diag(precision + TRUST * np.diag(S)), g + pull, low, high)
        costs[out] = q.at(p)[out]
        moves.append(p)
    return costs, np.array(moves)
