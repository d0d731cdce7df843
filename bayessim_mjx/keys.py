"""Random keys that no other draw has."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

BEYOND = 2**31  # no key is split into as many
GOLDEN = np.uint32(2654435769)  # 2^32 / golden ratio: multiples of it are spread evenly (Knuth, TAOCP 3, 6.4)


def branch(key: Array, number: int | Array) -> Array:
    """Make a key for a purpose of its own, beside those that `jax.random.split(key, n)` gives.

    `jax.random.fold_in(key, i)` is the i-th of those: what both are used for would be drawn alike.
    """
    return jax.random.fold_in(key, np.uint32(BEYOND) + jnp.asarray(number).astype(np.uint32))


__all__ = ["GOLDEN", "branch"]
