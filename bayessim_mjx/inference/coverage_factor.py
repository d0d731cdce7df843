"""How deep held-out truths lie in their posteriors, and how much sharper or wider these would have to be."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import ndtri

from bayessim_mjx.distributions import box, charts
from bayessim_mjx.inference.calibration import LEVELS
from bayessim_mjx.linalg import inverse_lower

Mixtures = tuple[Array, Array, Array]  # log weights [n, K], means [n, K, d], Cholesky factors of covariances

DRAWS = 64  # of each posterior
MOST = 512  # rows looked at
TOGETHER = 64  # of them at once
FACTORS = np.geomspace(0.75, 1 / 0.75, 15).astype(np.float32)
REGIONS = np.asarray(LEVELS, np.float32)  # that should hold as many truths as they say
DOUBT = 0.15  # standard deviation of the factor's log before anything is seen: a few rows are off by chance


def levels(key: Array, mixtures: Mixtures, z: Array, keep: Array, chart: str, inside: Array | None = None) -> Array:
    """Mass of a posterior that is denser than the truth z [n, d], by its rank among draws, [n].

    Ranks are spread at random between their neighbours and ties broken at random, so that of exact posteriors a share
    of exactly p has levels up to p. The mixtures are those in the chart, the parameters not to keep [d] independent of
    the others and left out; draws outside the box of the plain chart are none of the posterior's. With the log
    masses of the Gaussians inside it [n, K], as far as they are known, draws are forced into the box instead and count
    by their weights: where many Gaussians are wide none might be left otherwise.
    """

    n, d = z.shape
    # one call for all random numbers: each is a program of its own size, and several were a fifth of the compilation
    uniforms = jax.random.uniform(key, (n, DRAWS * (1 + d) + 1), minval=1e-7)

    def one(inputs: tuple[Array, Array, Array, Array, Array, Array]) -> Array:
        uniform, logits, means, scales, z, mass = inputs
        chance, rank = uniform[:-1].reshape(DRAWS, 1 + d), uniform[-1]
        part, worth = box.choose(chance[:, 0], logits + mass), jnp.ones(DRAWS)
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
        )  # [1 + DRAWS, K, d]
        size = jnp.sum(jnp.log(jnp.diagonal(scales, axis1=-2, axis2=-1)), axis=-1)
        density = jax.nn.logsumexp((logits - size)[None] - 0.5 * jnp.sum(away * away, axis=-1), axis=-1)
        density = density + charts.log_slope(jnp.where(keep[None, :], points, charts.NEUTRAL[chart][0]), chart)
        # a Gaussian as flat as a prior is hardly ever inside: with all coordinates no draw might be left
        here = jnp.all((draws >= 0) & (draws <= 1) | ~keep[None, :], axis=-1) | (chart != "plain")
        which = jnp.stack([density[1:] > density[0], density[1:] == density[0], jnp.ones(DRAWS, bool)])
        denser, equal, whole = jnp.sum(jnp.where(here[None] & which, worth[None], 0.0), axis=-1)
        own = 1.0 if inside is None else whole / DRAWS  # the truth is one more draw
        return (denser + (equal + own) * rank) / (whole + own)

    masses = jnp.zeros_like(mixtures[0]) if inside is None else inside
    return jax.lax.map(one, (uniforms, *mixtures, z, masses), batch_size=TOGETHER)


def factor(
    key: Array,
    at: Callable[[Array], Mixtures],
    z: Array,
    mask: Array,
    keep: Array,
    chart: str,
    inside: Array | None = None,
) -> Array:
    """The factor on sharpness, of FACTORS, at which REGIONS hold truths z [n, d] (with mask [n] 1) as they should.

    at(factor) gives the mixtures; keep [d] and inside as in `levels`. A region of p holds p of n truths to within
    sqrt(p (1 - p) / n), and the log of the factor is held to be within DOUBT of 0 beforehand.
    """
    count = jnp.maximum(jnp.sum(mask), 1.0)

    def against(factor: Array) -> Array:
        # the same draws for every factor
        level = levels(key, at(factor), z, keep, chart, inside)
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
