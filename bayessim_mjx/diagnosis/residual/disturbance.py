"""The generalised force that is missing in each window: finite-difference columns, a smooth estimate, its spread.

Around a fit a window's residual is  r = D d + B x + A p + noise:  d the force at nodes in time, x the start state,
p the parameters. The force has a Gaussian-process prior; the marginal likelihood chooses its strength and smoothness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting import scales
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.quadratic import Quadratic, Starts, eliminate, solve

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sizes:
    """Pulses that represent the missing force. Rules of thumb, not counted.

    Attributes:
        pulse: of a finite difference, as a share of the robot's force scale. Less is lost in single precision.
        columns: forces in a window, about so many. Each costs one simulation of all windows.
    """

    pulse: float = 0.03
    columns: int = 72


SIZES = Sizes()


@dataclass(frozen=True, eq=False)
class Linear:
    """A fit's residuals as a linear function of a force over each window.

    Attributes:
        D: `[W, n, nv m]`, minus the derivative of the whitened residual; column v m + k: force of dof v, node k.
        basis: `[H, m]`, force in each control step from the forces at the nodes.
        scale: `[nv]`, size of the forces of this robot, N m or N.
        r: `[W, n]`, residuals extrapolated to no force, no parameter step and the fit's start states.
        quadratic: in (the fit's parameters' steps, forces), start states eliminated; starts: what was eliminated.
    """

    D: Array
    basis: Array
    scale: Array
    r: Array
    quadratic: Quadratic
    starts: Starts

    @property
    def nodes(self) -> int:
        return int(self.basis.shape[1])

    def forces(self, flat: Array) -> Array:
        """`[..., nv m]` -> `[..., H, nv]`, per control step."""
        nodes = flat.reshape(*flat.shape[:-1], len(self.scale), self.nodes)
        return np.einsum("hm,...vm->...hv", self.basis, nodes)


def default_nodes(fitter: Fitter) -> int:
    """One node per control step for small robots, fewer where every joint needs its own columns."""
    steps, nv = fitter.simulator.windows.steps, fitter.simulator.nv
    return min(steps, max(6, SIZES.columns // nv))


def node_basis(steps: int, nodes: int) -> Array:
    """`[steps, nodes]`: linear between nodes at the centres of equal pieces of the window, constant beyond the ends."""
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


def linearise(fitter: Fitter, fit: Fit, knots: int | None = None, D: Array | None = None) -> Linear:
    """Columns and quadratic at the fit's point; D: columns of another fit, to save the simulations."""
    knots = default_nodes(fitter) if knots is None else knots
    scale = force_scale(fitter)
    D = columns(fitter, fit, knots, scale) if D is None else D
    q, starts = eliminate(fit.r, np.concatenate([fit.A, D], 2), fit.B, fit.offsets, fitter.spread)
    return Linear(D, node_basis(fitter.simulator.windows.steps, knots), scale, fit.r, q, starts)


@dataclass(frozen=True)
class Priors:
    """First guesses of the missing force, from which its likelihood is maximised. Rules of thumb, not counted.

    Attributes:
        amplitudes: of the force scale, a decade apart: from an integrator's error to a tenth of the drives' forces.
        memories: node spacings over which the force stays alike: from white to the length of a window.
        noise: lower end of the factor on the noise's variance, so that no force takes over all of the noise.
    """

    amplitudes: tuple[float, ...] = (0.0001, 0.001, 0.01, 0.1)
    memories: tuple[float, ...] = (1.0, 4.0, 16.0)
    noise: float = 0.3


PRIORS = Priors()


@dataclass(frozen=True, eq=False)
class Disturbance:
    """The estimated force.

    Attributes:
        force, sd: `[W, m, nv]`, posterior mean and standard deviation, N m or N.
        gain: `[W, nv, m, m]`, expected mean = gain times a true force on this dof (the prior pulls to zero).
        amplitude: `[nv]`, prior standard deviation.
        noise: factor on the standard deviation of the measurement noise.
        values: `[k]`, the fit's parameters, estimated together with the force.
        time: `[m]` s after the windows' starts.
        linear: what it was computed from.
    """

    force: Array
    sd: Array
    gain: Array
    amplitude: Array
    noise: float
    values: Array
    time: Array
    linear: Linear

    @property
    def reliability(self) -> Array:
        """`[W, m, nv]`, how much of a constant force the mean shows at each node."""
        return np.moveaxis(self.gain.sum(3), 1, 2)

    @property
    def flat(self) -> Array:
        """`[W, nv m]`, in the order of the columns."""
        return np.swapaxes(self.force, 1, 2).reshape(len(self.force), -1)


