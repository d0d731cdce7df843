"""Whether what a model leaves looks like noise of the sensors or like the work of forces: two covariances compared.

A force that nobody knows moves the state, so its trace grows within a window; noise of a sensor, whatever its colour,
stays as large as it is. Residuals are taken as Gaussian with either covariance beside noise that differs from row to
row: of each sensor, and of a clock that jitters, which moves all of a row along its own rate of change. Sizes and
memories are those of the largest restricted likelihood, in which the start states have no part (Patterson and Thompson,
1971). A command whose time is off by the jitter is a force in the few windows where it jumps, so forces have to be
likelier over the windows at large.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, solve_triangular

from bayessim_mjx.diagnosis import statistics

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rules:
    """The grids of the two covariances, and how much of the residuals they are held against.

    All of 8 cases with coloured noise and jitter are called noise, all of 8 unknown causes forces: the rule was made on
    these. Counted on fresh unknown causes: none of 48 was called noise (c3b3eb0), one of 19 (40adbad). Play and an
    elastic gear behind which the motor vibrates look like noise, too (2 of 2 there).

    Attributes:
        memories: of a window's length; amounts: of the white part's variance; a grid each.
        least: noise sd, of the white part; rows: residuals in all, at most.
        steps: of a window at most, evenly spread: a spectrum costs their third power, memories are a twentieth of it.
        told: nats from which on one origin is more likely; 3 are odds of 20 to 1.
        errors: standard errors over the windows, by which it is as well.
    """

    memories: tuple[float, ...] = (0.05, 0.2, 1.0)
    amounts: tuple[float, ...] = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
    least: float = 0.3
    rows: int = 16000
    steps: int = 100
    decisive: float = 3.0
    errors: float = 1.0


RULES = Rules()


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
        """Whether nothing speaks for forces."""
        return self.force < self.sensor + RULES.decisive or self.deviate < RULES.errors


def origin(
    r: Array, B: Array, D: Array, sizes: Array, channels: int, weight: Array, rate: Array | None = None
) -> Origin:
    """Where residuals come from.

    Args:
        r: `[W, n]`, whitened, in the order of time, then of channels; B: `[W, n, s]`, columns of the start states.
        D: `[W, n, nv nodes]`, columns of forces of size 1, in the order of degrees of freedom.
        sizes: `[nv]`, standard deviations of the forces, as large beside each other as these residuals make likely.
        channels: measured ones; weight: `[W]`.
        rate: `[W, n]`, how fast what is measured changes, noise sd a second; None: no clock jitters.
    """
    nodes = D.shape[2] // len(sizes)
    D = D * np.repeat(sizes, nodes)  # a force of 1 N m is much for a wrist and little for a shoulder
    steps = r.shape[1] // channels
    shape = (len(r), steps, channels)
    even, clock = _white(r.reshape(shape), (np.zeros_like(r) if rate is None else rate).reshape(shape))
    kept = np.arange(0, steps, -(-steps // RULES.steps))  # noise of a row is as large there
    rows = (kept[:, None] * channels + np.arange(channels)).ravel()
    r, B, D, clock, steps = r[:, rows], B[:, rows], D[:, rows], clock[:, kept], len(kept)
    own = _some(weight, r.shape[1])
    size = np.sqrt(np.mean(r[own] ** 2, 0).reshape(steps, channels).mean(0))
    scale = np.sqrt(np.mean(np.einsum("wnd,wnd->wn", D[own], D[own]))) + 1e-300
    seen = [_seen(B[w], _root(np.tile(even, steps), clock[w])) for w in own]
    found: dict[str, list[tuple[float, Array]]] = {"sensor": [], "force": []}
    for memory in RULES.memories:
        alike = np.kron(_memory(steps, memory), np.diag(size / np.mean(size)) ** 2)
        pushed = np.kron(np.eye(len(sizes)), _memory(nodes, memory))
        noise = [_spectrum(r[w], alike, T) for w, T in zip(own, seen, strict=True)]
        moves = [_spectrum(r[w], D[w] @ pushed @ D[w].T / scale**2, T) for w, T in zip(own, seen, strict=True)]
        found["sensor"].append(_best(noise, weight[own]))
        found["force"].append(_best(moves, weight[own]))
    at = {kind: int(np.argmax([nats for nats, _ in of])) for kind, of in found.items()}
    (sensor, by_sensor), (force, by_force) = (found[kind][at[kind]] for kind in ("sensor", "force"))
    deviate = statistics.normal_deviate(by_force - by_sensor, np.arange(len(own)))
    return Origin(sensor, force, deviate, RULES.memories[at["sensor"]] if sensor > RULES.decisive else 0.0)


def _white(r: Array, rate: Array) -> tuple[Array, Array]:
    """What differs from row to row, from second differences of residuals `[W, steps, channels]`.

    Returns:
        (`[channels]` variances, `[W, steps, channels]` what one standard deviation of the clock moves).
    """
    jumps = np.diff(r, 2, axis=1) ** 2 / 6.0
    rate = rate / (np.sqrt(np.mean(rate**2)) + 1e-300)
    around = (rate[:, :-2] ** 2 + 4.0 * rate[:, 1:-1] ** 2 + rate[:, 2:] ** 2) / 6.0
    kinds = np.zeros((*jumps.shape, r.shape[2] + 1))
    kinds[..., :-1], kinds[..., -1] = np.eye(r.shape[2]), around  # one clock for all channels
    parts, _ = statistics.variance_parts(jumps.ravel(), kinds.reshape(jumps.size, -1))
    return np.maximum(parts[:-1], RULES.least**2), np.sqrt(parts[-1]) * rate


def _root(even: Array, clock: Array) -> Array:
    """`[n, n]`, lower, root of the white part's covariance of a window: variances `[n]` and the clock's moves."""
    steps, channels = clock.shape
    rows = np.kron(np.eye(steps), np.ones((channels, channels)))
    moved = clock.ravel()
    return np.asarray(np.linalg.cholesky(np.diag(even) + rows * np.outer(moved, moved)))


def _some(weight: Array, size: int) -> NDArray[np.int64]:
    """Windows that are looked at, evenly spread."""
    count = int(np.clip(RULES.rows // size, 4, len(weight)))
    return np.unique(np.linspace(0, len(weight) - 1, count).round().astype(np.int64))


def _memory(count: int, memory: float) -> Array:
    lag = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return np.asarray(np.exp(-lag / (memory * count)))


def _seen(B: Array, root: Array) -> Array:
    """`[n - s, n]`, what whitens a window and leaves out what its start states can do."""
    q = np.linalg.qr(solve_triangular(root, B, lower=True), mode="complete")[0][:, B.shape[1] :]
    return np.asarray(solve_triangular(root, q, lower=True, trans="T").T)


def _spectrum(r: Array, K: Array, seen: Array) -> tuple[Array, Array]:
    """(variances of K in white noise, squares of r along them), `[n - s]`."""
    values, vectors = eigh(seen @ K @ seen.T)
    return np.maximum(values, 0.0), (vectors.T @ (seen @ r)) ** 2


def _best(windows: list[tuple[Array, Array]], weight: Array) -> tuple[float, Array]:
    """Largest log likelihood over the amounts, the noise's size at its best, over white noise alone; by window too."""
    count = float(sum(w * len(v) for w, (v, _) in zip(weight, windows, strict=True)))

    def likelihood(amount: float) -> Array:
        rows = np.array([(np.sum(s / (1 + amount * v)), np.sum(np.log1p(amount * v)), len(v)) for v, s in windows])
        level = float(weight @ rows[:, 0]) / count
        return np.asarray(-0.5 * weight * (rows[:, 2] * np.log(level) + rows[:, 0] / level + rows[:, 1]))

    every = [likelihood(amount) for amount in RULES.amounts]
    best = max(every, key=np.sum)
    return float(np.sum(best) - np.sum(every[0])), best
