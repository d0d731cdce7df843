"""Worlds spread over the devices of a mesh: one program for one device and for many, of one process or of several.

What belongs to worlds lies where they live, all else on every device; the compiler puts the sums over devices in. What
is simulated is declared local, as no world needs another. A mesh of None is one device, and nothing is done.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from bayessim_mjx.device import WORLDS

EVERYWHERE = PartitionSpec()
FIRST, SECOND = PartitionSpec(WORLDS), PartitionSpec(None, WORLDS)  # the axis of the arrays that counts worlds


def count(mesh: Mesh | None) -> int:
    """How many devices."""
    return 1 if mesh is None else mesh.size


def pinned(tree: Any, mesh: Mesh | None, spec: Any = EVERYWHERE) -> Any:
    """Inside a jitted function: the same arrays, laid out as `spec` says (one for all, or a pytree of them)."""
    if mesh is None:
        return tree
    if isinstance(spec, PartitionSpec):
        spec = jax.tree.map(lambda _: spec, tree)
    return jax.tree.map(lambda x, s: jax.lax.with_sharding_constraint(x, NamedSharding(mesh, s)), tree, spec)


def local(function: Callable[..., Any], mesh: Mesh | None, given: Any, returned: Any) -> Callable[..., Any]:
    """Apply `function` on each device to its own worlds; the specs lay out its arguments and results."""
    if mesh is None:
        return function
    return jax.shard_map(function, mesh=mesh, in_specs=given, out_specs=returned, check_vma=False)


def put(tree: Any, mesh: Mesh | None, spec: Any) -> Any:
    """Put copies of host or device arrays on the mesh, laid out by the pytree `spec`; every process has all of them."""
    if mesh is None:
        return jax.tree.map(jax.numpy.copy, tree)

    def move(x: Any, spec: PartitionSpec) -> jax.Array:
        there = NamedSharding(mesh, spec)
        if isinstance(x, jax.Array) and x.sharding.is_equivalent_to(there, x.ndim):
            return jax.numpy.copy(x)
        return jax.device_put(np.asarray(x), there)

    return jax.tree.map(move, tree, spec)


def agreed(tree: Any) -> Any:
    """Host arrays, those of the first process in all of them: what every device is given has to be the same."""
    if jax.process_count() == 1:
        return jax.device_get(tree)
    from jax.experimental.multihost_utils import broadcast_one_to_all

    return jax.device_get(broadcast_one_to_all(jax.device_get(tree)))


def at_home(tree: Any) -> Any:
    """Arrays that lie on every device, as host arrays: what this process does alone stays its own."""
    return jax.tree.map(lambda x: np.asarray(x) if _spread(x) else x, tree)


def _spread(x: Any) -> bool:
    return isinstance(x, jax.Array) and not isinstance(x, jax.core.Tracer) and len(x.sharding.device_set) > 1
