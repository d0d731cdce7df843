"""Whether what a model leaves looks like noise of the sensors or like the work of forces: two covariances compared.

A force that nobody knows moves the state, so its trace grows within a window; noise of a sensor, whatever its colour,
stays as large as it is. Residuals are taken as Gaussian with either covariance beside white noise; sizes and memories
are those of the largest restricted likelihood, in which the start states have no part (Patterson and Thompson, 1971).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rules:
    """What is tried, and how much is looked at.

    Error rates were not counted: three cases with forces and three with noise of sensors alone, two of the former made
    from, are told rightly (benchmarks/results.md, "Diagnosis: one decision").

    Attributes:
        memories: of a window's length; amounts: of the white part's variance; a grid each.
        least: noise sd, of the white part; rows: residuals in all, at most.
        told: nats from which on one origin is more likely; 3 are odds of 20 to 1.
    """

    memories: tuple[float, ...] = (0.05, 0.2, 1.0)
    amounts: tuple[float, ...] = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
    least: float = 0.3
    rows: int = 16000
    told: float = 3.0


RULES = Rules()


@dataclass(frozen=True)
class Origin:
    """Log likelihoods of what remains, over that of white noise.

    Attributes:
        sensor, force: nats; memory: of the noise of sensors, as a share of a window's length; 0 where it is white.
    """

    sensor: float
    force: float
    memory: float

    @property
    def of_sensors(self) -> bool:
        """Whether nothing speaks for forces."""
        return self.force < self.sensor + RULES.told


def origin(r: Array, B: Array, D: Array, sizes: Array, channels: int, weight: Array) -> Origin:
    """Where residuals come from.

    Args:
        r: `[W, n]`, whitened, in the order of time, then of channels; B: `[W, n, s]`, columns of the start states.
        D: `[W, n, nv nodes]`, columns of forces of size 1, in the order of degrees of freedom.
        sizes: `[nv]`, standard deviations of the forces, as large beside each other as these residuals make likely.
        channels: measured ones; weight: `[W]`.
    """
    nodes = D.shape[2] // len(sizes)
    D = D * np.repeat(sizes, nodes)  # a force of 1 N m is much for a wrist and little for a shoulder
    steps = r.shape[1] // channels
    white = np.tile(_white(r.reshape(len(r), steps, channels)), steps)
    own = _some(weight, r.shape[1])
    size = np.sqrt(np.mean(r[own] ** 2, 0).reshape(steps, channels).mean(0))
    scale = np.sqrt(np.mean(np.einsum("wnd,wnd->wn", D[own], D[own]))) + 1e-300
    nats: dict[str, list[float]] = {"sensor": [], "force": []}
    for memory in RULES.memories:
        alike = np.kron(_memory(steps, memory), np.diag(size / np.mean(size)) ** 2)
        pushed = np.kron(np.eye(len(sizes)), _memory(nodes, memory))
        nats["sensor"].append(_best([_spectrum(r[w], B[w], alike, white) for w in own], weight[own]))
        each = (_spectrum(r[w], B[w], D[w] @ pushed @ D[w].T / scale**2, white) for w in own)
        nats["force"].append(_best(list(each), weight[own]))
    sensor = max(nats["sensor"])
    at = RULES.memories[int(np.argmax(nats["sensor"]))]
    return Origin(sensor, max(nats["force"]), at if sensor > RULES.told else 0.0)


def _white(r: Array) -> Array:
    """`[channels]`, standard deviation of what differs from row to row, from second differences."""
    return np.maximum(np.sqrt(np.mean(np.diff(r, 2, axis=1) ** 2, axis=(0, 1)) / 6.0), RULES.least)


def _some(weight: Array, size: int) -> NDArray[np.int64]:
    """Windows that are looked at, evenly spread."""
    count = int(np.clip(RULES.rows // size, 4, len(weight)))
    return np.unique(np.linspace(0, len(weight) - 1, count).round().astype(np.int64))


def _memory(count: int, memory: float) -> Array:
    lag = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return np.asarray(np.exp(-lag / (memory * count)))


def _spectrum(r: Array, B: Array, K: Array, white: Array) -> tuple[Array, Array]:
    """(variances of K in white noise, squares of r along them), `[n - s]`, what start states can do left out."""
    q = np.linalg.qr(B / white[:, None], mode="complete")[0][:, B.shape[1] :]
    values, vectors = eigh(q.T @ (K / np.outer(white, white)) @ q)
    return np.maximum(values, 0.0), (vectors.T @ (q.T @ (r / white))) ** 2


def _best(windows: list[tuple[Array, Array]], weight: Array) -> float:
    """Largest log likelihood over the amounts, with the noise's size at its best, over that of white noise alone."""
    count = float(sum(w * len(v) for w, (v, _) in zip(weight, windows, strict=True)))

    def likelihood(amount: float) -> float:
        rows = [(np.sum(s / (1 + amount * v)), np.sum(np.log1p(amount * v))) for v, s in windows]
        squares, logs = (float(weight @ np.array([row[i] for row in rows])) for i in (0, 1))
        return -0.5 * (count * np.log(squares / count) + logs)

    every = [likelihood(amount) for amount in RULES.amounts]
    return max(every) - every[0]
