"""Runs with a small checkpoint."""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np


@flax.struct.dataclass
class Moments:
    mean: jax.Array
    count: jax.Array
    unused: None = None


def tree(seed: int = 0, width: int = 5) -> dict:
    rng = np.random.default_rng(seed)
    special = np.array([np.nan, -0.0, np.inf, 1e-45, 3.0000002], np.float32)
    return {
        "policy": {"w": [jnp.asarray(rng.normal(size=(3, width)).astype(np.float32)), jnp.asarray(special)]},
        "state": Moments(jnp.zeros((0, 4)), jnp.int32(7 + seed)),
        "key": jax.random.PRNGKey(seed),
        "flags": jnp.array([True, False]),
    }


def same_bits(a: object, b: object) -> bool:
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return all(x.dtype == y.dtype and x.shape == y.shape and x.tobytes() == y.tobytes() for x, y in
               ((np.asarray(x), np.asarray(y)) for x, y in pairs))  # fmt: skip
