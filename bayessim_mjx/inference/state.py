"""What a fit leaves for the next one, and what it tells."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from flax import struct
from jax import Array

from bayessim_mjx.distributions.storage import coordinates
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.linalg import product


@struct.dataclass
class FitState:
    """What the next fit needs: weights and the standardisation of the inputs. Arrays only, but for the two settings."""

    params: Any  # of all members of the ensemble: leaves [E, ...]
    x_mean: Array  # [D]
    x_rate: Array  # [D] 1 / sd of the first fit's data; 0 drops a constant column
    basis: Array | None  # [D, inputs] what standardised features are multiplied by; None: nothing
    fits: Array  # [] int32, fits done so far
    identified: Array  # [d] bool, parameters whose marginal beats the prior on the last fit's held-out rows
    settings: InferenceSettings = struct.field(pytree_node=False)
    space: Any  # ParameterSpace, or where ranges may move a `Ranged` one

    @property
    def coordinates(self) -> dict[str, Any]:
        """What the network's outputs mean, as of a `Distribution`."""
        return coordinates(self.space, self.settings.chart)

    def inputs(self, x: Array) -> Array:
        """Summaries x [n, D] as the network takes them in [n, D]."""
        z = standardise(x, self.x_mean, self.x_rate, self.settings.clip)[0]
        return z if self.basis is None else rotated(z, self.basis, self.settings.clip)


@struct.dataclass
class FitInfo:
    """What a person wants to see. Scores are means over held-out rows, in nats."""

    train_loss: Array  # [E] negative log density relative to the prior
    val_loss: Array  # [E], both are means over the ensemble
    steps: Array  # [] gradient steps taken
    best: Array  # [] index into the curves of the weights kept (the latest of the ensemble); -1: those before this fit
    gain: Array  # [] log q(theta | x) - log p(theta), density not truncated (but in truncated coordinates)
    gain_truncated: Array  # [] the same for the truncated density, over the first 256 held-out rows
    log_q: Array  # [] truncated log density in theta units: gain_truncated + log p(theta)
    inside: Array  # [] mean mass of the untruncated mixture inside the box
    parameter_gain: Array  # [d] the same for each parameter's marginal by itself
    identified: Array  # [d] bool: that gain is significant and relevant
    clipped: Array  # [] share of input entries clipped
    n_train: Array  # []
    n_val: Array  # []
    n_invalid: Array  # [] rows left out: not finite, or theta outside the box
    skipped: Array  # [] steps left out because the gradient was not finite


def standardise(x: Array, mean: Array, rate: Array, clip: float) -> tuple[Array, Array]:
    z = (x - mean[None, :]) * rate[None, :]
    return jnp.clip(z, -clip, clip), (jnp.abs(z) > clip).astype(jnp.float32)


def rotated(z: Array, basis: Array, clip: float) -> Array:
    return jnp.clip(product(z, basis), -clip, clip)
