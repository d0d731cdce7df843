"""One factor on the standard deviations of posteriors, by held-out truths.

The width of the posterior of several trajectories: `product_calibration.Sets.widening`.

The temperature has the highest mean log density at the truths. The coverage factor makes regions hold as many truths as
they should.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import ndtri
from jax.typing import ArrayLike

from bayessim_mjx.distributions import Distribution, box, charts
from bayessim_mjx.inference.numbers import DOUBT, FEW
from bayessim_mjx.linalg import inverse_lower, lower_factor, product

TEMPERATURES = np.geomspace(1.0, 4.0, 15).astype(np.float32)  # factors tried; source: rule of thumb, not counted
Mixtures = tuple[Array, Array, Array]  # log weights [n, K], means [n, K, d], Cholesky factors of covariances

# factors on sharpness, tried; 1.1 to 1.2 were found to be enough on BayesSimIG's data. source: docs/inference.md
FACTORS = np.geomspace(0.75, 1 / 0.75, 15).astype(np.float32)
LEVELS = (0.5, 0.8, 0.95)  # mass of the regions of highest density in which truths are counted
REGIONS = np.asarray(LEVELS, np.float32)


def tempered(posterior: Distribution, factor: float | Array) -> Distribution:
    """Multiply standard deviations of every component by `factor`, but never beyond the prior's; for jax.vmap too."""
    q = posterior
    return Distribution.from_unit(q.space, q.logits, *_spread(q, factor), q.prior_weight, q.chart)


def _spread(q: Distribution, factor: float | Array) -> tuple[Array, Array]:
    """Means and scales of the components of (q / p)^(1 / factor^2) p, p as Gaussian as the chart has it."""
    if q.chart == "plain":  # p is flat
        return q.means, q.scales * factor
    centre, sd = charts.NEUTRAL[q.chart]
    power = 1 / jnp.square(jnp.asarray(factor, jnp.float32))
    inverse = inverse_lower(q.scales)
    prior = jnp.broadcast_to(jnp.eye(q.scales.shape[-1]), q.scales.shape) * jnp.sqrt(1 - power) / np.float32(sd)
    # precision P power + (1 - power) / sd^2 = C C^T, P = S^-T S^-1
    c = lower_factor(jnp.concatenate([jnp.swapaxes(inverse, -1, -2) * jnp.sqrt(power), prior], axis=-1))
    scales = lower_factor(jnp.swapaxes(inverse_lower(c), -1, -2))
    shift = product(inverse, (q.means - np.float32(centre))[..., None])
    shift = product(jnp.swapaxes(inverse, -1, -2), shift) * power
    means = product(scales, product(jnp.swapaxes(scales, -1, -2), shift))[..., 0] + np.float32(centre)
    return means, scales


def temperature(posteriors: Distribution, thetas: Array, weights: ArrayLike | None = None) -> float:
    """Find the factor >= 1 on standard deviations with the highest mean log density of batched posteriors at thetas.

    thetas [n, d]; weights [n], 0 for pairs to leave out.
    """
    thetas = jnp.asarray(thetas)
    weights = jnp.ones(thetas.shape[0]) if weights is None else jnp.asarray(weights, jnp.float32)
    return float(TEMPERATURES[int(np.argmax(np.asarray(_scores(posteriors, thetas, weights))))])


def gain_at(q: Distribution, theta: Array, factor: Array) -> Array:
    """log_gain of `tempered(q, factor)` at theta [d], -> []; its mass in the box by FEW points: for many weighings."""
    means, scales = _spread(q, factor)
    masses = box.log_masses(means, scales, FEW) if q.chart == "plain" else jnp.zeros_like(q.logits)
    inside = jax.nn.logsumexp(jax.nn.log_softmax(q.logits) + masses)
    return replace(q, means=means, scales=scales, log_inside=inside).log_gain(theta)


@jax.jit
def _scores(posteriors: Distribution, thetas: Array, weights: Array) -> Array:
    def at(factor: Array) -> Array:
        gain = jax.vmap(gain_at, in_axes=(0, 0, None))(posteriors, thetas, factor)
        return jnp.mean(jnp.where(jnp.isfinite(gain), gain, 0.0) * weights)

    return jax.lax.map(at, jnp.asarray(TEMPERATURES))


@jax.jit
def widened(posteriors: Distribution, factor: float | Array) -> Distribution:
    """Batched posteriors, `tempered`."""
    return jax.vmap(tempered, in_axes=(0, None))(posteriors, factor)


