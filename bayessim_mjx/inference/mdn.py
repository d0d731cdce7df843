"""Mixture density network: standardised features -> mixture of Gaussians over z-scored coordinates of the parameters.

y is the chart's coordinate with mean 0 and variance 1 under the prior. The network (a density, see densities/, and one
layer of heads) gives centres mu and lower triangular A. A component is N(y; mu, (A^T A)^-1), so training needs no solve
and its log-determinant is exact; in the probit chart it is N(y; 0, I) exp(-|A (y - mu)|^2 / 2) / Z: precision
I + A^T A, never broader than the prior, for products and sequential rounds.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.distributions import Distribution, box, charts
from bayessim_mjx.inference import densities
from bayessim_mjx.inference.densities import Drop, Params
from bayessim_mjx.inference.numbers import AT_ONCE, DEFENSIVE, FEW
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.linalg import inverse_lower, lower_factor, product

Heads = tuple[Array, Array, Array]  # log weights [n, K], centres [n, K, d], factors A [n, K, d, d]

# log weight of components that a member does not use: float32 has no square of less
UNUSED = float(np.log(np.finfo(np.float32).tiny)) / 2
LEAST_INSIDE = float(np.log(DEFENSIVE))  # log mass inside the box that training uses at least
# of the parameters, those that are not trained by gradients; the last three belong to the parts of the mixture
FIXED = ("used", "sharpness", "share", "member")
LOG_2PI = float(np.log(2 * np.pi))


def to_y(u: Array, chart: str = "plain") -> Array:
    """Map unit coordinates to coordinates of the network."""
    centre, sd = charts.SCORE[chart]
    return (charts.to_chart(u, chart) - np.float32(centre)) * np.float32(1 / sd)


def log_volume(y: Array, chart: str) -> Array:
    """log |det dy/du| at y [..., d] -> [...]: what a log density of y needs to be one of u."""
    centre, sd = charts.SCORE[chart]
    return charts.log_slope(y * np.float32(sd) + np.float32(centre), chart) - np.float32(y.shape[-1] * np.log(sd))


def bounded(settings: InferenceSettings) -> bool:
    """Whether components have the precision I + A^T A."""
    return settings.coordinates == "probit"


def fixed(settings: InferenceSettings) -> tuple[str, ...]:
    """Names of the parameters that are not trained by gradients."""
    return (*densities.density_of(settings).fixed, *FIXED)


def head_size(d: int, settings: InferenceSettings) -> int:
    """Count the outputs of the network: logits, centres, log diagonals, strictly lower entries."""
    lower = d * (d - 1) // 2 if settings.fullCovariance else 0
    return settings.components * (1 + 2 * d + lower)


def counts(settings: InferenceSettings) -> np.ndarray:
    """Components that each member of the ensemble uses [E]: the last of several has one, the others all."""
    alone = (np.arange(settings.ensemble) == settings.ensemble - 1) & (settings.ensemble > 1)
    return np.where(alone, 1, settings.components).astype(np.int32)


def init(key: Array, settings: InferenceSettings, dim_x: int, d: int, count: Array | None = None) -> Params:
    """Network weights: hidden layers, a small last layer, a linear path from input to output, spread centre biases.

    Of the components `count` are used. One alone has nothing but the linear path at first: `linear_start` then makes it
    the linear-Gaussian posterior.
    """
    more: Params = {}
    if settings.embedding is not None:
        key, key_embedding = jax.random.split(key)
        more = {"embedding": settings.embedding.init(key_embedding, jnp.zeros((1, dim_x)))}
        dim_x = settings.embedding.size(dim_x)
    own, widths = densities.started(jax.random.fold_in(key, 1), settings, dim_x)
    more, sizes = {**more, **own}, (*widths, head_size(d, settings))
    gains = [1.0] * (len(sizes) - 2) + [0.1]
    k = settings.components
    # one call for all random numbers: each is a program of its own size, and they took half of the compilation
    shapes = list(pairwise(sizes))
    drawn = jax.random.normal(key, (sum(n * m for n, m in shapes) + k * d,))
    *weights, spread = jnp.split(drawn, np.cumsum([n * m for n, m in shapes]))
    layers = [
        {"w": w.reshape(n, m) * np.float32(gain / np.sqrt(n)), "b": jnp.zeros(m)}
        for w, (n, m), gain in zip(weights, shapes, gains, strict=True)
    ]
    count = jnp.asarray(k if count is None else count)
    several = (count > 1).astype(jnp.float32)
    biases = layers[-1]["b"].at[k : k + k * d].set(0.7 * several * spread)
    layers[-1] = {"w": layers[-1]["w"] * several, "b": biases}
    more["used"] = jnp.where(jnp.arange(k, dtype=jnp.int32) < count, np.float32(0), np.float32(UNUSED))
    # set by held-out rows: factor on all precisions' square roots, log weight in the ensemble, whose network it is
    share = jnp.asarray(-np.log(settings.ensemble), jnp.float32)
    more = {**more, "sharpness": jnp.ones(()), "share": share, "member": jnp.asarray(0, jnp.int32)}
    return {"layers": layers, "skip": jnp.zeros((dim_x, sizes[-1])), **more}


def embedded(params: Params, x: Array, settings: InferenceSettings) -> Array:
    """Standardised summaries [n, D] as the network takes them in: unchanged, or embedded (learned.py) [n, F]."""
    if settings.embedding is None:
        return x
    apply = partial(settings.embedding.apply, params["embedding"])
    return apply(x) if x.shape[0] <= AT_ONCE else jax.lax.map(apply, x, batch_size=AT_ONCE)


def hidden(params: Params, x: Array, settings: InferenceSettings, drop: Drop | None = None) -> Array:
    """Compute the last layer's inputs: the density's hidden units (some dropped in training), [n, F] -> [n, H]."""
    return densities.density_of(settings).hidden(params, x, drop)


def forward(params: Params, x: Array, d: int, settings: InferenceSettings, drop: Drop | None = None) -> Heads:
    """Standardised x [n, D] -> log weights [n, K], centres mu [n, K, d], factors A [n, K, d, d] in y coordinates."""
    n, k = x.shape[0], settings.components
    last, x = params["layers"][-1], embedded(params, x, settings)
    out = hidden(params, x, settings, drop) @ last["w"] + last["b"][None, :] + x @ params["skip"]
    logits, means, diagonal, lower = jnp.split(out, np.cumsum([k, k * d, k * d]), axis=1)
    # A_ii = exp(8 tanh(r / 8)): between exp(-8) and exp(8), slope 1 at r = 0
    diagonal = jnp.exp(8 * jnp.tanh(diagonal.reshape(n, k, d) / 8))
    factors = diagonal[..., None] * jnp.eye(d)[None, None]
    if settings.fullCovariance and d > 1:
        rows, columns = np.tril_indices(d, -1)
        factors = factors.at[:, :, rows, columns].set(lower.reshape(n, k, -1))
    return jax.nn.log_softmax(logits + params["used"][None, :]), means.reshape(n, k, d), factors * params["sharpness"]


def log_normaliser(means: Array, factors: Array, settings: InferenceSettings) -> Array:
    """log of the integral of a component's exp(-|A (y - mu)|^2 / 2), in the probit chart against N(y; 0, I)."""
    d = means.shape[-1]
    if bounded(settings):  # the overlap with N(0, I)
        gram = product(factors, jnp.swapaxes(factors, -1, -2)) + jnp.eye(d)[(None,) * (factors.ndim - 2)]
        return log_gaussian(product(factors, means[..., None])[..., 0], gram)
    log_det = jnp.sum(jnp.log(jnp.diagonal(factors, axis1=-2, axis2=-1)), axis=-1)
    return np.float32(0.5 * d * LOG_2PI) - log_det


