"""Ridge regression of a fit's residuals on a force that depends on features, through the simulator's own columns.

Features are functions of the measured motion: laws of a joint's own motion, couplings, random functions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import reduce

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.quadratic import RULES, Quadratic, solve
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance
from bayessim_mjx.diagnosis.residual.motion_inputs import QUANTITIES, Inputs

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sizes:
    """Random features, and how far all features may extrapolate. Rules of thumb, not counted.

    Attributes:
        random: features for each joint and seed; picked: inputs of each.
        limit: standard deviations at which features and inputs are clipped: a normal one is beyond in 1 of 16 000.
    """

    random: int = 24
    picked: int = 5
    limit: float = 4.0


SIZES = Sizes()


@dataclass(frozen=True, eq=False)
class Features:
    """Phi of each joint: `phi [W, m, nv, F]`, standardised, of inputs `z [W, H, I]` named (joint, quantity)."""

    phi: Array
    names: tuple[tuple[int, str], ...]


@dataclass(frozen=True, eq=False)
class Mapping:
    """Inputs -> features of one seed; standardised by the logs it was drawn on."""

    names: tuple[tuple[int, str], ...]
    weights: Array  # [nv, RANDOM, I]
    shifts: Array  # [nv, RANDOM]
    moments: list[tuple[Array, Array]] = field(default_factory=list)

    @classmethod
    def draw(cls, inputs: Inputs, seed: int) -> Mapping:
        nv = len(inputs.joints)
        names = tuple((v, quantity) for v in range(nv) for quantity in QUANTITIES)
        rng = np.random.default_rng(seed)
        weights = np.zeros((nv, SIZES.random, len(names)))
        for v in range(nv):
            own = np.array([1.0 if joint == v else 0.5 / max(nv - 1, 1) for joint, _ in names])
            own[[i for i, (_, q) in enumerate(names) if q == "time"]] *= 0.3
            for f in range(SIZES.random):
                picked = rng.choice(len(names), SIZES.picked, replace=False, p=own / own.sum())
                weights[v, f, picked] = rng.normal(size=SIZES.picked) * rng.choice([0.5, 1.0, 2.0])
        return cls(names, weights, rng.uniform(-1.5, 1.5, (nv, SIZES.random)))

    def __call__(self, inputs: Inputs, average: Array) -> Features:
        """Standardised features at the nodes; the first call fixes the standardisation."""
        z = self._inputs(inputs)
        random = np.tanh(np.einsum("whi,vfi->whvf", z, self.weights, optimize=True) + self.shifts)
        raw = np.concatenate([own_features(inputs), cross_features(inputs), random], 3)
        phi = np.einsum("hm,whvf->wmvf", average, raw, optimize=True)
        phi = self._standard(1, phi)
        return Features(np.concatenate([np.ones((*phi.shape[:3], 1)), phi], 3), self.names)

    def _inputs(self, inputs: Inputs) -> Array:
        z = [_single(inputs.of(q))[..., v] for v, q in self.names]
        return self._standard(0, np.stack(z, 2))

    def _standard(self, which: int, values: Array) -> Array:
        if len(self.moments) <= which:
            mean, sd = values.mean((0, 1)), values.std((0, 1))
            self.moments.append((mean, np.where(sd > 1e-9 * (np.abs(mean) + 1e-9), sd, np.inf)))
        mean, sd = self.moments[which]
        return np.clip((values - mean) / sd, -SIZES.limit, SIZES.limit)


def _single(values: Array) -> Array:
    """`[W, H, nv]`: of quantities that come in two sizes the second."""
    return values if values.ndim == 3 else values[..., 1]


def own_features(inputs: Inputs) -> Array:
    """`[W, H, nv, F]`: laws that forces in a joint may follow, of that joint's own motion."""
    q, w, s = inputs.position, inputs.speed / inputs.speed_scale, inputs.direction
    load, effort = inputs.load / inputs.load_scale, inputs.effort / inputs.effort_scale
    sign, fast = np.tanh(w / 0.02), np.tanh(w / 0.2)
    turn = np.where(inputs.hinge, 1.0, 0.0)
    recent = s * np.exp(-inputs.since_reversal / 0.1)
    columns = [
        q, np.sin(q) * turn, np.cos(q) * turn, w, sign, fast, w * np.abs(w),
        s, recent, inputs.stop[..., 0], inputs.stop[..., 1],
        effort, np.abs(effort), effort * np.abs(effort), np.abs(effort) * sign, load, np.abs(load) * sign,
        inputs.pull, inputs.past[..., 0], inputs.past[..., 1],
        inputs.time, inputs.time * sign, inputs.time * effort,
        q * sign, np.sin(q) * turn * sign, np.cos(q) * turn * sign,
    ]  # fmt: skip
    return np.stack(columns, 3)


def cross_features(inputs: Inputs) -> Array:
    """`[W, H, nv, F]`: what other joints do, for couplings; nothing for one joint alone."""
    nv = len(inputs.joints)
    w = inputs.speed / inputs.speed_scale
    rows = []
    for v in range(nv):
        others = [u for u in range(nv) if u != v]
        parts = [np.tanh(w[..., others] / 0.1), w[..., others], inputs.effort[..., others], inputs.pull[..., others]]
        rows.append(np.concatenate(parts, 2))
    return np.stack(rows, 2)


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
