"""A model's windows as one Gaussian, and its log marginal likelihood (docs/evidence.md has the equations).

About a fit the residual of a window is  r = A p + B x + D d + e:  p the parameters' step, x the start state, d the
force that is missing at nodes in time, e the noise. x, d and e are Gaussian and are integrated out in closed form, so
a window's residual is N(A p, C). The force's amplitude at each joint, its memory and the noise of each channel are at
their best for each model (type II maximum likelihood; MacKay, Neural Computation 4, 1992), with weak priors.

The missing force is what no law of the model explains (Kennedy and O'Hagan, J. R. Stat. Soc. B 63, 2001): a law that is
nearly right leaves a small force, not hundreds of noise standard deviations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtri
from scipy.optimize import minimize

from bayessim_mjx.diagnosis.fitting import scales
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.quadratic import solve
from bayessim_mjx.diagnosis.selection.numbers import PRIORS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Hyper:
    """Amplitude of the missing force `[nv]` (shares of the force scale), its memory (node spacings), and the noise's
    factor on what was estimated from the logs `[C]`."""

    amplitude: Array
    memory: float
    noise: Array


@dataclass(frozen=True, eq=False)
class Windows:
    """Inner products over the rows of each channel, all that the evidence needs of a model's windows.

    Attributes:
        gram: `[C, W, M, M]` of the columns (r, A, D in units of the force scale, B in units of the starts' spread).
        parameters, joints, nodes: k, nv and m, so M = 1 + k + nv m + s; rows: of each channel in a window.
    """

    gram: Array
    parameters: int
    joints: int
    nodes: int
    rows: int

    @property
    def forces(self) -> int:
        return self.joints * self.nodes

    @property
    def memories(self) -> list[float]:
        """Of the force that are tried, in node spacings: powers of 4, from white to the length of a window."""
        return [4.0**n for n in range((1 + self.nodes.bit_length()) // 2)]


def windows_of(
    r: Array, A: Array, B: Array, D: Array, offsets: Array, spread: Array, scale: Array, channels: int
) -> Windows:
    """Return the inner products of a fit; of its start states those that move anything.

    Args:
        r, A, B: `[W, n]`, `[W, n, k]`, `[W, n, s]`, whitened, rows in the order of time, channels side by side.
        D: `[W, n, nv m]`, per N m or N. offsets: `[W, s]`, of the start states; spread: `[s]`, their prior.
        scale: `[nv]`, the robot's force scale.
    """
    count, n = r.shape
    nodes = D.shape[2] // len(scale)
    start = r + np.einsum("wns,ws->wn", B, offsets)  # with the start state as measured
    own = B.any((0, 1))
    X = np.concatenate([start[..., None], A, D * np.repeat(scale, nodes), (B * spread)[:, :, own]], 2)
    X = X.reshape(count, n // channels, channels, -1).transpose(2, 0, 3, 1)
    return Windows(X @ X.mT, A.shape[2], len(scale), nodes, n // channels)


@dataclass(frozen=True, eq=False)
class Marginal:
    """Windows with force and start state integrated out.

    Attributes:
        Q: `[W, 1 + k, 1 + k]`, products of (r, A) weighted by the inverse covariance of a window's residual.
        logdet: `[W]`, its log determinant.
        root, cov, mean: of force and start in units of their priors: roots of the prior covariance `[M', M']`,
            posterior covariance `[W, M', M']`, and what the mean is per (r, A) `[W, M', 1 + k]`.
    """

    Q: Array
    logdet: Array
    root: Array
    cov: Array
    mean: Array


def correlation(nodes: int, memory: float) -> Array:
    """Root of an Ornstein-Uhlenbeck process's correlation at nodes."""
    lag = np.abs(np.subtract.outer(np.arange(nodes), np.arange(nodes)))
    return np.asarray(np.linalg.cholesky(np.exp(-lag / memory) + 1e-9 * np.eye(nodes)), np.float64)


def marginal(windows: Windows, hyper: Hyper) -> Marginal:
    """Return the windows under some hyperparameters (Woodbury's identity: of the force's size, not the rows')."""
    own, forces = 1 + windows.parameters, windows.forces
    gram = np.tensordot(1 / hyper.noise**2, windows.gram, 1)
    size = gram.shape[1] - own
    root = np.eye(size)
    root[:forces, :forces] = np.kron(np.diag(hyper.amplitude), correlation(windows.nodes, hyper.memory))
    VY = root.T @ gram[:, own:, :own]
    inner = root.T @ gram[:, own:, own:] @ root + np.eye(size)
    rounding = np.finfo(np.float64).eps * np.diagonal(inner, axis1=1, axis2=2)[..., None]
    lower = np.linalg.cholesky(inner + rounding * np.eye(size))
    back = np.stack([dtrtri(one, lower=1)[0] for one in lower])
    half = back @ VY  # squared it is subtracted: an inverse of `inner` there would lose all digits of large residuals
    logdet = 2 * np.sum(np.log(np.diagonal(lower, axis1=1, axis2=2)), 1)
    logdet += 2 * windows.rows * float(np.sum(np.log(hyper.noise)))
    return Marginal(gram[:, :own, :own] - half.mT @ half, logdet, root, back.mT @ back, back.mT @ half)


@dataclass(frozen=True, eq=False)
class Belief:
    """Gaussian prior of the parameters' step: precision and mean `[k]`, within bounds `[k]`."""

    precision: Array
    mean: Array
    low: Array
    high: Array

    def best(self, Q: Array) -> Array:
        """Return the most probable step `[k]`; Q `[1 + k, 1 + k]`, summed over windows."""
        if not len(self.mean):
            return self.mean
        S, g = Q[1:, 1:], Q[1:, 0]
        return solve(S + np.diag(self.precision), g + self.precision * self.mean, self.low, self.high)

    def cost(self, Q: Array, p: Array) -> float:
        """-2 log of likelihood and prior at a step, up to constants."""
        return float(Q[0, 0] - 2 * Q[1:, 0] @ p + p @ Q[1:, 1:] @ p + self.precision @ (p - self.mean) ** 2)


@dataclass(frozen=True, eq=False)
class Learnt:
    """The best hyperparameters of a model.

    Attributes:
        hyper; step: `[k]`, the most probable parameters' step; marginal: there.
        penalty: log prior of the hyperparameters, up to a constant that all models have.
    """

    hyper: Hyper
    step: Array
    marginal: Marginal
    penalty: float

    @property
    def Q(self) -> Array:
        return np.asarray(self.marginal.Q.sum(0))

    @property
    def without_parameters(self) -> float:
        """Log density of the windows at Q = 0, but for the constant of all models, with the hyperparameters' prior."""
        return self.penalty - 0.5 * float(self.marginal.logdet.sum())


def learn(windows: Windows, belief: Belief, like: Sequence[Hyper] = (), most: float = 10.0) -> Learnt:
    """Find the best hyperparameters, by quasi-Newton steps (exact gradients by Fisher's identity) for each memory.

    Args:
        like: of models of the same windows with one memory, which stays; the search begins at the best of them. Empty:
            all memories are tried.
        most: of the force's amplitude, in shares of the force scale.
    """
    nv, channels = windows.joints, len(windows.gram)
    starts = [np.concatenate([np.full(nv, np.log(PRIORS.usual)), np.zeros(channels)])]
    memories = windows.memories
    if like:
        starts, memories = [np.log(np.concatenate([h.amplitude, h.noise])) for h in like], [like[0].memory]
    start = min(starts, key=lambda x: _slope(x, windows, belief, memories[0])[0]) if len(starts) > 1 else starts[0]
    ends: Array = np.array([(np.log(PRIORS.least), np.log(most))] * nv + [(-2.0, 7.0)] * channels)
    unit = _precision(windows) ** -0.5
    best: Any = None

    def scaled(x: Array, memory: float) -> tuple[float, Array]:
        value, slope = _slope(x * unit, windows, belief, memory)
        return value, slope * unit

    for memory in memories:
        found = minimize(
            scaled, start / unit, memory, "L-BFGS-B", jac=True, bounds=ends / unit[:, None],
            options={"ftol": np.finfo(np.float32).eps},  # products of residuals in single precision are no better
        )  # fmt: skip
        start = found.x * unit
        if best is None or found.fun < best[0]:
            best = found.fun, memory, start
    hyper = _hyper(best[2], nv, best[1])
    there = marginal(windows, hyper)
    return Learnt(hyper, belief.best(there.Q.sum(0)), there, _penalty(best[2], nv))


def _precision(windows: Windows) -> Array:
    """About what windows and priors tell of each logarithm (Fisher's information), so that steps are alike in all."""
    channels, count = windows.gram.shape[:2]
    force = 2 * windows.nodes * count + PRIORS.spread**-2
    noise = 2 * windows.rows * count + PRIORS.noise**-2
    return np.concatenate([np.full(windows.joints, force), np.full(channels, noise)])


def _hyper(x: Array, nv: int, memory: float) -> Hyper:
    return Hyper(np.exp(x[:nv]), memory, np.exp(x[nv:]))


def _penalty(x: Array, nv: int) -> float:
    amplitude = (x[:nv] - np.log(PRIORS.usual)) / PRIORS.spread
    return -0.5 * float(np.sum(amplitude**2) + np.sum((x[nv:] / PRIORS.noise) ** 2))


def _slope(x: Array, windows: Windows, belief: Belief, memory: float) -> tuple[float, Array]:
    """Minus log density of data, parameters and hyperparameters, and its gradient in the latter's logarithms."""
    nv, own, forces = windows.joints, 1 + windows.parameters, windows.forces
    hyper = _hyper(x, nv, memory)
    there = marginal(windows, hyper)
    Q = there.Q.sum(0)
    p = belief.best(Q)
    value = -0.5 * belief.cost(Q, p) - 0.5 * float(there.logdet.sum()) + _penalty(x, nv)
    z = there.mean @ np.concatenate([[1.0], -p])
    spread = np.diagonal(there.cov, axis1=1, axis2=2)
    slope = np.empty_like(x)
    slope[:nv] = np.sum((z**2 + spread)[:, :forces].reshape(-1, nv, windows.nodes) - 1.0, axis=(0, 2))
    slope[:nv] -= (x[:nv] - np.log(PRIORS.usual)) / PRIORS.spread**2
    along = np.concatenate([np.tile(np.concatenate([[1.0], -p]), (len(z), 1)), -z @ there.root.T], 1)
    outer = along[:, :, None] * along[:, None, :]
    outer[:, own:, own:] += there.root @ there.cov @ there.root.T
    left = windows.gram.reshape(len(hyper.noise), -1) @ outer.ravel()  # squared noise, what is open included
    slope[nv:] = left / hyper.noise**2 - windows.rows * len(z) - x[nv:] / PRIORS.noise**2
    return -value, -slope


# The columns D: what generalised forces at nodes in time do to the residuals, by finite differences


@dataclass(frozen=True)
class Sizes:
    """Pulses that represent a force. Rules of thumb, not counted.

    Attributes:
        pulse: of a finite difference, as a share of the robot's force scale. Less is lost in single precision.
        columns: forces in a window, about so many. Each costs one simulation of all windows.
    """

    pulse: float = 0.03
    columns: int = 72


SIZES = Sizes()


def default_nodes(fitter: Fitter) -> int:
    """Return number of nodes in a window: one per control step for small robots, fewer for many joints, but six."""
    steps, nv = fitter.simulator.windows.steps, fitter.simulator.nv
    return min(steps, max(6, SIZES.columns // nv))


def node_basis(steps: int, nodes: int) -> Array:
    """Return `[steps, nodes]`: linear between nodes at the centres of equal pieces, constant beyond the ends."""
    at = (np.arange(nodes) + 0.5) * steps / nodes
    return np.stack([np.interp(np.arange(steps) + 0.5, at, row) for row in np.eye(nodes)], 1)


def force_scale(fitter: Fitter) -> Array:
    """`[nv]`: the largest force, or what would stop the joint within a window where nothing drives it."""
    windows, model = fitter.simulator.windows, fitter.simulator.physics.mj_model
    found = scales.measure(model, windows.logs)
    return np.maximum(found.force, found.inertia * found.speed / (windows.steps * windows.dt))


def columns(fitter: Fitter, fit: Fit, knots: int, scale: Array | None = None) -> Array:
    """D `[W, n, nv knots]`, one simulation of all windows per column, start states as in the fit."""
    windows, nv = fitter.simulator.windows, fitter.simulator.nv
    basis = node_basis(windows.steps, knots)
    pulse = SIZES.pulse * (force_scale(fitter) if scale is None else scale)
    force = np.zeros((nv, knots, 1, windows.steps, nv))
    for v in range(nv):
        force[v, :, 0, :, v] = basis.T * pulse[v]
    count = nv * knots
    spread = np.broadcast_to(force.reshape(count, 1, windows.steps, nv), (count, len(windows), windows.steps, nv))
    theta = np.repeat(fitter.vector(fit.coordinates, fit.values)[None], count, 0)
    shifted = fitter.whiten(fitter.simulator.run(theta, np.repeat(fit.offsets[None], count, 0), force=spread))
    return np.moveaxis((fit.r[None] - shifted) / np.repeat(pulse, knots)[:, None, None], 0, -1)