def log_prob(params: Params, x: Array, y: Array, settings: InferenceSettings) -> Array:
    """Log density of y [n, d] given standardised x [n, D] -> [n]; cut off at the box in truncated coordinates only."""
    return density(forward(params, x, y.shape[-1], settings), y, settings)


def sharper(heads: Heads, factor: Array) -> Heads:
    """All factors A times one number."""
    return heads[0], heads[1], heads[2] * factor


def density(heads: Heads, y: Array, settings: InferenceSettings) -> Array:
    """`log_prob` from what `forward` gives."""
    weights, means, factors = heads
    z = jnp.sum(factors * (y[:, None, :] - means)[:, :, None, :], axis=-1)  # A (y - mu)
    component = weights - 0.5 * jnp.sum(z * z, axis=-1) - log_normaliser(means, factors, settings)
    value = jax.nn.logsumexp(component, axis=-1)
    if bounded(settings):
        value = value - 0.5 * jnp.sum(y * y, axis=-1) - np.float32(0.5 * y.shape[-1] * LOG_2PI)
    if settings.coordinates == "truncated":
        value = value - log_inside(heads)
    return value


def log_inside(heads: Heads) -> Array:
    """log mass of each row's mixture inside the cube, plain chart -> [n]; differentiable."""
    weights, means, factors = heads
    n, k, d = means.shape
    centre, sd = (np.float32(v) for v in charts.SCORE["plain"])
    flat = lambda v: v.reshape(n * k, *v.shape[2:])  # noqa: E731
    points = 1 if d == 1 else FEW
    mass = box.log_masses(flat(means * sd + centre), flat(inverse_lower(factors) * sd), points)
    # a floor: mixtures that are all but outside must not gain by how coarsely so little is estimated
    return jnp.maximum(jax.nn.logsumexp(weights + mass.reshape(n, k), axis=-1), LEAST_INSIDE)


