"""State of the network between fits, results of a fit, and the pairs (theta, summary) as training takes them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.distributions.storage import coordinates
from bayessim_mjx.inference import mdn
from bayessim_mjx.inference.numbers import DRAWS, FEW
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.keys import GOLDEN
from bayessim_mjx.linalg import inverse_spread, product


@struct.dataclass
class FitState:
    """State between fits: weights and the standardisation of the inputs. Arrays only, but for the two settings."""

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
        """Meaning of the network's outputs, as of a `Distribution`."""
        return coordinates(self.space, self.settings.chart)

    def inputs(self, x: Array) -> Array:
        """Summaries x [n, D] as the network takes them in [n, D]."""
        z = standardise(x, self.x_mean, self.x_rate, self.settings.clip)[0]
        return z if self.basis is None else rotated(z, self.basis, self.settings.clip)


@struct.dataclass
class FitInfo:
    """Report of a fit. Scores are means over held-out rows, in nats."""

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


class Data(NamedTuple):
    # [N, D] as the network takes them in; in training [M, N + K m, D] in each of the bases, the draws of `Again` behind
    x: Array
    y: Array  # [N, d]
    slopes: Array  # [N] log density of u = log density of y + this
    train: Array  # [N] bool
    held: Array  # [V] indices of held-out rows, padded
    mask: Array  # [V] float32
    origin: Array | None  # [N] the proposal each row was simulated from
    proposals: Distribution | None  # leaves [R, ...]
    own: Array | None = None  # of `Again`
    draws: int = 1  # 1 + K


class Again(NamedTuple):
    """Further draws of the measurement noise of some rows: training sees another one in every epoch."""

    x: Array  # [m, K, D]
    own: Array  # [N] int32: which of the m a row is, -1: none


def prepare(
    state: FitState, thetas: Array, x: Array, count: Array, again: Again | None = None
) -> tuple[FitState, Data, Array, Array]:
    """Mask, standardise and split. The split depends on the row number only, so it survives from fit to fit."""
    rows = jnp.arange(x.shape[0], dtype=jnp.int32)
    given = rows < count
    valid = given & jnp.all(jnp.isfinite(x), axis=1) & jax.vmap(state.space.contains)(thetas)
    if again is not None:
        valid = valid & ((again.own < 0) | jnp.all(jnp.isfinite(again.x), axis=(1, 2))[again.own])
    nominal = jnp.asarray(state.space.nominal)[None, :]
    u = jnp.clip(jax.vmap(state.space.to_unit)(jnp.where(valid[:, None], thetas, nominal)), 0, 1)
    x = jnp.where(valid[:, None], x, 0.0)
    embedding = state.settings.embedding
    mean, rate = column_scales(x, valid) if embedding is None else embedding.scales(x, valid)
    fresh = (state.fits == 0) | state.settings.restandardise
    mean, rate = jnp.where(fresh, mean, state.x_mean), jnp.where(fresh, rate, state.x_rate)
    z, clipped = standardise(x, mean, rate, state.settings.clip)

    share = np.uint32(round(state.settings.validation * 2**32))
    held = valid & (rows.astype(jnp.uint32) * GOLDEN < share)  # spread evenly over any number of rows
    held = jnp.where(jnp.any(held), held, valid)  # a handful of rows: better to validate on them than not at all
    # a multiple of what is looked at together: a remainder would be another program of the same
    room = min(x.shape[0], -(-(int(state.settings.validation * x.shape[0]) + 8) // FEW) * FEW, DRAWS)
    order = jnp.argsort(~held)[:room]
    train = jnp.where(jnp.any(valid & ~held), valid & ~held, valid)
    y = mdn.to_y(u, state.settings.chart)
    slopes = mdn.log_volume(y, state.settings.chart)
    if again is not None:
        more = jnp.moveaxis(again.x, 1, 0).reshape(-1, x.shape[1])
        z = jnp.concatenate([z, standardise(jnp.nan_to_num(more), mean, rate, state.settings.clip)[0]])
    data = Data(z, y, slopes, train, order, held[order].astype(jnp.float32), None, None)
    if again is not None:
        data = data._replace(own=again.own, draws=1 + again.x.shape[1])
    n_invalid = jnp.sum((given & ~valid).astype(jnp.int32))
    entries = jnp.maximum(jnp.sum(valid.astype(jnp.float32)), 1.0) * x.shape[1]
    share_clipped = jnp.sum(jnp.where(valid[:, None], clipped, 0.0)) / entries
    return replace(state, x_mean=mean, x_rate=rate), data, share_clipped, n_invalid


def column_scales(x: Array, valid: Array) -> tuple[Array, Array]:
    """Mean and 1 / sd per column over the valid rows; 0 where a column does not vary beyond rounding."""
    n = jnp.maximum(jnp.sum(valid.astype(jnp.float32)), 1.0)
    mean = jnp.sum(x, axis=0) / n
    deviation = jnp.where(valid[:, None], x - mean[None, :], 0.0)
    sd = jnp.sqrt(jnp.sum(deviation**2, axis=0) / n)
    return mean, inverse_spread(mean, sd)
