"""Triangular algebra on batches of small matrices, in plain array operations.

Up to UNROLLED rows they are written out: LAPACK takes as long for one such matrix as a core for the numbers of a dozen.
LAPACK's batched triangular solves share XLA's CPU thread pool: two of them at once can wait for each other for ever
(seen with jaxlib 0.10.2 on 2 cores). For matrices of at most some dozens of rows loops over rows are as fast.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import Array

UNROLLED = 8  # rows
REGRESSED = 1024  # features up to which normal equations save more time than they cost; source: rule of thumb
ROUNDING = 1e-5  # standard deviation over mean of a column that does not vary; source: 100 times float32's resolution
RIDGE = 1e-3  # of the features' variance; source: rule of thumb, not counted


def product(a: Array, b: Array) -> Array:
    """Compute a @ b in full float32, also where a GPU would round its inputs to TF32."""
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def solve_lower(lower: Array, right: Array) -> Array:
    """Z with lower Z = right, by forward substitution: lower [..., d, d], right [..., d, m] -> [..., d, m]."""

    d = lower.shape[-1]
    if 0 < d <= UNROLLED:
        rows: list[Array] = []
        for i in range(d):
            before = _dot([lower[..., i, j, None] for j in range(i)], rows)
            rows.append((right[..., i, :] - before) / lower[..., i, i, None])
        return jnp.stack(rows, axis=-2)

    def row(i: Array, z: Array) -> Array:
        left = jax.lax.dynamic_index_in_dim(lower, i, -2, keepdims=True)  # [..., 1, d]
        pivot = jax.lax.dynamic_index_in_dim(left, i, -1, keepdims=True)
        # z_i = (b_i - sum_(j<i) l_ij z_j) / l_ii; the rows from i on are still zero
        new = (jax.lax.dynamic_index_in_dim(right, i, -2, keepdims=True) - product(left, z)) / pivot
        return jax.lax.dynamic_update_slice_in_dim(z, new, i, -2)

    return jax.lax.fori_loop(0, d, row, jnp.zeros_like(right))


def cholesky(a: Array) -> Array:
    """L [..., d, d], lower triangular, with L L^T = a [..., d, d], of which the lower triangle counts."""
    d = a.shape[-1]
    if d > UNROLLED:
        return jax.lax.linalg.cholesky(a, symmetrize_input=False)
    rows: list[list[Array]] = [[] for _ in range(d)]
    for i, row in enumerate(rows):
        for j in range(i):
            row.append((a[..., i, j] - _dot(row, rows[j][:j])) / rows[j][j])
        row.append(jnp.sqrt(a[..., i, i] - _dot(row, row)))
    return _lower(rows)


def cholesky_solve(lower: Array, right: Array) -> Array:
    """x [..., d] with L L^T x = right [..., d], for L [..., d, d] of at most UNROLLED rows."""
    d, x = right.shape[-1], [right[..., i] for i in range(right.shape[-1])]
    for i in range(d):
        x[i] = (x[i] - _dot([lower[..., i, j] for j in range(i)], x)) / lower[..., i, i]
    for i in reversed(range(d)):
        x[i] = (x[i] - _dot([lower[..., j, i] for j in range(i + 1, d)], x[i + 1 :])) / lower[..., i, i]
    return jnp.stack(x, axis=-1)


def _dot(a: Sequence[Array], b: Sequence[Array]) -> Array | float:
    return sum((x * y for x, y in zip(a, b, strict=False)), start=0.0)


def _lower(rows: list[list[Array]]) -> Array:
    zero = jnp.zeros_like(rows[0][0])
    return jnp.stack([jnp.stack([*row, *[zero] * (len(rows) - len(row))], axis=-1) for row in rows], axis=-2)


def inverse_lower(lower: Array) -> Array:
    """Inverse of lower triangular matrices [..., d, d]."""
    d = lower.shape[-1]
    if d <= UNROLLED:
        rows: list[list[Array]] = []
        for i in range(d):
            own, pivot = [lower[..., i, j] for j in range(i)], 1 / lower[..., i, i]
            column = [_dot(own[j:], [rows[k][j] for k in range(j, i)]) for j in range(i)]
            rows.append([*(-x * pivot for x in column), pivot])
        return _lower(rows)
    return solve_lower(lower, jnp.broadcast_to(jnp.eye(lower.shape[-1], dtype=lower.dtype), lower.shape))


def inverse(a: Array) -> Array:
    """Inverse of positive definite matrices [d, d]."""
    factor = inverse_lower(cholesky(a))
    return product(factor.T, factor)


def lower_factor(rows: Array) -> Array:
    """L [..., d, d], lower triangular with positive diagonal, with L L^T = R R^T for R = rows [..., d, m], m >= d.

    By Gram-Schmidt with re-orthogonalisation: R R^T, whose formation would lose thin directions, is never formed.
    """
    d = rows.shape[-2]

    def row(i: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        basis, lower = carry
        vector = jax.lax.dynamic_index_in_dim(rows, i, -2, keepdims=True)  # [..., 1, m]
        first = product(vector, jnp.swapaxes(basis, -1, -2))
        rest = vector - product(first, basis)
        second = product(rest, jnp.swapaxes(basis, -1, -2))
        rest = rest - product(second, basis)
        length = jnp.sqrt(jnp.sum(rest * rest, axis=-1, keepdims=True))
        basis = jax.lax.dynamic_update_slice_in_dim(basis, rest / length, i, -2)
        here = jax.lax.dynamic_update_slice_in_dim(first + second, length, i, -1)
        return basis, jax.lax.dynamic_update_slice_in_dim(lower, here, i, -2)

    start = jnp.zeros_like(rows), jnp.zeros((*rows.shape[:-1], d), rows.dtype)
    return jax.lax.fori_loop(0, d, row, start)[1]


def ridge(design: Array, y: Array, weights: Array) -> tuple[Array, Array]:
    """Ridge regression of y [n, d] on design [n, H] with weights [n] of 0 or 1 -> mean [d], slope [H, d]."""
    n = jnp.maximum(jnp.sum(weights), 1.0)
    mean = weights @ y / n
    weighted = (design * weights[:, None]).T
    gram = product(weighted, design) / n + RIDGE * jnp.eye(design.shape[1])
    return mean, jnp.linalg.solve(gram, product(weighted, y - mean[None, :]) / n)


def inverse_spread(mean: Array, sd: Array) -> Array:
    """1 / sd of columns [D] with these means; 0 where a column varies by no more than float32's rounding."""
    varies = sd > ROUNDING * jnp.abs(mean) + 1e-12
    return jnp.where(varies, 1.0 / jnp.where(varies, sd, 1.0), 0.0)
