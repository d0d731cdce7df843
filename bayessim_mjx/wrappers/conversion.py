"""Arrays of JAX as tensors of PyTorch and back, and Gymnasium's boxes of observations and actions.

Tensors are made by DLPack: on one device nothing is copied but actions. Those made from our arrays share their memory.
JAX takes its arrays as unchangeable: what a trainer might write into is cloned by the wrappers.
"""

from typing import Any

import gymnasium
import jax
import numpy as np

from bayessim_mjx.env import Env
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


def boxes(env: Env, group: str = "policy") -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """(observations of `group`, actions in [-1, 1]) of one world.

    Observations are float32 without bounds; those that the task gives as bytes (a picture `[H, W, C]`) are uint8 from 0
    to 255, by which other libraries know a picture.
    """
    shape, box = env.observation_size[group], gymnasium.spaces.Box
    picture = len(shape) > 1 and _kind(env, group) == np.uint8
    seen = box(0, 255, shape, np.uint8) if picture else box(-np.inf, np.inf, shape, np.float32)
    return seen, box(-1.0, 1.0, (env.action_size,), np.float32)


def _kind(env: Env, group: str) -> np.dtype:
    return jax.eval_shape(env.reset, jax.random.PRNGKey(0)).obs[group].dtype