def estimate(
    fitter: Fitter,
    fit: Fit,
    knots: int | None = None,
    *,
    linear: Linear | None = None,
    free: bool = True,
    rounds: int = 2,
) -> Disturbance:
    """The smooth force that explains the fit's residuals best.

    Args:
        knots: nodes per window; None: as many as are cheap.
        linear: from `linearise`, None: made here.
        free: the fit's parameters are estimated with the force (within their bounds), else they stay.
        rounds: how often the residuals are linearised anew around the estimate.
    """
    linear = linearise(fitter, fit, knots) if linear is None else linear
    posterior = _strongest(fitter, fit, linear, free)
    for _ in range(rounds):
        linear = _relinearise(fitter, fit, linear, posterior)
        posterior = _refined(replace(posterior, linear=linear), 6)
    return _finish(fitter, fit, posterior)


@dataclass(frozen=True, eq=False)
class _Posterior:
    """State of the search: hyperparameters and what follows from them."""

    linear: Linear
    fit: Fit
    free: bool
    memory: float  # in node spacings
    amplitude: Array
    noise: float = 1.0  # variance
    p: Array = None  # type: ignore[assignment]  # [k]
    d: Array = None  # type: ignore[assignment]  # [W, nv m]
    cov: Array = None  # type: ignore[assignment]  # [W, nv m, nv m], given p
    evidence: float = -np.inf

    @property
    def correlation(self) -> Array:
        lag = np.abs(np.subtract.outer(np.arange(self.linear.nodes), np.arange(self.linear.nodes)))
        return np.exp(-lag / self.memory)

    def solved(self) -> _Posterior:
        """p by generalised least squares, then d given p; all windows at once."""
        q, k = self.linear.quadratic, self.fit.A.shape[2]
        inner = np.linalg.inv(self.correlation)
        P = np.kron(np.diag(1 / self.amplitude**2), inner)
        S = q.S / self.noise
        cov = np.asarray(np.linalg.inv(S[:, k:, k:] + P), np.float64)
        gain = cov @ S[:, k:, :k]  # [W, nv m, k]
        precision, pull, low, high = self.fit.prior()
        p = np.zeros(k)
        weight = self.fit.weight
        if self.free and k:
            Spp = np.einsum("w,wij->ij", weight, S[:, :k, :k] - np.einsum("wdi,wdj->wij", S[:, k:, :k], gain))
            gp = weight @ (q.g[:, :k] / self.noise - np.einsum("wdi,wd->wi", gain, q.g[:, k:] / self.noise))
            p = solve(Spp + np.diag(precision), gp + pull, low, high)
        g = q.g[:, k:] / self.noise - S[:, k:, :k] @ p
        d = np.einsum("wij,wj->wi", cov, g)
        cost = q.subset(np.arange(k)).at(p) / self.noise - np.einsum("wd,wd->w", g, d)
        logs = np.linalg.slogdet(cov)[1] + np.linalg.slogdet(P)[1]
        n = self.linear.r.shape[1]
        each = -0.5 * (cost - logs + n * np.log(self.noise))
        penalty = 0.5 * float(precision @ p**2 - 2 * pull @ p)
        return replace(self, p=p, d=d, cov=cov, evidence=float(weight @ each) - penalty)

    def learnt(self) -> _Posterior:
        """One step of expectation maximisation for amplitudes and noise, then solved."""
        q, k, nv = self.linear.quadratic, self.fit.A.shape[2], len(self.linear.scale)
        inner, weight = np.linalg.inv(self.correlation), self.fit.weight
        blocks = self.d.reshape(len(self.d), nv, -1)
        second = np.einsum("wvi,ij,wvj->wv", blocks, inner, blocks)
        cov = self.cov.reshape(len(self.d), nv, self.linear.nodes, nv, self.linear.nodes)
        second += np.einsum("wvivj,ij->wv", cov, inner)
        amplitude = np.sqrt(weight @ second / (weight.sum() * self.linear.nodes))
        full = np.concatenate([np.repeat(self.p[None], len(self.d), 0), self.d], 1)
        left = q.at(full) + np.einsum("wij,wji->w", q.S[:, k:, k:], self.cov)
        noise = max(float(weight @ left) / (weight.sum() * self.linear.r.shape[1]), PRIORS.noise)
        return replace(self, amplitude=np.maximum(amplitude, 1e-7 * self.linear.scale), noise=noise).solved()


