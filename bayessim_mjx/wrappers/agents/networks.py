"""A perceptron of another library as a policy of ours."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from bayessim_mjx.config import PPOConfig
from bayessim_mjx.rl import Policy
from bayessim_mjx.rl.normalise import EPSILON, Moments


def policy(
    layers: Sequence[tuple[Any, Any]], log_std: Any, config: PPOConfig, mean: Any = None, scale: Any = None
) -> Policy:
    """Make a policy that acts as the other library's network does at its mean.

    Args:
        layers: weights `[in, out]` and biases `[out]`, from the first to the last.
        log_std: log standard deviation of actions, `[A]`.
        config: whose activation the network has.
        mean, scale: observations are taken as (x - mean) / scale, `[S]`; None: as they are.
    """
    host = lambda x: jnp.asarray(np.array(x, np.float32))  # noqa: E731  a copy: trainers go on writing into theirs
    size = np.shape(layers[0][0])[0]
    zero, one = np.zeros(size), np.ones(size)
    # ours divides by sqrt(var) + EPSILON
    var = one if scale is None else np.maximum(np.asarray(scale, np.float64).reshape(-1) - EPSILON, 0.0) ** 2
    centre = zero if mean is None else np.asarray(mean, np.float64).reshape(-1)
    moments = Moments(host(centre), host(var), jnp.float32(0.0 if mean is None else 1.0))
    actor = {"layers": [{"w": host(w), "b": host(b)} for w, b in layers], "log_std": host(log_std).reshape(-1)}
    return Policy(actor, moments, config.activation, normalize=mean is not None, action_clip=config.action_clip)