def coverage_levels(
    key: Array, mixtures: Mixtures, z: Array, keep: Array, chart: str, inside: Array | None = None
) -> Array:
    """Mass of a posterior that is denser than the truth z [n, d], by its rank among draws, [n].

    Ranks are spread at random between their neighbours and ties broken at random, so that of exact posteriors a share
    of exactly p has levels up to p. The mixtures are those in the chart, the parameters not to keep [d] independent of
    the others and left out; draws outside the box of the plain chart are none of the posterior's. With the log
    masses of the Gaussians inside it [n, K], as far as they are known, draws are forced into the box instead and count
    by their weights: where many Gaussians are wide none might be left otherwise.
    """

    n, d = z.shape
    # one call for all random numbers: each is a program of its own size, and several were a fifth of the compilation
    uniforms = jax.random.uniform(key, (n, FEW * (1 + d) + 1), minval=1e-7)

    def one(inputs: tuple[Array, Array, Array, Array, Array, Array]) -> Array:
        uniform, logits, means, scales, z, mass = inputs
        chance, rank = uniform[:-1].reshape(FEW, 1 + d), uniform[-1]
        part, worth = box.choose(chance[:, 0], logits + mass), jnp.ones(FEW)
        if inside is None:
            noise = ndtri(chance[:, 1:])
            draws = means[part] + jnp.sum(scales[part] * noise[:, None, :], axis=-1)
        else:
            draws, logs = box.forced(means, scales, part, chance[:, 1:])
            logs = logs - mass[part]
            worth = jnp.exp(logs - jnp.max(logs))
        points = jnp.concatenate([z[None], draws])
        gap = points[:, None, None, :] - means[None, :, None, :]
        away = jnp.where(
            keep[None, None, :], jnp.sum(inverse_lower(scales)[None] * gap, axis=-1), 0.0
        )  # [1 + FEW, K, d]
        size = jnp.sum(jnp.log(jnp.diagonal(scales, axis1=-2, axis2=-1)), axis=-1)
        density = jax.nn.logsumexp((logits - size)[None] - 0.5 * jnp.sum(away * away, axis=-1), axis=-1)
        density = density + charts.log_slope(jnp.where(keep[None, :], points, charts.NEUTRAL[chart][0]), chart)
        # a Gaussian as flat as a prior is hardly ever inside: with all coordinates no draw might be left
        here = jnp.all((draws >= 0) & (draws <= 1) | ~keep[None, :], axis=-1) | (chart != "plain")
        which = jnp.stack([density[1:] > density[0], density[1:] == density[0], jnp.ones(FEW, bool)])
        denser, equal, whole = jnp.sum(jnp.where(here[None] & which, worth[None], 0.0), axis=-1)
        own = 1.0 if inside is None else whole / FEW  # the truth is one more draw
        return (denser + (equal + own) * rank) / (whole + own)

    masses = jnp.zeros_like(mixtures[0]) if inside is None else inside
    return jax.lax.map(one, (uniforms, *mixtures, z, masses), batch_size=FEW)


def coverage_factor(
    key: Array,
    at: Callable[[Array], Mixtures],
    z: Array,
    mask: Array,
    keep: Array,
    chart: str,
    inside: Array | None = None,
) -> Array:
    """Find the factor of FACTORS on sharpness at which REGIONS hold truths z [n, d] (mask [n] 1) as they should.

    at(factor) gives the mixtures; keep [d] and inside as in `coverage_levels`. A region of p holds p of n truths to
    within sqrt(p (1 - p) / n), and the log of the factor is held to be within DOUBT of 0 beforehand.
    """
    count = jnp.maximum(jnp.sum(mask), 1.0)

    def against(factor: Array) -> Array:
        # the same draws for every factor
        level = coverage_levels(key, at(factor), z, keep, chart, inside)
        held = mask @ (level[:, None] <= REGIONS[None, :]).astype(jnp.float32) / count
        off = jnp.where(jnp.sum(mask) > 0, count * (held - REGIONS) ** 2 / (REGIONS * (1 - REGIONS)), 0.0)
        return jnp.mean(off) + (jnp.log(factor) / DOUBT) ** 2

    # as it is first: what is right within its error is left alone, which also saves the time
    factors = jnp.asarray(np.concatenate([np.ones(1, np.float32), FACTORS]))

    def better(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        i, least, best = carry
        value = against(factors[i])
        return i + 1, jnp.fmin(value, least), jnp.where(value < least, factors[i], best)

    start = jnp.asarray(0, jnp.int32), jnp.asarray(jnp.inf, jnp.float32), factors[0]
    return jax.lax.while_loop(lambda c: (c[0] < len(factors)) & ((c[0] != 1) | (c[1] >= 1.0)), better, start)[2]
