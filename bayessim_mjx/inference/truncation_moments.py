"""Gaussians whose part inside the unit cube has the moments of the network's Gaussians.

A mixture that is trained by its own density, which knows no cube, ends with the moments of posteriors that the ranges
cut off; cut off once more it would be too narrow and lean to the middle, and products of several would lean more. So
what is used are the Gaussians before the cut: in one dimension the N(m', s'^2) whose part inside has mean m and
standard deviation s, looked up. In several, expectation propagation (Minka 2001) turned around: the cut of coordinate i
is a Gaussian site of precision 1/s_i^2 - 1/s_i'^2, and all sites are taken out of the network's Gaussian.
"""

from __future__ import annotations

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.special import log_ndtr
from scipy.stats import norm

from bayessim_mjx.distributions import box
from bayessim_mjx.inference.mixture_fit import FLAT
from bayessim_mjx.inference.numbers import EPS, FEW, ROUNDED
from bayessim_mjx.linalg import cholesky, inverse_lower, lower_factor, product

# sd from a mean to an end of its range: nearer no part of a Gaussian has its mean, beyond the other the cut is rounding
NEAREST, FARTHEST = 1.0, float(norm.isf(EPS))
WIDEST = FLAT * 12**0.5  # times its standard deviation that a Gaussian may become: a uniform one's as flat
STEPS = np.finfo(np.float32).nmant + 1  # of Newton and of bisection, one for each bit


@lru_cache(maxsize=1)
def _table() -> tuple[np.ndarray, np.ndarray]:
    """Means and log standard deviations [G, G] of the Gaussians that have mean 0 and sd 1 on [-a, b], by bisection."""
    ends = np.linspace(NEAREST, FARTHEST, FEW)
    a, b = np.meshgrid(ends, ends, indexing="ij")

    def centred(mean: np.ndarray, sd: np.ndarray) -> np.ndarray:
        """Find the mean of the Gaussian whose part on [-a, b] has mean 0, by Newton's steps."""
        for _ in range(STEPS):
            off, spread = _cut(mean, sd, a, b)
            mean = mean - np.clip(off * (sd / spread) ** 2, -sd, sd)
        return mean

    mean, low, high = np.zeros_like(a), np.zeros_like(a), np.full_like(a, np.log(WIDEST))
    for _ in range(STEPS):
        middle = (low + high) / 2
        mean = centred(mean, np.exp(middle))
        narrow = _cut(mean, np.exp(middle), a, b)[1] < 1
        low, high = np.where(narrow, middle, low), np.where(narrow, high, middle)
    return centred(mean, np.exp(high)).astype(np.float32), high.astype(np.float32)


def _cut(mean: np.ndarray, sd: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the part of N(mean, sd^2) on [-a, b]."""
    low, high = (-a - mean) / sd, (b - mean) / sd
    flip = low + high > 0  # to the side where logarithms tell Phi from 1
    low, high = np.where(flip, -high, low), np.where(flip, -low, high)
    logs = log_ndtr(low), log_ndtr(high)
    mass = logs[1] + np.log(-np.expm1(np.minimum(logs[0] - logs[1], -1e-12)))
    here, there = (np.exp(-0.5 * x * x - 0.5 * np.log(2 * np.pi) - mass) for x in (low, high))
    shift = here - there
    variance = 1 + low * here - high * there - shift**2
    return mean + sd * np.where(flip, -shift, shift), sd * np.sqrt(np.maximum(variance, 1e-12))


def _looked_up(table: Array, a: Array, b: Array) -> Array:
    """Bilinear between the entries of a table [G, G]."""
    step = (FARTHEST - NEAREST) / (FEW - 1)
    x, y = ((jnp.clip(v, NEAREST, FARTHEST) - NEAREST) / step for v in (a, b))
    i, j = (jnp.clip(v.astype(jnp.int32), 0, FEW - 2) for v in (x, y))
    u, v = x - i.astype(jnp.float32), y - j.astype(jnp.float32)
    near, far = ((1 - v) * table[k, j] + v * table[k, j + 1] for k in (i, i + 1))
    return (1 - u) * near + u * far


def shapes(means: Array, scales: Array) -> tuple[Array, Array]:
    """Means [..., d] and lower factors [..., d, d] before the cut of Gaussians with these moments inside the cube.

    Sites of coordinates that go together describe one cut: each takes its share of it.
    """
    sd = jnp.sqrt(jnp.sum(scales**2, axis=-1))
    a, b = means / sd, (1 - means) / sd
    at, log_sd = (jnp.where(jnp.minimum(a, b) < 0, 0.0, _looked_up(jnp.asarray(t), a, b)) for t in _table())
    unit = scales / sd[..., None]
    together = product(unit, jnp.swapaxes(unit, -1, -2))  # correlations
    lost = -jnp.expm1(-2 * log_sd)  # of each coordinate's precision
    share = 1 / jnp.maximum(jnp.sum(together**2 * lost[..., None, :], axis=-1) / jnp.maximum(lost, 1e-9), 1.0)
    root = jnp.sqrt(lost * share)
    # no direction loses more of its precision than a coordinate alone may: eigenvalues are at most the sums of rows
    rows = jnp.max(root * jnp.sum(jnp.abs(together) * root[..., None, :], axis=-1), axis=-1, keepdims=True)
    share = share * jnp.minimum(1.0, (1 - WIDEST**-2) / jnp.maximum(rows, 1e-9))
    site = share * lost / sd**2
    eye = jnp.broadcast_to(jnp.eye(means.shape[-1]), scales.shape)
    left = eye - product(jnp.swapaxes(scales, -1, -2) * site[..., None, :], scales)
    wide = lower_factor(product(scales, jnp.swapaxes(inverse_lower(cholesky(left)), -1, -2)))
    pull = share * at * jnp.exp(-2 * log_sd) / sd
    return means + product(wide, product(jnp.swapaxes(wide, -1, -2), pull[..., None]))[..., 0], wide


def weighed(logits: Array, means: Array, scales: Array) -> tuple[Array, Array, Array, Array]:
    """Weigh Gaussians before the cut: their mixture [n, K, ...], and the log mass [n, K] of each inside the cube.

    Each keeps its mass there, relative to the others. Gaussians that are all but outside stay: their moments are not
    those of anything inside.
    """
    wide = shapes(means, scales)
    both = (jnp.concatenate(pair, axis=1) for pair in zip((means, scales), wide, strict=True))  # compiled once
    masses = jax.lax.map(lambda row: box.log_masses(row[0], row[1], FEW), tuple(both), batch_size=FEW)
    before, after = jnp.split(masses, 2, axis=1)
    use = (before > ROUNDED) & (after > ROUNDED) & jnp.all(jnp.isfinite(wide[1]), axis=(-1, -2))
    inside = jnp.where(use, after, before)
    return (
        jax.nn.log_softmax(logits) + before - inside,
        jnp.where(use[..., None], wide[0], means),
        jnp.where(use[..., None, None], wide[1], scales),
        inside,
    )
