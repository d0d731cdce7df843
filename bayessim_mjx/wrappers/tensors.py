"""Arrays of JAX as tensors of PyTorch and back, by DLPack: on one device nothing is copied but actions.

Tensors made from our arrays share their memory. JAX takes its arrays as unchangeable: what a trainer might write into
is cloned by the wrappers.
"""

from typing import Any

import jax

from bayessim_mjx.errors import UserError


def torch() -> Any:
    """Import the module; UserError where it is not installed."""
    try:
        import torch as module
    except ImportError as error:
        raise UserError(f"this wrapper needs PyTorch: pip install torch ({error})") from error
    return module


def device_of(x: jax.Array) -> str:
    """Name the device of `x` as PyTorch does."""
    device = x.devices().pop()
    return "cpu" if device.platform == "cpu" else f"cuda:{device.id}"


def to_torch(tree: Any) -> Any:
    """Every array of a tree as a tensor."""
    module = torch()
    return jax.tree.map(module.from_dlpack, tree)


def to_jax(tensor: Any, device: jax.Device | None = None) -> jax.Array:
    """Copy `tensor` as an array; it is moved where `device` is another one."""
    x = jax.dlpack.from_dlpack(tensor.detach().clone().contiguous())
    return x if device is None or x.devices() == {device} else jax.device_put(x, device)
