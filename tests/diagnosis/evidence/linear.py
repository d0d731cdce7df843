"""Linear systems whose evidence is known in closed form: windows drawn from the model's own density."""

from dataclasses import dataclass

import numpy as np

from bayessim_mjx.diagnosis.evidence.gaussian import Belief, windows_of

CHANNELS, ROWS, NODES, STARTS, SPREAD = 2, 12, 4, 2, 0.7


@dataclass
class Drawn:
    """Windows of one joint with two channels: residuals `[W, n]`, columns, and what was drawn."""

    r: np.ndarray
    A: np.ndarray
    B: np.ndarray
    D: np.ndarray
    p: np.ndarray
    scale: np.ndarray

    def windows(self, columns=slice(None)):
        A = self.A[:, :, columns]
        offsets = np.zeros((len(self.r), STARTS))
        return windows_of(self.r, A, self.B, self.D, offsets, np.full(STARTS, SPREAD), self.scale, CHANNELS)


def covariance(amplitude, memory, noise, B, D, scale):
    """`[n, n]` of one window's residual, written out."""
    lag = np.abs(np.subtract.outer(np.arange(NODES), np.arange(NODES)))
    force = (amplitude * scale[0]) ** 2 * (np.exp(-lag / memory) + 1e-9 * np.eye(NODES))
    return D @ force @ D.T + SPREAD**2 * B @ B.T + np.diag(np.tile(np.square(noise), ROWS))


def draw(seed, count=40, k=2, amplitude=0.02, memory=4.0, noise=(1.0, 1.2), p=None, gain=300.0):
    """Windows with parameters `p` (standard normal if not given)."""
    rng = np.random.default_rng(seed)
    n, scale = CHANNELS * ROWS, np.array([3.0])
    A, B = rng.normal(size=(count, n, k)), rng.normal(size=(count, n, STARTS))
    D = gain / scale * np.cumsum(rng.normal(size=(count, n, NODES)), 1) / n
    p = rng.normal(size=k) if p is None else np.asarray(p, float)
    r = np.stack(
        [
            rng.multivariate_normal(a @ p, covariance(amplitude, memory, noise, b, d, scale))
            for a, b, d in zip(A, B, D, strict=True)
        ]
    )
    return Drawn(r, A, B, D, p, scale)


def wide(k, precision=1.0):
    """A normal prior without bounds."""
    return Belief(np.full(k, precision), np.zeros(k), np.full(k, -np.inf), np.full(k, np.inf))
