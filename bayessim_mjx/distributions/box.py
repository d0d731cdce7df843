"""Gaussians inside the unit cube: mass, quadrature and draws by the separation of variables of Genz (1992).

Coordinate by coordinate a standard normal is drawn from the interval that keeps the point inside; the product of the
interval masses is the importance weight. Exact for one dimension and for diagonal covariances.
"""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import log_ndtr, ndtr, ndtri
from scipy import special

from bayessim_mjx.linalg import product, solve_lower

MASS_POINTS = 512  # quasi-Monte-Carlo points behind every log_inside


@lru_cache(maxsize=64)
def lattice(n: int, d: int) -> np.ndarray:
    """Richtmyer points frac(i sqrt(prime_j) + shift) in the open unit cube, [n, d] float32, always the same."""
    primes: list[int] = []
    candidate = 2
    while len(primes) < d:
        if all(candidate % p for p in primes):
            primes.append(candidate)
        candidate += 1
    steps = np.arange(1, n + 1)[:, None] * np.sqrt(np.asarray(primes, np.float64))[None, :]
    points = (steps + np.random.default_rng(0).random(d)[None, :]) % 1.0
    return np.clip(points, 1e-6, 1 - 1e-6).astype(np.float32)


def _lower_side(a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Mirror intervals that lie on the positive side: there float32 cannot tell Phi from 1."""
    flip = a + b > 0
    return jnp.where(flip, -b, a), jnp.where(flip, -a, b), flip


def log_interval(a: Array, b: Array) -> Array:
    """log(Phi(b) - Phi(a)) for a < b, stable in both tails."""
    a, b, _ = _lower_side(a, b)
    lower, upper = log_ndtr(jnp.stack([a, b]))  # both ends in one: it is long to compile
    return upper + jnp.log(jnp.maximum(-jnp.expm1(lower - upper), 1e-30))


def truncated_normal(a: Array, b: Array, w: Array) -> Array:
    """Restrict a standard normal to [a, b], from uniforms w by inversion; by Marsaglia's tail formula beyond 5 sd."""
    low, high, flip = _lower_side(a, b)
    pa, pb = ndtr(jnp.stack([low, high]))
    centre = ndtri(jnp.clip(pa + w * (pb - pa), 1e-37, 1.0))
    edge = jnp.minimum(high, -5.0)
    # y^2 = b^2 - 2 log(1 - w (1 - exp((b^2 - a^2) / 2)))
    drop = -jnp.expm1(jnp.minimum(edge * edge - low * low, 0.0) / 2)
    tail = -jnp.sqrt(edge * edge - 2 * jnp.log(jnp.maximum(1 - w * drop, 1e-30)))
    y = jnp.clip(jnp.where(high < -5.0, tail, centre), low, high)
    return jnp.where(flip, -y, y)


def separate(mean: Array, scale: Array, w: Array) -> tuple[Array, Array]:
    """Points of N(mean, scale scale^T) forced into the cube. mean [d], scale [d, d] lower, w [n, d] uniforms.

    Returns points [n, d] and log weights [n]; the mean of exp(log weights) is the Gaussian's mass in the cube.
    """
    return forced(mean[None], scale[None], jnp.zeros(len(w), jnp.int32), w)


def forced(means: Array, scales: Array, k: Array, w: Array) -> tuple[Array, Array]:
    """`separate`, each point of a Gaussian of its own: means [K, d], scales [K, d, d], k [n] which, w [n, d]."""
    n, d = w.shape
    if d == 0:
        return w, jnp.zeros(n)
    means, scales = (means, scales) if len(means) > 1 else (means[0], scales[0])
    own = k if means.ndim > 1 else ()

    def coordinate(carry: tuple[Array, Array, Array], i: Array) -> tuple[tuple[Array, Array, Array], None]:
        z, u, log_weight = carry
        row = scales[..., i, :][own]  # the columns of z from i on are still zero
        centre = means[..., i][own] + (jnp.sum(z * row, axis=1) if row.ndim > 1 else product(z, row))
        width = row[..., i]
        a, b = -centre / width, (1 - centre) / width
        new = truncated_normal(a, b, w[:, i])
        u = u.at[:, i].set(centre + width * new)
        return (z.at[:, i].set(new), u, log_weight + log_interval(a, b)), None

    start = jnp.zeros((n, d), jnp.float32), jnp.zeros((n, d), jnp.float32), jnp.zeros((n,), jnp.float32)
    (_, u, log_weight), _ = jax.lax.scan(coordinate, start, jnp.arange(d))
    return jnp.clip(u, 0.0, 1.0), log_weight


def log_bounds(scales: Array) -> Array:
    """Bound the weight of each point of `forced`: scales [K, d, d] -> [K]. Every interval is widest in the middle."""
    half = 0.5 / jnp.diagonal(scales, axis1=-2, axis2=-1)
    return jnp.sum(log_interval(-half, half), axis=-1)


def within(mean: np.ndarray, scale: np.ndarray, points: int = 4096) -> tuple[np.ndarray, np.ndarray]:
    """`separate` on a lattice, for many d in turn: points [n, d] in the cube and weights [n] that sum to 1.

    In float64 on the host, where no program is compiled for every d.
    """
    z, logs = separated(mean[None], scale[None], points)
    weights = np.exp(logs[0] - logs.max())
    return np.clip(mean + z[0] @ scale.T, 0.0, 1.0), weights / weights.sum()


def separated(means: np.ndarray, scales: np.ndarray, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Take standard normals [K, n, d] that `separate` keeps in the cube, on a lattice, and their log weights [K, n].

    In float64 on the host. Means [K, d], scales [K, d, d]; also far outside.
    """
    (k, d), w = means.shape, lattice(points, means.shape[1]).astype(np.float64)
    z, logs = np.zeros((k, points, d)), np.zeros((k, points))
    for i in range(d):
        here, width = means[:, i, None] + np.einsum("kni,ki->kn", z[..., :i], scales[:, i, :i]), scales[:, i, i]
        low, high = -here / width[:, None], (1 - here) / width[:, None]
        flip = low + high > 0  # to the side where logarithms tell Phi from 1
        low, high = (special.log_ndtr(np.where(flip, -x, y)) for x, y in ((high, low), (low, high)))
        logs += high + np.log(np.maximum(-np.expm1(low - high), 1e-300))
        new = special.ndtri_exp(np.logaddexp(low + np.log1p(-w[:, i]), high + np.log(w[:, i])))
        z[..., i] = np.where(flip, -new, new)
    return z, logs


def log_masses(means: Array, scales: Array, points: int = MASS_POINTS) -> Array:
    """Log mass of each Gaussian inside the cube: means [K, d], scales [K, d, d] -> [K]."""
    w = jnp.asarray(lattice(points, means.shape[-1]))
    weights = jax.vmap(lambda m, s: separate(m, s, w)[1])(means, scales)
    return jnp.minimum(jax.nn.logsumexp(weights, axis=1) - np.log(points).astype(np.float32), 0.0)


def log_density(u: Array, means: Array, scales: Array) -> Array:
    """Untruncated log N(u_n; mean_k, scale_k scale_k^T): u [n, d], means [K, d], scales [K, d, d] -> [n, K]."""
    d = means.shape[-1]
    if d == 0:
        return jnp.zeros((u.shape[0], means.shape[0]))
    deviation = jnp.swapaxes(u[None, :, :] - means[:, None, :], 1, 2)  # [K, d, n]
    z = solve_lower(scales, deviation)
    log_det = jnp.sum(jnp.log(jnp.diagonal(scales, axis1=-2, axis2=-1)), axis=-1)
    constant = np.float32(0.5 * d * np.log(2 * np.pi))
    return (-0.5 * jnp.sum(z * z, axis=1) - log_det[:, None] - constant).T


def propose(key: Array, logits: Array, means: Array, scales: Array, n: int) -> Array:
    """n draws of the mixture, not truncated -> [n, d]."""
    # one call for all random numbers: several of them, batched, take seconds to compile
    w = jax.random.uniform(key, (n, 1 + means.shape[-1]), minval=1e-7)
    k = choose(w[:, 0], logits)
    return means[k] + jnp.einsum("nij,nj->ni", scales[k], ndtri(w[:, 1:]), precision=jax.lax.Precision.HIGHEST)


def choose(w: Array, logits: Array) -> Array:
    """Draw indices with the probabilities softmax(logits [K]) from uniforms w [n] in [0, 1), by inversion -> [n]."""
    edges = jnp.cumsum(jax.nn.softmax(logits))
    return jnp.sum(w[:, None] * edges[-1] >= edges[None, :-1], axis=1)


def candidates(key: Array, logits: Array, means: Array, scales: Array, n: int) -> tuple[Array, Array]:
    """n points [n, d] in the cube and which of them [n] are draws of the mixture truncated to it.

    Exact rejection. Points are forced into the cube coordinate by coordinate, so one that a Gaussian far wider than the
    cube has is as good as any, however many coordinates are so; what a point weighs less than it could is its chance to
    be no draw.
    """
    # one call for all random numbers: several of them, batched, take seconds to compile
    w = jax.random.uniform(key, (n, 2 + means.shape[-1]), minval=1e-7)
    bounds = log_bounds(scales)
    k = choose(w[:, 0], jax.nn.log_softmax(logits) + bounds)
    points, weights = forced(means, scales, k, w[:, 2:])
    return points, jnp.log(w[:, 1]) < weights - bounds[k]


def draw(
    key: Array, logits: Array, means: Array, scales: Array, done: Array, u: Array, tries: int, spare: int
) -> Array:
    """Fill the rows of u [n, d] that are not `done` [n] with draws of the mixture truncated to the cube.

    Exact rejection for `tries` rounds; rows still missing (all Gaussians far outside) are picked from `spare` points of
    `separate` by their weights, so that every row is inside the cube whatever the mixture.
    """
    key_loop, key_spare = jax.random.split(key)
    n = u.shape[0]

    def attempt(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        i, done, u = carry
        new, drawn = candidates(jax.random.fold_in(key_loop, i), logits, means, scales, n)
        return i + 1, done | drawn, jnp.where((drawn & ~done)[:, None], new, u)

    _, done, u = jax.lax.while_loop(
        lambda c: (c[0] < tries) & ~jnp.all(c[1]), attempt, (jnp.asarray(0, jnp.int32), done, u)
    )

    def rescue(u: Array) -> Array:
        picked = jax.vmap(lambda k: _pick(k, logits, means, scales, spare))(jax.random.split(key_spare, n))
        return jnp.where(done[:, None], u, picked)

    return jax.lax.cond(jnp.all(done), lambda u: u, rescue, u)


def _pick(key: Array, logits: Array, means: Array, scales: Array, spare: int) -> Array:
    """One point of the truncated mixture by sampling-importance-resampling among `spare` separated points -> [d]."""
    w = jax.random.uniform(key, (1 + spare, 1 + means.shape[-1]), minval=1e-6, maxval=1 - 1e-6)
    k = choose(w[1:, 0], logits)
    points, weights = jax.vmap(separate)(means[k], scales[k], w[1:, None, 1:])
    return points[choose(w[:1, 0], weights[:, 0])[0], 0]
