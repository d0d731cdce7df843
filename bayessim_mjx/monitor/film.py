"""What videos show: the motion of a policy in one episode at given physics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.config import Config
from bayessim_mjx.rollout import rollout


def film(env: Any, config: Config) -> Callable[[Any, int, Any], Any] | None:
    """(policy, control steps, theta [d]) -> qpos [T+1, nq] of one episode; None where no video is to be made."""
    if not config.monitor.video or not hasattr(env, "physics"):
        return None

    def motion(policy: Any, length: int, theta: Any) -> np.ndarray:
        actor, thetas = policy.replace(deterministic=True), jnp.asarray(theta, jnp.float32)[None]
        return np.asarray(rollout(env, actor, jax.random.PRNGKey(config.seed), thetas, length).qpos[0])

    return motion
