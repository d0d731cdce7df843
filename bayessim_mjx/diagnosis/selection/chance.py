"""What the best of all candidates gains where nothing is missing: a bootstrap of the recalibrated model's residuals.

A null log is what the recalibrated simulator predicts, plus noise as these logs have it: Gaussian, with the residuals'
own covariance over a window and its channels (the colour of encoders, what is left of their steps), as much larger in
fast motion as the residuals are (a jittering clock), and as large in each window as it is there. Everything else is
linear: the screened columns stay, each amplitude is fitted without the condition that it is scored on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.selection.screen import looked_at
from bayessim_mjx.diagnosis.selection.tried import Tried

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rules:
    """How many null logs there are; of 500, five exceed a limit of 1 %. What passes: benchmarks/results.md, "Chance".

    Attributes:
        draws: null logs; chunk: of them at a time, for the memory.
    """

    draws: int = 500
    chunk: int = 20


RULES = Rules()


@dataclass(frozen=True, eq=False)
class Columns:
    """Candidates as columns on the windows that were looked at.

    Attributes:
        a: `[w, n, k]`, projected and weighted; low, high: `[k]`, multiples of them that the ranges allow.
        base: `[w, n, b]`, the known parameters' columns, weighted alike, without what start states can do.
        precision: `[b]`, of their priors.
        r: `[w, n]`, residuals, weighted alike; profile: `[w, n]`, how large they are by the speed.
        weight, group: `[w]`.
        samples: independent residuals in a window; noise: expected cost of a window under a perfect model.
    """

    a: Array
    low: Array
    high: Array
    base: Array
    precision: Array
    r: Array
    profile: Array
    weight: Array
    group: NDArray[np.int64]
    samples: float
    noise: float


def of(tried: Tried, seed: int = 0) -> Array:
    """`[draws]` nats of held-out log predictive density that the best candidate gains in null logs, ascending."""
    columns = columns_of(tried)
    return np.sort(best_gains(columns, np.random.default_rng(seed))) if columns is not None else np.zeros(0)


def columns_of(tried: Tried) -> Columns | None:
    """The screened candidates on the known parameters' residuals; None where no candidate does anything."""
    fit, base = tried.base.fit, tried.base
    own = looked_at(fit, tried.settings.screened)
    shape = (len(own), fit.r.shape[1])
    kept = [s for s in tried.screened if s.absorbed < 1.0 and s.column.shape == shape and s.way.any()]
    if not kept:
        return None
    low, high = np.array([s.room for s in kept]).T
    root = np.sqrt(fit.weight[own])[:, None]
    return Columns(
        np.stack([s.column for s in kept], 2), low, high, _known(tried.fitter, fit, own) * root[..., None],
        fit.prior()[0], fit.r[own] * root,
        profile(fit.r, *squares(tried.fitter, fit))[own], fit.weight[own],
        tried.fitter.simulator.windows.group[own], base.samples / len(fit.r), tried.noise,
    )  # fmt: skip


def probability(gains: Array, nats: float) -> float:
    """Share of null logs in which the best candidate gains so much, the logs at hand counted as one of them."""
    return float((1 + np.sum(gains >= nats)) / (len(gains) + 1))


def best_gains(columns: Columns, rng: np.random.Generator, draws: int = RULES.draws) -> Array:
    """`[draws]`, what the best candidate gains in each null log."""
    done = range(0, draws, RULES.chunk)
    return np.concatenate([gains(columns, noise(columns, rng, min(RULES.chunk, draws - i))).max(1) for i in done])


def noise(columns: Columns, rng: np.random.Generator, draws: int) -> Array:
    """`[draws, w, n]` with the covariance of the residuals, each window as large as it is.

    The known parameters are fitted to them: what noise of the fast motions makes of these shows in all slow ones.
    """
    r = columns.r / columns.profile
    size = np.sqrt(np.mean(r**2, 1, keepdims=True))
    mix = rng.normal(size=(draws, len(r), len(r))) / np.sqrt(np.sum(size**2) + 1e-300)
    e = size * columns.profile * (mix @ r)
    flat = columns.base.reshape(-1, columns.base.shape[2])
    found = np.linalg.solve(flat.T @ flat + np.diag(columns.precision), flat.T @ e.reshape(draws, -1).T)
    return np.asarray(e - (flat @ found).T.reshape(e.shape))


def _known(fitter: Fitter, fit: Fit, own: NDArray[np.int64]) -> Array:
    """The known parameters' columns on some windows, without what start states can do, `[w, n, b]`."""
    A, B = fit.A[own], fit.B[own]
    inner = np.linalg.inv(np.einsum("wns,wnt->wst", B, B) + np.diag(1 / fitter.spread**2))
    return np.asarray(A - B @ (inner @ np.einsum("wns,wnk->wsk", B, A)))


def squares(fitter: Fitter, fit: Fit) -> tuple[Array, Array]:
    """(`[W, n]`, `[W, n]`), variances of the residuals by noise of 1, and by noise as large as the rate of change.

    Start states take a part of either: where a motion turns, something of the noise beside it is left.
    """
    rate = fitter.rate()
    even, moving = np.empty_like(rate), np.empty_like(rate)
    for w, B in enumerate(fit.B):
        left = np.eye(len(B)) - B @ np.linalg.solve(B.T @ B + np.diag(1 / fitter.spread**2), B.T)
        even[w], moving[w] = np.sum(left**2, 1), left**2 @ rate[w] ** 2
    return even, moving


def profile(r: Array, even: Array, moving: Array) -> Array:
    """`[W, n]`, standard deviation of residuals whose variance is a part of each of two, all `[W, n]`."""
    both = np.stack([even.ravel(), moving.ravel() / (np.mean(moving) + 1e-300)], 1)
    _, level = statistics.variance_parts(r.ravel() ** 2, both)
    return np.asarray(np.sqrt(level).reshape(r.shape))


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
