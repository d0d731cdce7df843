"""The force that is missing in each window, under the model of the evidence; whether it is one, or noise of sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from bayessim_mjx.diagnosis.evidence import gaussian
from bayessim_mjx.diagnosis.evidence.gaussian import Hyper, Learnt, learn, windows_of
from bayessim_mjx.diagnosis.evidence.parameters import belief_of
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.quadratic import Quadratic, eliminate
from bayessim_mjx.diagnosis.selection.numbers import EFFORT, ODDS, PRIORS
from bayessim_mjx.diagnosis.statistics import Z90, normal_deviate, times, variance_parts

Array = NDArray[np.float64]
DECISIVE = float(np.log(ODDS.strong))  # nats


@dataclass(frozen=True, eq=False)
class Linear:
    """A fit's residuals as a linear function of a force over each window.

    Attributes:
        D: `[W, n, nv m]`, minus the derivative of the whitened residual; column v m + k: force of dof v, node k.
        basis: `[H, m]`, force in each control step from the forces at the nodes.
        scale: `[nv]`, size of the forces of this robot, N m or N.
        quadratic: in (the fit's parameters' steps, forces), start states eliminated.
    """

    D: Array
    basis: Array
    scale: Array
    quadratic: Quadratic

    @property
    def nodes(self) -> int:
        """m, of each window."""
        return int(self.basis.shape[1])

    @property
    def average(self) -> Array:
        """`[H, m]`, means around the nodes of what is known in each control step."""
        return np.asarray(self.basis / self.basis.sum(0))


def linearise(fitter: Fitter, fit: Fit, knots: int | None = None, D: Array | None = None) -> Linear:
    """Return the residuals' linear model about a fit.

    Args:
        knots: m, None: as many as are cheap; D: columns of another fit of these windows, to save the simulations.
    """
    knots = gaussian.default_nodes(fitter) if knots is None else knots
    scale = gaussian.force_scale(fitter)
    D = gaussian.columns(fitter, fit, knots, scale) if D is None else D
    q, _ = eliminate(fit.r, np.concatenate([fit.A, D], 2), fit.B, fit.offsets, fit.spread)
    return Linear(D, gaussian.node_basis(fitter.simulator.windows.steps, D.shape[2] // len(scale)), scale, q)


@dataclass(frozen=True, eq=False)
class Disturbance:
    """The estimated force.

    Attributes:
        force: `[W, m, nv]`, posterior mean, N m or N.
        gain: `[W, nv, m, m]`, expected mean = gain times a true force on this dof (the prior pulls to zero).
        values: `[k]`, the fit's parameters, estimated together with the force.
        time: `[m]` s after the windows' starts.
        linear: what it was computed from.
    """

    force: Array
    gain: Array
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


def estimate(fitter: Fitter, fit: Fit, linear: Linear | None = None) -> Disturbance:
    """Return the smooth force that a fit's residuals make likely; `linear`: of this fit, None: made here.

    With the prior covariance R R' of the force and its posterior covariance R C R', the mean is R (1 - C) R^-1 times a
    true force. The residuals are linearised anew about a first estimate.
    """
    linear = linearise(fitter, fit) if linear is None else linear
    first = _learnt(fitter, fit, linear, fit.r)
    linear, r = _anew(fitter, fit, linear, first)
    found = _learnt(fitter, fit, linear, r, [first.hyper])
    there, step, size = found.marginal, found.step, linear.D.shape[2]
    cut, shape = fitter.simulator.windows, (len(r), len(linear.scale), linear.nodes)
    root = np.repeat(linear.scale, linear.nodes)[:, None] * there.root[:size, :size]
    gain = root @ (np.eye(size) - there.cov[:, :size, :size]) @ np.linalg.inv(root)
    return Disturbance(
        force=_force(linear, found),
        gain=np.einsum("wvivj->wvij", gain.reshape(*shape, *shape[1:])),
        values=fit.values + step,
        time=(np.arange(linear.nodes) + 0.5) * cut.steps * cut.dt / linear.nodes,
        linear=linear,
    )


def _learnt(fitter: Fitter, fit: Fit, linear: Linear, r: Array, like: Sequence[Hyper] = ()) -> Learnt:
    channels = int(fitter.used.sum())
    windows = windows_of(r, fit.A, fit.B, linear.D, fit.offsets, fit.spread, linear.scale, channels)
    return learn(windows, belief_of(fit), like)


def _means(found: Learnt) -> Array:
    """`[W, nv m + s]`, posterior means of forces in units of their scale and of start states in their spread."""
    one = np.concatenate([[1.0], -found.step])
    return np.asarray(found.marginal.mean @ one @ found.marginal.root.T)


def _force(linear: Linear, found: Learnt) -> Array:
    """`[W, m, nv]`, N m or N."""
    own = _means(found)[:, : linear.D.shape[2]].reshape(-1, len(linear.scale), linear.nodes)
    return np.swapaxes(own, 1, 2) * linear.scale


def _anew(fitter: Fitter, fit: Fit, linear: Linear, found: Learnt) -> tuple[Linear, Array]:
    """(linear model, residuals `[W, n]`) simulated at an estimate and taken back; windows only where it fits better."""
    force, start = _force(linear, found), np.zeros_like(fit.offsets)
    own = fit.B.any((0, 1))  # those that `windows_of` takes
    start[:, own] = _means(found)[:, linear.D.shape[2] :] * fit.spread[own]
    theta = fitter.vector(fit.coordinates, fit.values + found.step)
    acting, flat = np.einsum("hm,wmv->whv", linear.basis, force), np.swapaxes(force, 1, 2).reshape(len(force), -1)
    r = fitter.whiten(fitter.simulator.run(theta[None], start[None], force=acting[None]))[0]
    back = r + times(linear.D, flat) + times(fit.B, start - fit.offsets) + fit.A @ found.step
    back = np.where((np.sum(r**2, 1) < np.sum(fit.r**2, 1))[:, None], back, fit.r)
    q, _ = eliminate(back, np.concatenate([fit.A, linear.D], 2), fit.B, fit.offsets, fit.spread)
    return replace(linear, quadratic=q), back


def pooled(values: Array, reliability: Array, axis: int | tuple[int, ...] | None = None) -> Array:
    """Mean of a true force from posterior means: their sum over the sum of their reliabilities; 0 of none."""
    return np.asarray(np.sum(values, axis) / np.maximum(np.sum(reliability, axis), np.finfo(np.float64).tiny))


@dataclass(frozen=True)
class Origin:
    """Log likelihoods of what remains, over that of white noise.

    Attributes:
        sensor, force: nats; deviate: of what the force has more, over its standard error.
        memory: of the noise of sensors, as a share of a window's length; 0 where it is white.
    """

    sensor: float
    force: float
    deviate: float
    memory: float

    @property
    def of_sensors(self) -> bool:
        """Whether nothing speaks for forces: no strong odds, or no more than a standard error over the windows."""
        return self.force < self.sensor + DECISIVE or self.deviate < 1


def origin(
    r: Array, B: Array, D: Array, sizes: Array, channels: int, weight: Array, rate: Array | None = None
) -> Origin:
    """Whether what a model leaves looks like noise of the sensors or like the work of forces: two covariances compared.

    A force that nobody knows moves the state, so its trace grows within a window; noise of a sensor, whatever its
    colour, stays as large as it is. Residuals are taken as Gaussian with either covariance beside noise that differs
    from row to row: of each sensor, and of a clock that jitters, which moves all of a row along its own rate of change.
    Sizes and memories are those of the largest restricted likelihood, in which the start states have no part (Patterson
    and Thompson, 1971). Memories are a window's length and quarters of it, down to a row. A command whose time is off
    by the jitter is a force in the few windows where it jumps, so forces have to be likelier over the windows at large.

    Counted on fresh unknown causes: none of 48 was called noise (c3b3eb0), one of 19 (40adbad). Play, and an elastic
    gear behind which the motor vibrates, look like noise, too (2 of 2 there).

    Args:
        r: `[W, n]`, whitened, in the order of time, then of channels; B: `[W, n, s]`, columns of the start states.
        D: `[W, n, nv m]`, columns of forces of size 1, in the order of degrees of freedom.
        sizes: `[nv]`, standard deviations of the forces, as large beside each other as these residuals make likely.
        channels: measured ones; weight: `[W]`.
        rate: `[W, n]`, how fast what is measured changes, noise sd a second; None: no clock jitters.
    """
    nodes, steps = D.shape[2] // len(sizes), r.shape[1] // channels
    D = D * np.repeat(sizes, nodes)  # a force of 1 N m is much for a wrist and little for a shoulder
    even, clock = _white(*(x.reshape(len(r), steps, channels) for x in (r, np.zeros_like(r) if rate is None else rate)))
    kept = np.arange(0, steps, -(-steps // gaussian.SIZES.columns))  # noise of a row is as large there
    rows, steps = (kept[:, None] * channels + np.arange(channels)).ravel(), len(kept)
    own = np.unique(np.linspace(0, len(r) - 1, min(len(r), EFFORT.windows)).round().astype(np.int64))
    r, B, D, clock, weight = r[own][:, rows], B[own][:, rows], D[own][:, rows], clock[own][:, kept], weight[own]
    root = np.zeros((len(own), len(rows), len(rows)))
    for step in range(steps):
        at, moved = slice(step * channels, (step + 1) * channels), clock[:, step]
        root[:, at, at] = np.linalg.cholesky(np.diag(even) + moved[:, :, None] * moved[:, None, :])
    start = np.linalg.qr(np.linalg.solve(root, B), mode="complete")[0][:, :, B.shape[2] :]
    seen = np.linalg.solve(root.mT, start).mT  # whitens a window and leaves out what its start states can do
    shares = np.mean(r.reshape(len(own), steps, channels) ** 2, (0, 1))
    found: dict[str, list[tuple[float, Array, float]]] = {"sensor": [], "force": []}
    for memory in 4.0 ** -np.arange(1 + int(np.log(steps) / np.log(4.0))):
        alike = np.kron(_alike(steps, memory), np.diag(shares))
        pushed = D @ np.kron(np.eye(len(sizes)), _alike(nodes, memory)) @ D.mT
        for kind, K in (("sensor", alike), ("force", pushed)):
            found[kind].append((*_likeliest(seen @ K @ seen.mT, times(seen, r), weight), float(memory)))
    (sensor, by_sensor, memory), (force, by_force, _) = (max(of, key=lambda f: f[0]) for of in found.values())
    deviate = normal_deviate(by_force - by_sensor, np.arange(len(own)))
    return Origin(sensor, force, deviate, memory if sensor > DECISIVE else 0.0)


def _alike(count: int, memory: float) -> Array:
    lag = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return np.asarray(np.exp(-lag / (memory * count)))


def _likeliest(K: Array, r: Array, weight: Array) -> tuple[float, Array]:
    """Largest log likelihood of r `[W, n]` over amounts of K `[W, n, n]` beside white noise; over that noise alone.

    The size of both together is at its best. Returns: (nats, log likelihoods `[W]`).
    """
    values, vectors = np.linalg.eigh(K / np.mean(np.einsum("wii->wi", K)))
    values, square = np.maximum(values, 0.0), times(vectors.mT, r) ** 2

    def each(amount: float) -> Array:
        misfit, logs = np.sum(square / (1 + amount * values), 1), np.sum(np.log1p(amount * values), 1)
        level = float(weight @ misfit) / float(weight.sum() * r.shape[1])
        return np.asarray(-0.5 * weight * (r.shape[1] * np.log(level) + misfit / level + logs))

    ends = np.array([1, -1]) * np.log(np.finfo(np.float32).eps)  # beyond, one of both has no part
    best = minimize_scalar(lambda x: -float(each(np.exp(x)).sum()), bounds=ends, method="bounded").x
    return float(np.sum(each(np.exp(best)) - each(0.0))), each(np.exp(best))


def _white(r: Array, rate: Array) -> tuple[Array, Array]:
    """Return the noise from row to row, from second differences of residuals `[W, steps, channels]`.

    Returns:
        (`[channels]` variances, no less than what 5 % of the noise's prior are below, `[W, steps, channels]` what one
        standard deviation of the clock moves).
    """
    jumps = np.diff(r, 2, axis=1) ** 2 / 6.0
    rate = rate / (np.sqrt(np.mean(rate**2)) + 1e-300)
    around = (rate[:, :-2] ** 2 + 4.0 * rate[:, 1:-1] ** 2 + rate[:, 2:] ** 2) / 6.0
    kinds = np.zeros((*jumps.shape, r.shape[2] + 1))
    kinds[..., :-1], kinds[..., -1] = np.eye(r.shape[2]), around  # one clock for all channels
    parts, _ = variance_parts(jumps.ravel(), kinds.reshape(jumps.size, -1))
    return np.maximum(parts[:-1], np.exp(-2 * Z90 * PRIORS.noise)), np.sqrt(parts[-1]) * rate
