"""Parameters that the trajectories identify; the others keep their prior.

A network's posterior of a parameter that the data do not constrain is close to flat, but not flat: the product over
many trajectories would turn this into a narrow, meaningless peak. So a parameter counts as identified only where its
marginal posterior beats the prior on held-out simulations.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import logsumexp

from bayessim_mjx.distributions import Distribution, box, charts
from bayessim_mjx.inference.numbers import DEFENSIVE, SURE
from bayessim_mjx.linalg import lower_factor, product


def marginal_gain(logits: Array, means: Array, scales: Array, u: Array) -> Array:
    """log marginal density, truncated to the cube, of each parameter at unit coordinates u [n, d] -> [n, d]; prior = 0.

    One mixture per row: logits [n, K], means [n, K, d], Cholesky factors [n, K, d, d].
    """
    sd = jnp.sqrt(jnp.sum(scales**2, axis=-1))  # [n, K, d]
    z = (u[:, None, :] - means) / sd
    density = -0.5 * z**2 - jnp.log(sd) - np.float32(0.5 * np.log(2 * np.pi))
    inside = box.log_interval(-means / sd, (1 - means) / sd)
    weight = jax.nn.log_softmax(logits)[:, :, None]
    return logsumexp(weight + density, axis=1) - logsumexp(weight + inside, axis=1)


def identified(gain: Array, mask: Array) -> tuple[Array, Array]:
    """(mean gain [d], identified [d]) from gains [n, d] of the rows with mask [n] = 1."""
    n = jnp.maximum(jnp.sum(mask), 1.0)
    # a share of the prior bounds what a single misjudged row can cost
    gain = jnp.logaddexp(np.float32(np.log(DEFENSIVE)), np.float32(np.log1p(-DEFENSIVE)) + gain)
    gain = jnp.where(mask[:, None] > 0, gain, 0.0)
    mean = jnp.sum(gain, axis=0) / n
    var = jnp.sum(jnp.where(mask[:, None] > 0, (gain - mean[None, :]) ** 2, 0.0), axis=0) / n
    return mean, mean > SURE * jnp.sqrt(var / n)


@jax.jit
def restore_prior(posterior: Distribution, keep: Array) -> Distribution:
    """Keep the posterior over the parameters to keep [d] and the prior over the others, independent of them."""
    q, keep = posterior, jnp.asarray(keep)

    def restored() -> Distribution:
        means, scales = q.means, q.scales
        if q.chart == "plain":  # the others are cut off at their ranges, which moves what is correlated with them
            means, scales = jax.vmap(_beside_cut, in_axes=(0, 0, None))(means, scales, keep)
        means, scales = beside_prior(means, scales, keep, q.chart)
        logits = jax.nn.log_softmax(q.logits)
        if q.chart == "plain":  # each component keeps its mass inside the cube
            logits = logits + box.log_masses(q.means, q.scales) - box.log_masses(means, scales)
        return Distribution.from_unit(q.space, logits, means, scales, q.prior_weight, q.chart)

    # mostly all are kept, and the masses behind the others are what conditioning takes longest for
    return jax.lax.cond(jnp.all(keep), lambda: q, restored)


def beside_prior(means: Array, scales: Array, keep: Array, chart: str) -> tuple[Array, Array]:
    """Gaussians [..., d] in a chart as they are in the parameters to keep [d], and as the prior in the others."""
    centre, sd = charts.NEUTRAL[chart]
    # a factor of (S S^T on the kept rows) + sd^2 on the others; forming S S^T would lose thin components
    own = jnp.broadcast_to(keep, means.shape)
    kept = jnp.where(own[..., None], scales, 0.0)
    flat = jnp.broadcast_to(jnp.diag(jnp.where(keep, 0.0, sd)), kept.shape)
    return jnp.where(own, means, centre), lower_factor(jnp.concatenate([kept, flat], axis=-1))


def _beside_cut(mean: Array, scale: Array, keep: Array) -> tuple[Array, Array]:
    """Cut a Gaussian in the parameters not to keep [d] at the cube: mean and rows of a factor.

    Its moments change by what they change under the cut of the others where its own is made already: a Gaussian's
    own cut is not counted twice. By the separation of variables of Genz (1992), the kept coordinates first.
    """
    d = mean.shape[0]
    order = jnp.argsort(~keep)
    lower, first = lower_factor(scale[order]), keep[order]
    w = jnp.asarray(box.lattice(box.MASS_POINTS, d))

    def coordinate(carry: tuple[Array, Array], i: Array) -> tuple[tuple[Array, Array], None]:
        z, logs = carry
        here = mean[order][i] + product(z, lower[i])  # the columns from i on are still zero
        a, b = -here / lower[i, i], (1 - here) / lower[i, i]
        inside = box.log_interval(a, b)
        logs = logs + jnp.stack([inside, jnp.where(first[i], inside, 0.0)])
        return (z.at[:, i].set(box.truncated_normal(a, b, w[:, i])), logs), None

    start = jnp.zeros(w.shape), jnp.zeros((2, len(w)))
    (z, logs), _ = jax.lax.scan(coordinate, start, jnp.arange(d))
    z, weights = jnp.where(first[None, :], z, 0.0), jax.nn.softmax(logs, axis=1)  # under both cuts, under its own
    centres = product(weights, z)
    away = z[None] - centres[:, None, :]
    after, before = product(jnp.swapaxes(away * weights[:, :, None], 1, 2), away)
    change = after - before  # of the covariance, at most the identity
    square = product(change, change)
    root = jnp.eye(d) + change / 2 - square / 8 + product(square, change) / 16  # of identity + change, to fourth order
    back = jnp.argsort(order)
    return mean + product(lower, centres[0] - centres[1])[back], product(lower, root)[back]
