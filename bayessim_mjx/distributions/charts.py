"""Coordinates z of the unit cube in which a Distribution is a mixture of Gaussians: plain, probit or logit.

plain: z = u, truncated to the cube; the prior is flat. probit: z = Phi^-1(u); the prior is N(0, I), nothing is cut off.
logit: z = log(u / (1 - u)); the prior is logistic, nothing is cut off.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import ndtr, ndtri

from bayessim_mjx.compat import brief

CHARTS = ("plain", "probit", "logit")
EDGE = 1e-6  # unit coordinates are kept this far from 0 and 1 where a chart is infinite there
PRIOR_PRECISION = {"plain": 0.0, "probit": 1.0}  # where the prior is Gaussian: products and quotients are closed
# mean and sd of a Gaussian that is the prior. plain: its density varies by 3e-4 inside the cube. logit: to 0.02 in
# probability, and exactly N(0, 1) in mean and variance in the probit chart, where products are taken
NEUTRAL = {"plain": (0.5, 20.0), "probit": (0.0, 1.0), "logit": (0.0, 1.77579)}
# centre and sd of the prior: z-scores for networks
SCORE = {"plain": (0.5, 12**-0.5), "probit": (0.0, 1.0), "logit": (0.0, np.pi / 3**0.5)}


def check(chart: str) -> str:
    """Check the chart's name; ValueError if there is none of that name."""
    if chart not in CHARTS:
        raise ValueError(f"chart = {chart!r}: allowed are {', '.join(CHARTS)}")
    return chart


def to_chart(u: Array, chart: str) -> Array:
    """Map unit coordinates to z, elementwise."""
    return u if chart == "plain" else _to_chart(u, chart)


@partial(brief, static_argnums=1)
def _to_chart(u: Array, chart: str) -> Array:
    u = jnp.clip(u, EDGE, 1 - EDGE)
    return ndtri(u) if chart == "probit" else jnp.log(u) - jnp.log1p(-u)


def from_chart(z: Array, chart: str) -> Array:
    """z -> unit coordinates, elementwise (plain: as they are, also outside the cube)."""
    if chart == "plain":
        return z
    return ndtr(z) if chart == "probit" else jax.nn.sigmoid(z)


def log_slope(z: Array, chart: str) -> Array:
    """log |det dz/du| at z [..., d] -> [...]; a density of z times this is a density of u."""
    if chart == "plain":
        return jnp.zeros(z.shape[:-1], z.dtype)
    if chart == "probit":
        return jnp.sum(0.5 * z * z + np.float32(0.5 * np.log(2 * np.pi)), axis=-1)
    return jnp.sum(jax.nn.softplus(z) + jax.nn.softplus(-z), axis=-1)


# The numbers that a Distribution is made of, as the functions on them read them


class Parts(Protocol):
    """See `Distribution`."""

    @property
    def prior_weight(self) -> Array: ...
    @property
    def logits(self) -> Array: ...
    @property
    def means(self) -> Array: ...
    @property
    def scales(self) -> Array: ...
    @property
    def log_inside(self) -> Array: ...
    @property
    def space(self) -> Any: ...
    @property
    def chart(self) -> str: ...
    @property
    def components(self) -> int: ...
