"""A classifier trained on simulations: which candidate's simulated gap looks like the recorded one?

Linear discriminants (Fisher, 1936) with a shrunk common covariance, on directions of the gap outside of what known
parameters and start states explain.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from bayessim_mjx.diagnosis.fitting.candidates import Candidate

SIMULATED = 1500  # in all, shared by the candidates
FEW, MANY = 6, 32  # simulations of one candidate
WINDOWS = 48  # windows at most
QUIET = 1.1  # times the noise: a gap of that size is nothing
WEAKEST = -1.5  # simulated amplitudes are 10 to this, up to 1, of their range
DIRECTIONS = 60  # principal components at most
SHRINK = 0.2
Array = np.ndarray
Label = tuple[int, int, bool]  # candidate, its largest amplitude, whether that is positive


class Discriminants:
    """Fisher's discriminants of labelled rows `[n, d]`, equal priors."""

    def __init__(self, rows: Array, labels: Sequence[Label]) -> None:
        self.classes = sorted(set(labels))
        index = np.array([self.classes.index(label) for label in labels])
        self.middle = rows.mean(0)
        self.basis = _principal(rows - self.middle, min(DIRECTIONS, max(len(rows) - len(self.classes), 1)))
        x = (rows - self.middle) @ self.basis.T
        self.means = np.stack([x[index == k].mean(0) for k in range(len(self.classes))])
        within = x - self.means[index]
        covariance = within.T @ within / len(x)
        ridge = SHRINK * np.trace(covariance) / len(covariance) + 1e-12
        self.precision = np.linalg.inv((1 - SHRINK) * covariance + ridge * np.eye(len(covariance)))

    def __call__(self, row: Array) -> Label:
        x = self.basis @ (row - self.middle)
        along = self.means @ self.precision
        return self.classes[int(np.argmax(along @ x - 0.5 * np.sum(along * self.means, 1)))]


def _principal(x: Array, count: int) -> Array:
    """The first principal directions of rows, `[at most count, d]`, by their Gram matrix: rows are long."""
    value, vector = np.linalg.eigh(x @ x.T)
    kept = np.flatnonzero(value > 1e-9 * value[-1])[-count:]
    return (vector[:, kept] / np.sqrt(value[kept])).T @ x


def directions(r: Array) -> Array:
    """Projected gaps `[..., n]` of size 1: strength is not known beforehand."""
    return r / np.linalg.norm(r, axis=-1, keepdims=True)


def draw(candidate: Candidate, rng: np.random.Generator) -> tuple[Array, tuple[int, bool]]:
    """(random values of its parameters, which amplitude is the largest for its range and whether it is positive)."""
    c = candidate.coordinates
    low, high, neutral = (np.array([getattr(x, k) for x in c]) for k in ("low", "high", "neutral"))
    size = 10 ** rng.uniform(WEAKEST, 0) * rng.uniform(0.2, 1.0, len(c))
    sign = np.where(low < neutral, np.where(high > neutral, rng.choice([-1, 1], len(c)), -1), 1)
    room = np.where(sign > 0, high - neutral, neutral - low)
    shapes = np.array(candidate.shapes)
    values = np.where(shapes, rng.uniform(low, high), neutral + sign * size * room)
    largest = int(np.argmax(np.where(shapes, -1.0, size)))
    return values, (largest, bool(sign[largest] > 0))


class Outside:
    """Projects whitened gaps `[..., W, n]` onto what base parameters inside their bounds and start states cannot do."""

    def __init__(self, fit: Any, own: Array) -> None:
        self.starts = np.linalg.qr(fit.B[own])[0]
        _, _, below, above = fit.prior()
        inside = np.minimum(-below, above) > 1e-6 * (above - below)
        A = self._without_starts(np.moveaxis(fit.A[own][:, :, inside], 2, 0))
        flat = A.reshape(len(A), own.size * fit.A.shape[1]).T
        left, size, _ = np.linalg.svd(flat, full_matrices=False)
        self.base = left[:, size > 1e-6 * max(size.max(initial=0.0), 1e-300)]

    def _without_starts(self, r: Array) -> Array:
        return r - np.einsum("wns,wms,...wm->...wn", self.starts, self.starts, r, optimize=True)

    def __call__(self, r: Array) -> Array:
        flat = self._without_starts(r).reshape(*r.shape[:-2], -1)
        return flat - (flat @ self.base) @ self.base.T


def classify(fitter: Any, fit: Any, candidates: Sequence[Candidate], rng: np.random.Generator) -> Candidate | None:
    """The candidate whose simulations look most like the gap that the fit leaves; None: looks like noise.

    The simulations stand on the recalibrated simulator, with fresh noise; those that noise hides teach nothing.
    """
    own = np.unique(np.linspace(0, len(fit.r) - 1, min(len(fit.r), WINDOWS)).round().astype(int))
    each = int(np.clip(SIMULATED // max(len(candidates), 1), FEW, MANY))
    thetas, drawn = [], []
    for i, candidate in enumerate(candidates):
        for _ in range(each):
            values, kind = draw(candidate, rng)
            drawn.append((i, *kind))
            thetas.append(fitter.vector((*fit.coordinates, *candidate.coordinates), np.append(fit.values, values)))
    offsets = np.repeat(fit.offsets[None], len(thetas), 0)[:, own]
    # reality minus the recalibrated simulator, were the candidate reality
    column = fit.r[own] - fitter.whiten(fitter.simulator.run(np.stack(thetas), offsets, own))
    outside = Outside(fit, own)
    clean, recorded = outside(column), outside(fit.r[own])
    noise = outside(rng.normal(size=column.shape))
    loud = np.linalg.norm(noise, axis=1)
    if np.linalg.norm(recorded) < QUIET * loud.max():
        return None
    seen = np.linalg.norm(clean, axis=1) > loud / 3
    labels = [d for d, s in zip(drawn, seen, strict=True) if s]
    label = Discriminants(directions((clean + noise)[seen]), labels)(directions(recorded))
    return candidates[label[0]]
