"""One batch as the losses see it."""

from typing import Any

import jax
from flax import struct

from bayessim_mjx.rl import segments


@struct.dataclass
class Batch:
    """B transitions; observations normalised by statistics that include them."""

    observation: jax.Array  # [B, S]
    critic_observation: Any  # [B, S'] array
    action: jax.Array  # [B, A] unclipped sample
    mean: jax.Array  # [B, A] of the policy before learning
    log_prob: jax.Array  # [B] by the policy that collected: with older statistics
    value: jax.Array  # [B]
    advantage: jax.Array  # [B]
    returns: jax.Array  # [B]
    log_std: jax.Array | None = None  # [B, A] like the mean, where it depends on the state
    extra: dict[str, Any] = struct.field(default_factory=dict)  # by extension: what it attached, [B, ...]
    weight: jax.Array | None = None  # [B] in the surrogate's mean, where an extension gave some
    future: segments.Future | None = None  # where ppo.segment is: all arrays are then segments [B / L, L, ...]