def log_tilt(heads: Heads, proposal: Distribution, settings: InferenceSettings) -> Array:
    """log of the integral of q(theta | x) proposal(theta) / prior(theta), in closed form: one proposal per row -> [n].

    Non-atomic SNPE-C (Greenberg et al. 2019): pairs simulated from the proposal follow q proposal / (prior Z), with
    this Z. In the plain chart the box is not looked at: for proposals well inside it.
    """
    weights, means, factors = heads
    d, (centre, sd) = means.shape[-1], (np.float32(v) for v in charts.SCORE[settings.chart])
    centres, scales = (proposal.means - centre) / sd, proposal.scales / sd
    shape = jnp.broadcast_shapes(means[:, :, None].shape, centres[:, None].shape)
    pair = overlap(
        jnp.broadcast_to(means[:, :, None], shape),
        jnp.broadcast_to(factors[:, :, None], (*shape, d)),
        jnp.broadcast_to(centres[:, None], shape),
        jnp.broadcast_to(scales[:, None], (*shape, d)),
    )
    volume = np.float32(0.0 if bounded(settings) else -d * np.log(sd))  # 1 / prior density of y
    ratio = weights - log_normaliser(means, factors, settings) + volume
    ratio = ratio[:, :, None] + pair + jax.nn.log_softmax(proposal.logits)[:, None, :]
    mixed = jax.nn.logsumexp(ratio, axis=(1, 2)) - proposal.log_inside
    w0 = proposal.prior_weight
    usual = w0 < 1  # the prior itself needs no correction, and its unused Gaussians no gradient
    mixed = jnp.where(usual, mixed, 0.0)
    return jnp.logaddexp(jnp.log(w0), jnp.log(jnp.where(usual, 1 - w0, 1e-30)) + mixed)


def mixture(params: Params, x: Array, d: int, settings: InferenceSettings) -> tuple[Array, Array, Array]:
    """Mixture in the chart: log weights [n, K], means [n, K, d], Cholesky factors of the covariances [n, K, d, d]."""
    return converted(forward(params, x, d, settings), settings)


def converted(heads: Heads, settings: InferenceSettings) -> tuple[Array, Array, Array]:
    """`mixture` from what `forward` gives, [..., K] in place of [n, K]."""
    weights, means, factors = heads
    centre, sd = (np.float32(v) for v in charts.SCORE[settings.chart])
    if not bounded(settings):
        # covariance (A^T A)^-1 = A^-1 A^-T, and A^-1 is lower triangular
        return weights, centre + means * sd, inverse_lower(factors) * sd
    # I + A^T A = L L^T, its inverse is (L^-T) (L^-T)^T; mean = mu - (I + A^T A)^-1 mu
    eye = jnp.broadcast_to(jnp.eye(means.shape[-1]), factors.shape)
    lower = lower_factor(jnp.concatenate([jnp.swapaxes(factors, -1, -2), eye], axis=-1))
    scales = lower_factor(jnp.swapaxes(inverse_lower(lower), -1, -2))
    shrunk = product(scales, product(jnp.swapaxes(scales, -1, -2), means[..., None]))[..., 0]
    return weights, means - shrunk, scales


