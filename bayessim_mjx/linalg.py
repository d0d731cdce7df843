"""Triangular algebra on batches of small matrices, in plain array operations.

LAPACK's batched triangular solves share XLA's CPU thread pool: two of them at once can wait for each other for ever
(seen with jaxlib 0.10.2 on 2 cores). For matrices of at most some dozens of rows loops over rows are as fast.
"""

import jax
import jax.numpy as jnp
from jax import Array


def product(a: Array, b: Array) -> Array:
    """a @ b in full float32, also where a GPU would round its inputs to TF32."""
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


def solve_lower(lower: Array, right: Array) -> Array:
    """Z with lower Z = right, by forward substitution: lower [..., d, d], right [..., d, m] -> [..., d, m]."""

    def row(i: Array, z: Array) -> Array:
        left = jax.lax.dynamic_index_in_dim(lower, i, -2, keepdims=True)  # [..., 1, d]
        pivot = jax.lax.dynamic_index_in_dim(left, i, -1, keepdims=True)
        # z_i = (b_i - sum_(j<i) l_ij z_j) / l_ii; the rows from i on are still zero
        new = (jax.lax.dynamic_index_in_dim(right, i, -2, keepdims=True) - product(left, z)) / pivot
        return jax.lax.dynamic_update_slice_in_dim(z, new, i, -2)

    return jax.lax.fori_loop(0, lower.shape[-1], row, jnp.zeros_like(right))


def inverse_lower(lower: Array) -> Array:
    """Inverse of lower triangular matrices [..., d, d]."""
    return solve_lower(lower, jnp.broadcast_to(jnp.eye(lower.shape[-1], dtype=lower.dtype), lower.shape))


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
