"""From measured trajectories to one posterior: condition on each, then multiply (never average)."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference.fit import FitState, condition


def combine(posteriors: Distribution | Sequence[Distribution], components: int | None = None) -> Distribution:
    """Posterior given all trajectories: p(theta)^(1-n) prod_i q(theta | x_i), with K = `components` Gaussians.

    `posteriors` is a list, or a batched Distribution as `condition` returns it. The trajectories are taken to be
    independent given theta.
    """
    items = posteriors.split() if isinstance(posteriors, Distribution) else list(posteriors)
    if not items:
        raise ValueError("combine: no posterior given; at least one trajectory is needed")
    if len(items) == 1 and components in (None, items[0].components):
        return items[0]
    return items[0].product(*items[1:], components=components)


def infer(state: FitState, x: Array, components: int | None = None) -> Distribution:
    """One posterior from the summaries x [n, D] of n real trajectories; ValueError on values that are not finite."""
    bad = np.flatnonzero(~np.all(np.isfinite(np.asarray(x)), axis=-1))
    if bad.size:
        raise UserError(f"the summary of real trajectory {bad[0]} holds values that are not finite")
    return combine(condition(state, jnp.asarray(x)), components)
