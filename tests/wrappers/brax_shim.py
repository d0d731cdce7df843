"""brax 0.14.2 calls jax.device_put_replicated, which jax 0.10 removed (google/brax#671, mended after that release)."""

import contextlib

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec


def put_replicated(tree, devices):
    """Every leaf once per device along a leading axis, called i as in brax (else its programs compile twice)."""
    sharding = NamedSharding(Mesh(np.array(devices), ("i",)), PartitionSpec("i"))
    return jax.tree.map(lambda x: jax.device_put(np.stack([np.asarray(x)] * len(devices)), sharding), tree)


@contextlib.contextmanager
def device_put_replicated():
    """`jax.device_put_replicated` put back for the time being."""
    before = jax.__dict__.get("device_put_replicated")
    jax.device_put_replicated = put_replicated
    try:
        yield
    finally:
        del jax.device_put_replicated
        if before is not None:
            jax.device_put_replicated = before