def _strongest(fitter: Fitter, fit: Fit, linear: Linear, free: bool) -> _Posterior:
    """The best of a grid of amplitudes and memories, then refined."""
    trials = [
        _refined(_Posterior(linear, fit, free, memory, a * linear.scale).solved(), 2)
        for memory in PRIORS.memories
        for a in PRIORS.amplitudes
    ]
    return _refined(max(trials, key=lambda t: t.evidence), 12)


def _refined(posterior: _Posterior, times: int) -> _Posterior:
    posterior = posterior.solved()
    for _ in range(times):
        posterior = posterior.learnt()
    return posterior


def step_of_starts(linear: Linear, fit: Fit, p: Array, d: Array) -> Array:
    """dx `[W, s]`, the start states that go with a parameter step p `[k]` or `[W, k]` and forces d `[W, nv m]`."""
    full = np.concatenate([np.broadcast_to(p, (len(d), fit.A.shape[2])), d], 1)
    moved = np.einsum("wnk,wk->wn", np.concatenate([fit.A, linear.D], 2), full)
    b = linear.starts.b - np.einsum("wns,wn->ws", fit.B, moved)
    return np.einsum("wst,wt->ws", linear.starts.M, b)


def _relinearise(fitter: Fitter, fit: Fit, linear: Linear, found: _Posterior) -> Linear:
    """Residuals simulated at the estimate and taken back along the columns; kept only where it fits better there."""
    p, d = found.p, found.d
    dx = step_of_starts(linear, fit, p, d)
    theta = fitter.vector(fit.coordinates, fit.values + p)
    r = fitter.whiten(fitter.simulator.run(theta[None], (fit.offsets + dx)[None], force=linear.forces(d)[None]))[0]
    back = r + np.einsum("wnd,wd->wn", linear.D, d) + np.einsum("wns,ws->wn", fit.B, dx) + fit.A @ p
    better = np.sum(r**2, 1) < np.sum(fit.r**2, 1)
    back = np.where(better[:, None], back, linear.r)
    q, starts = eliminate(back, np.concatenate([fit.A, linear.D], 2), fit.B, fit.offsets, fitter.spread)
    return replace(linear, r=back, quadratic=q, starts=starts)


def _finish(fitter: Fitter, fit: Fit, found: _Posterior) -> Disturbance:
    linear, windows = found.linear, fitter.simulator.windows
    shape = (len(found.d), len(linear.scale), linear.nodes)
    variance = np.einsum("wii->wi", found.cov) + _from_parameters(fit, found)
    sd = np.sqrt(np.swapaxes(variance.reshape(shape), 1, 2))
    k = fit.A.shape[2]
    whole = found.cov @ linear.quadratic.S[:, k:, k:] / found.noise
    gain = np.einsum("wvivj->wvij", whole.reshape(*shape, *shape[1:]))
    spacing = windows.steps * windows.dt / linear.nodes
    return Disturbance(
        force=np.swapaxes(found.d.reshape(shape), 1, 2),
        sd=sd,
        gain=gain,
        amplitude=found.amplitude,
        noise=float(np.sqrt(found.noise)),
        values=fit.values + found.p,
        time=np.asarray((np.arange(linear.nodes) + 0.5) * spacing, np.float64),
        linear=linear,
    )


def _from_parameters(fit: Fit, found: _Posterior) -> Array:
    """`[W, nv m]`: variance of the force from not knowing the parameters exactly."""
    q, k = found.linear.quadratic, fit.A.shape[2]
    if not (found.free and k):
        return np.zeros_like(found.d)
    S = q.S / found.noise
    gain = found.cov @ S[:, k:, :k]
    Spp = np.einsum("w,wij->ij", fit.weight, S[:, :k, :k] - np.einsum("wdi,wdj->wij", S[:, k:, :k], gain))
    return np.einsum("wdi,ij,wdj->wd", gain, np.linalg.inv(Spp + np.diag(fit.prior()[0])), gain)


def pooled(values: Array, reliability: Array, axis: int | Sequence[int] | None = None) -> Array:
    """Mean of a true force from posterior means: their sum over the sum of their reliabilities."""
    axis = tuple(axis) if isinstance(axis, Sequence) else axis
    return np.sum(values, axis) / np.maximum(np.sum(reliability, axis), 1e-9)
