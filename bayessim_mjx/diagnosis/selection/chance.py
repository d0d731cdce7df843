"""What the best of all candidates gains where nothing is missing: a bootstrap of the recalibrated model's residuals.

A null log is what the recalibrated simulator predicts, plus noise as these logs have it. The noise is Gaussian with the
residuals' own covariance over a window and its channels, and as large in each window as it is there. So it has the
colour of the residuals, and what jittering clocks and encoder steps do to them, without a model of either. Everything
else is linear: the screened columns stay, each amplitude is fitted without the condition that it is scored on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.selection.screen import looked_at
from bayessim_mjx.diagnosis.selection.tried import Tried

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rules:
    """How many null logs there are, and how many at a time."""

    draws: int = 500
    chunk: int = 20


RULES = Rules()


@dataclass(frozen=True, eq=False)
class Columns:
    """Candidates as columns on the windows that were looked at.

    Attributes:
        a: `[w, n, k]`, projected and weighted; low, high: `[k]`, multiples of them that the ranges allow.
        r: `[w, n]`, residuals, weighted alike; weight, group: `[w]`.
        samples: independent residuals in a window; noise: expected cost of a window under a perfect model.
    """

    a: Array
    low: Array
    high: Array
    r: Array
    weight: Array
    group: NDArray[np.int64]
    samples: float
    noise: float


def of(tried: Tried, seed: int = 0) -> Array:
    """`[draws]` nats of held-out log predictive density that the best candidate gains in null logs, ascending."""
    fit, base = tried.base.fit, tried.base
    own = looked_at(fit, tried.settings.screened)
    shape = (len(own), fit.r.shape[1])
    kept = [s for s in tried.screened if s.absorbed < 1.0 and s.column.shape == shape and s.way.any()]
    if not kept:
        return np.zeros(0)
    low, high = np.array([s.room for s in kept]).T
    root = np.sqrt(fit.weight[own])[:, None]
    columns = Columns(
        np.stack([s.column for s in kept], 2), low, high, fit.r[own] * root, fit.weight[own],
        tried.fitter.simulator.windows.group[own], base.samples / len(fit.r), tried.noise,
    )  # fmt: skip
    return np.sort(best_gains(columns, np.random.default_rng(seed)))


def probability(gains: Array, nats: float) -> float:
    """Share of null logs in which the best candidate gains so much, the logs at hand counted as one of them."""
    return float((1 + np.sum(gains >= nats)) / (len(gains) + 1))


def best_gains(columns: Columns, rng: np.random.Generator, draws: int = RULES.draws) -> Array:
    """`[draws]`, what the best candidate gains in each null log."""
    done = range(0, draws, RULES.chunk)
    return np.concatenate([gains(columns, noise(columns.r, rng, min(RULES.chunk, draws - i))).max(1) for i in done])


def noise(r: Array, rng: np.random.Generator, draws: int) -> Array:
    """`[draws, w, n]` with the covariance of the windows r `[w, n]`, each window as large as it is."""
    size = np.sqrt(np.mean(r**2, 1, keepdims=True))
    mix = rng.normal(size=(draws, len(r), len(r))) / np.sqrt(np.sum(size**2) + 1e-300)
    return np.asarray(size * (mix @ r))


def gains(columns: Columns, e: Array) -> Array:
    """`[draws, k]` nats by which each candidate alone predicts residuals e `[draws, w, n]` better, held out.

    One condition is held out window by window.
    """
    c = columns
    names, index = np.unique(c.group, return_inverse=True)
    index = index if len(names) > 1 else np.arange(len(c.group))
    member = (index == np.arange(index.max() + 1)[:, None]).astype(float)  # [G, w]
    x = np.moveaxis(np.swapaxes(e, 0, 1) @ c.a, 0, 1)  # [draws, w, k]
    s = np.sum(c.a**2, 1)  # [w, k]
    rest_x, rest_s = (total - member @ v for total, v in ((x.sum(1, keepdims=True), x), (s.sum(0), s)))
    t = np.clip(rest_x / np.maximum(rest_s, 1e-300), c.low, c.high)[:, index]
    before = np.sum(e**2, 2)[..., None]
    after = before - 2 * t * x + t**2 * s
    level = c.noise * c.weight[:, None]
    return np.asarray(c.samples * np.sum(np.log((before + level) / (np.maximum(after, 0.0) + level)), 1))
