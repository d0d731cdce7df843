"""The parts of a task's reward, as its metrics tell them (`Reward/<part>` in TensorBoard)."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp


def told(parts: Mapping[str, Any], ended: jax.Array | None = None, paid: float = 0.0) -> dict[str, jax.Array]:
    """Metrics `reward_<part>`, whose sum is the reward.

    Args:
        ended: where a step that ends the episode pays `paid` in the place of all parts; `reward_end` makes up for them.
    """
    metrics = {f"reward_{name}": jnp.asarray(value, jnp.float32) for name, value in parts.items()}
    if ended is not None:
        metrics["reward_end"] = jnp.where(ended, paid - sum(metrics.values(), jnp.zeros(())), 0.0)
    return metrics
