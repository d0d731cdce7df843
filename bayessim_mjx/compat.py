"""Libraries that we build on, where they say or ask what they should not."""

import contextlib
import io
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

with contextlib.redirect_stdout(io.StringIO()):  # MJX announces on import that the optional warp is absent
    from mujoco import mjx

__all__ = ["mjx", "put_replicated", "supply"]


def put_replicated(tree: Any, devices: Sequence[jax.Device]) -> Any:
    """Every leaf once per device, along a new leading axis that is spread over them.

    The axis is called i, as Brax's pmap calls it: under another name Brax's epoch would be compiled twice.
    """
    sharding = NamedSharding(Mesh(np.array(devices), ("i",)), PartitionSpec("i"))

    def put(x: Any) -> jax.Array:
        x = jnp.asarray(x)
        return jax.device_put(jnp.broadcast_to(x, (len(devices), *x.shape)), sharding)

    return jax.tree.map(put, tree)


def supply() -> None:
    """Give jax >= 0.10 the `device_put_replicated` that Brax 0.14.2, the newest release, calls in its trainers.

    Without it `brax.training.agents.ppo.train` ends with an AttributeError (google/brax#671). Nothing is replaced.
    """
    if not hasattr(jax, "device_put_replicated"):
        jax.device_put_replicated = put_replicated  # type: ignore[assignment]