def overlap(means: Array, factors: Array, centres: Array, scales: Array) -> Array:
    """log of the integral of N(y; centre, S S^T) exp(-|A (y - mu)|^2 / 2).

    It is the evidence N(A mu; A centre, I + A S S^T A^T) less its constant: nothing is inverted, nothing cancels.
    """
    spread = product(factors, scales)
    gap = product(factors, (means - centres)[..., None])
    gram = product(spread, jnp.swapaxes(spread, -1, -2)) + jnp.eye(means.shape[-1])[(None,) * (spread.ndim - 2)]
    return log_gaussian(gap[..., 0], gram)


@jax.custom_jvp
def log_gaussian(v: Array, cov: Array) -> Array:
    """log N(v; 0, cov) + d/2 log 2 pi: v [..., d], cov [..., d, d] -> [...].

    Elimination row by row with the batch as the last axis: in training many times faster than loops over batches of
    small matrices, and no LAPACK (see linalg.py).
    """
    d = v.shape[-1]
    rows = jnp.moveaxis(cov.reshape(-1, d, d), 0, -1)  # [d, d, n]

    def eliminate(carry: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], None]:
        rows, right, value = carry
        pivot = jnp.maximum(rows[0, 0], 1e-20)
        value = value - 0.5 * jnp.log(pivot) - 0.5 * right[0] * right[0] / pivot
        column = rows[1:, 0] / pivot[None]
        right = jnp.pad(right[1:] - column * right[:1], ((0, 1), (0, 0)))
        rows = jnp.pad(rows[1:, 1:] - column[:, None] * rows[:1, 1:], ((0, 1), (0, 1), (0, 0)))
        return (rows, right, value), None

    start = rows, v.reshape(-1, d).T, jnp.zeros(rows.shape[-1], v.dtype)
    return jax.lax.scan(eliminate, start, length=d)[0][2].reshape(v.shape[:-1])


@log_gaussian.defjvp
def _log_gaussian_slope(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    """d log N(v; 0, C) = -a dv + (a a^T - C^-1) : dC / 2, a = C^-1 v: a tenth of the time of going back by each row."""
    (v, cov), (dv, dcov) = primals, tangents
    inverse = _inverse(cov)
    a = jnp.sum(inverse * v[..., None, :], axis=-1)
    by_cov = 0.5 * (a[..., :, None] * a[..., None, :] - inverse)
    return log_gaussian(v, cov), jnp.sum(by_cov * dcov, axis=(-2, -1)) - jnp.sum(a * dv, axis=-1)


def _inverse(cov: Array) -> Array:
    """Inverse of symmetric positive definite matrices [..., d, d], by sweeping every pivot; the batch as last axis."""
    d = cov.shape[-1]
    place = jnp.arange(d, dtype=jnp.int32)[:, None]

    def sweep(k: Array, rows: Array) -> Array:
        row, column = (jax.lax.dynamic_index_in_dim(rows, k, axis, keepdims=False) for axis in (0, 1))  # [d, n]
        pivot = jnp.maximum(jax.lax.dynamic_index_in_dim(row, k, 0), 1e-20)  # [1, n]
        row, column = (jnp.where(place == k, side, side / pivot) for side in (row, column))
        swept = rows - (column * pivot)[:, None] * row[None]
        swept = jnp.where((place == k)[None], column[:, None], swept)
        swept = jnp.where((place == k)[:, None], row[None], swept)
        both = (place == k)[None] & (place == k)[:, None]
        return jnp.where(both, -1 / pivot[None], swept)

    rows = jax.lax.fori_loop(0, d, sweep, jnp.moveaxis(cov.reshape(-1, d, d), 0, -1))
    return -jnp.moveaxis(rows, -1, 0).reshape(cov.shape)
