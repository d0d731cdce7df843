"""What each round of a loop is simulated from, and what becomes of the factors of its posterior.

`prior`: always the prior; nothing to correct, and calibration is tested everywhere. The others are those of
proposal.py, from the second round on. Proposals keep their number of Gaussians, so that a later round compiles nothing.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.distributions.estimates import PRIOR_ITSELF as REGION  # from there on `truncated` keeps no region
from bayessim_mjx.inference.proposal import GAUSSIANS, draw_truncated, proposal_of


def chart_of(chart: str) -> str:
    """Chart of the posterior given all trajectories: a product of logit distributions is one in probit coordinates."""
    return "probit" if chart == "logit" else chart


def size_of(proposal: str, components: int) -> int:
    """Gaussians of a proposal."""
    return {"apt": GAUSSIANS, "division": 1}.get(proposal, components)


def first(space: object, proposal: str, components: int, chart: str) -> Distribution:
    """The prior, with the structure of later proposals."""
    return Distribution.prior(space, size_of(proposal, components), chart_of(chart))  # type: ignore[arg-type]


def following(posterior: Distribution, proposal: str) -> Distribution:
    """What the next round is simulated from, given the posterior of this one."""
    if proposal == "truncated":
        # the share of the prior, mixed in against misjudgement, would make all of the box the region
        w = posterior.prior_weight
        return replace(posterior, prior_weight=jnp.where(w < REGION, 0.0, w))
    if proposal == "division" and float(posterior.prior_weight) >= REGION:
        return first(posterior.space, proposal, 1, posterior.chart)  # nothing was learnt
    return proposal_of(posterior, proposal)


def draw(key: Array, proposal: Distribution, method: str, n: int) -> Array:
    """n thetas [n, d] to simulate; `method` as in `bayessim.proposal`."""
    if method == "truncated" and float(proposal.prior_weight) < REGION:
        return draw_truncated(key, proposal, n)[0]
    return proposal.sample(key, n)


def divided(factors: list[Distribution], proposal: Distribution) -> tuple[list[Distribution], float]:
    """Each factor times prior / proposal, and the mean share of weight whose quotient is no density."""
    if float(proposal.prior_weight) >= REGION:  # the prior itself
        return factors, 0.0
    found = [factor.divide(proposal) for factor in factors]
    return [q for q, _ in found], float(np.mean([lost for _, lost in found])) if found else 0.0


def stored(proposals: Distribution, row: int, new: Distribution) -> Distribution:
    """Batched proposals with one of them replaced."""
    return jax.tree.map(lambda all_, one: all_.at[row].set(one), proposals, new)


def repeated(proposal: Distribution, rows: int) -> Distribution:
    """A batch of the same proposal."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (rows, *leaf.shape)), proposal)
