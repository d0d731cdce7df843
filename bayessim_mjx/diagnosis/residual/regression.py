"""Ridge regression of a fit's residuals on a force that depends on features, through the simulator's own columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.quadratic import RULES, Quadratic, solve
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance
from bayessim_mjx.diagnosis.residual.features import Mapping
from bayessim_mjx.diagnosis.residual.motion_inputs import Inputs

Array = NDArray[np.float64]


class Regression:
    """What all seeds share: the quadratic in (parameters, forces), inputs, weights, costs without the force."""

    def __init__(self, fitter: Fitter, fit: Fit, disturbance: Disturbance, inputs: Inputs) -> None:
        linear = disturbance.linear
        self.q: Quadratic = linear.quadratic
        self.k, self.nv, self.m = fit.A.shape[2], len(linear.scale), linear.nodes
        self.fit, self.fitter, self.inputs, self.scale = fit, fitter, inputs, linear.scale
        self.average = linear.basis / linear.basis.sum(0)  # [H, m], features at the nodes
        self.precision, self.pull, self.low, self.high = fit.prior()

    def base(self, fold: NDArray[np.int64]) -> Array:
        """Held-out costs `[W]` of the fit itself."""
        return self.fitter.scores(self.fit, fold)[0]

    def q_of(self, rows: NDArray[np.bool_]) -> Quadratic:
        """The quadratic of some windows."""
        return Quadratic(self.q.c[rows], self.q.g[rows], self.q.S[rows])

    def together(self, sums: Sums, ridge: Array | float) -> tuple[Array, Array]:
        """(parameter step `[k]`, beta in units of the force scale); ridge: added to the curvature of each feature."""
        S = sums.S.copy()
        S[np.diag_indices(len(S))] += ridge
        right = np.concatenate([sums.g[:, None], sums.C.T], 1)
        both = cho_solve(cho_factor(S), right) if len(S) else right
        step = np.zeros(0)
        if self.k:
            left = sums.Spp - sums.C @ both[:, 1:] + np.diag(self.precision + RULES.trust * np.diag(sums.Spp))
            step = solve(left, sums.gp + self.pull - sums.C @ both[:, 0], self.low, self.high)
        return step, both[:, 0] - both[:, 1:] @ step


@dataclass(frozen=True, eq=False)
class Sums:
    """Normal equations summed over some windows; parameters p, features' weights beta in units of the force scale."""

    S: Array  # [nv F, nv F]
    C: Array  # [k, nv F]
    g: Array  # [nv F]
    Spp: Array  # [k, k]
    gp: Array  # [k]

    def minus(self, other: Sums) -> Sums:
        return Sums(*(a - b for a, b in zip(self._all(), other._all(), strict=True)))

    def plus(self, other: Sums) -> Sums:
        return Sums(*(a + b for a, b in zip(self._all(), other._all(), strict=True)))

    def _all(self) -> tuple[Array, ...]:
        return self.S, self.C, self.g, self.Spp, self.gp


class OnFeatures:
    """The regression on given features phi `[W, m, nv, F]`."""

    def __init__(self, problem: Regression, phi: Array) -> None:
        self.problem, self.phi, self.each = problem, phi, phi.shape[3]

    def sums(self, fold: NDArray[np.int64]) -> list[Sums]:
        """Of the windows of each fold."""
        return [self._sums(np.flatnonzero(fold == name)) for name in range(fold.max() + 1)]

    def _sums(self, rows: NDArray[np.int64]) -> Sums:
        problem, weight = self.problem, self.problem.fit.weight[rows]
        k, nv, m, W = problem.k, problem.nv, problem.m, len(rows)
        q, size = problem.q, nv * self.each
        scaled = self.phi[rows] * problem.scale[:, None]
        weighted = scaled * weight[:, None, None, None]
        dd = q.S[rows][:, k:, k:].reshape(W, nv, m, nv, m)
        half = np.einsum("wimjn,wnjg->iwmjg", dd, scaled, optimize=True)
        S = np.einsum("wmif,iwmjg->ifjg", weighted, half, optimize=True).reshape(size, size)
        pd = q.S[rows][:, :k, k:].reshape(W, k, nv, m)
        C = np.einsum("wkim,wmif->kif", pd, weighted, optimize=True).reshape(k, size)
        g = np.einsum("wim,wmif->if", q.g[rows][:, k:].reshape(W, nv, m), weighted, optimize=True).reshape(size)
        return Sums(S, C, g, np.einsum("w,wij->ij", weight, q.S[rows][:, :k, :k]), weight @ q.g[rows][:, :k])

    def solve(self, sums: Sums, ridge: float) -> tuple[Array, Array]:
        """(parameter step `[k]`, beta `[nv F]` in units of force)."""
        problem = self.problem
        curvature = np.diag(sums.S).reshape(problem.nv, -1).mean(1)
        step, beta = problem.together(sums, ridge * np.repeat(curvature, self.each) + 1e-9 * curvature.max() + 1e-300)
        return step, beta * np.repeat(problem.scale, self.each)

    def without(self, fold: NDArray[np.int64], ridges: Sequence[float]) -> list[list[tuple[Array, Array]]]:
        """For each ridge the fits without each fold."""
        parts = self.sums(fold)
        whole = reduce(Sums.plus, parts)
        train = [whole.minus(part) for part in parts]
        return [[self.solve(t, ridge) for t in train] for ridge in ridges]

    def whole(self, ridge: float) -> Array:
        """Force `[W, m, nv]` of the fit to all windows."""
        beta = self.solve(self._sums(np.arange(len(self.problem.q.c))), ridge)[1]
        return np.einsum("wmvf,vf->wmv", self.phi, beta.reshape(self.problem.nv, -1))

    def costs(self, fold: NDArray[np.int64], fits: list[tuple[Array, Array]], phi: Array) -> Array:
        """Costs `[W]` of windows under the fits without their fold, with features phi."""
        step = np.stack([p for p, _ in fits])[fold]
        beta = np.stack([b for _, b in fits])[fold].reshape(len(fold), self.problem.nv, -1)
        force = np.einsum("wmvf,wvf->wvm", phi, beta, optimize=True).reshape(len(fold), -1)
        return self.problem.q.at(np.concatenate([step, force], 1))


class Seeded(OnFeatures):
    """The regression with one draw of random features."""

    def __init__(self, problem: Regression, seed: int) -> None:
        self.seed, self.mapping = seed, Mapping.draw(problem.inputs, seed)
        self.features = self.mapping(problem.inputs, problem.average)
        super().__init__(problem, self.features.phi)
