"""MDNN: a mixture density network on dense layers (Bishop 1994)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.inference.densities.density import Density, Drop, Params, register
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.keys import GOLDEN

# between the keys of layers: those of points of the curve are GOLDEN apart (train.py); a constant of MurmurHash3
DEEPER = np.uint32(0x85EBCA6B)


def _start(key: Array, settings: InferenceSettings, dim_x: int) -> tuple[Params, tuple[int, ...]]:
    return {}, (dim_x, *settings.hiddenLayers)


def _hidden(params: Params, x: Array, drop: Drop | None = None) -> Array:
    for layer in params["layers"][:-1]:
        x = jax.nn.silu(x @ layer["w"] + layer["b"][None, :])
        if drop is not None:
            key, rate = drop
            kept = _noise(key, x.shape) >= (2.0**31 * rate).astype(jnp.uint32)
            x, drop = jnp.where(kept, x / (1 - rate), 0.0), (key + DEEPER, rate)
    return x


def _noise(key: Array, shape: tuple[int, ...]) -> Array:
    """Numbers below 2^31 by hashing places: random enough to drop units by, in a tenth of jax.random's time."""
    value = jnp.arange(shape[0] * shape[1], dtype=jnp.uint32).reshape(shape) * GOLDEN + key[0]
    for multiplier in (np.uint32(0x7FEB352D), np.uint32(0x846CA68B)):
        value = (value ^ (value >> 16)) * multiplier + key[1]
    return (value ^ (value >> 15)) >> 1


MDNN = register(Density("MDNN", _start, _hidden))
