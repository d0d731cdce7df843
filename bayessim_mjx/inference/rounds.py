"""Rounds of sequential inference: what each is simulated from, and how its posterior is corrected for that.

prior: always the prior; nothing to correct, and calibration is tested everywhere. The others from the second round on:
apt: non-atomic SNPE-C, a closed-form correction of the loss (mdn.log_tilt); exact in probit coordinates, the default.
truncated: draws of the prior inside the posterior's highest-density region (TSNPE); the loss needs no correction.
division: BayesSim's, one Gaussian as proposal, divided out of what was learnt afterwards (the paper's eq. 19).
Proposals keep their number of Gaussians, so that a later round compiles nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.distributions.estimates import PRIOR_ITSELF as REGION  # from there on `truncated` keeps no region
from bayessim_mjx.inference.fit import FitInfo, FitState, fit, infer, init
from bayessim_mjx.inference.numbers import DEFENSIVE, DRAWS
from bayessim_mjx.inference.settings import InferenceSettings

METHODS = ("apt", "truncated", "division")
# of the posterior that `truncated` leaves outside; source: rule of thumb, method of Deistler et al. 2022
MASS = 1e-3


def chart_of(chart: str) -> str:
    """Chart of the posterior given all trajectories: a product of logit distributions is one in probit coordinates."""
    return "probit" if chart == "logit" else chart


def size_of(proposal: str, components: int) -> int:
    """Gaussians of a proposal."""
    return 1 if proposal == "division" else components


def first(space: object, proposal: str, components: int, chart: str) -> Distribution:
    """Make the prior, with the structure of later proposals."""
    return Distribution.prior(space, size_of(proposal, components), chart_of(chart))  # type: ignore[arg-type]


def following(posterior: Distribution, proposal: str) -> Distribution:
    """Make the proposal of the next round, given the posterior of this one."""
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


def stored(proposals: Distribution, row: int, new: Distribution) -> Distribution:
    """Batched proposals with one of them replaced."""
    return jax.tree.map(lambda all_, one: all_.at[row].set(one), proposals, new)


def repeated(proposal: Distribution, rows: int) -> Distribution:
    """Make a batch of the same proposal."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (rows, *leaf.shape)), proposal)


def proposal_of(posterior: Distribution, method: str) -> Distribution:
    """Make the proposal of the next round (for `truncated`: drawn by draw_truncated)."""
    if method not in METHODS:
        raise ValueError(f"method = {method!r}: there are {', '.join(METHODS)}")
    if method == "division":
        return replace(posterior.reduce(1), prior_weight=jnp.zeros((), jnp.float32))
    if method == "truncated":
        return posterior
    # of the prior, so that a wrong first round hides nothing for ever
    return replace(posterior, prior_weight=jnp.maximum(posterior.prior_weight, DEFENSIVE))


def stack(proposals: Sequence[Distribution]) -> Distribution:
    """Proposals of different numbers of Gaussians -> one distribution with a leading axis, as `fit` takes them."""
    most = max(p.components for p in proposals)
    padded = [_pad(p, most - p.components) for p in proposals]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *padded)


def _pad(q: Distribution, more: int) -> Distribution:
    unused = Distribution.prior(q.space, 1, q.chart)
    join = lambda a, b: jnp.concatenate([a, *[b] * more])  # noqa: E731
    logits = join(jax.nn.log_softmax(q.logits), jnp.full(1, -1e9, jnp.float32))
    return replace(q, logits=logits, means=join(q.means, unused.means), scales=join(q.scales, unused.scales))


def draw_truncated(key: Array, posterior: Distribution, n: int, mass: float = MASS) -> tuple[Array, float]:
    """n draws of the prior restricted to the smallest region that holds 1 - mass of the posterior; and its volume.

    The volume is a share of the prior. By rejection from half prior, half posterior of doubled spread.
    """
    key, key_level = jax.random.split(key)
    level = jnp.quantile(posterior.log_gain(posterior.sample(key_level, DRAWS)), mass)
    q = posterior
    wide = Distribution.from_unit(q.space, q.logits, q.means, 2 * q.scales, 0.5, q.chart)
    kept: list[np.ndarray] = []
    weights: list[np.ndarray] = []
    while sum(len(rows) for rows in kept) < n:
        key, key_draw, key_keep = jax.random.split(key, 3)
        theta = wide.sample(key_draw, DRAWS)
        # prior / wide density, at most 2
        weight = np.asarray(jnp.where(posterior.log_gain(theta) >= level, jnp.exp(-wide.log_gain(theta)), 0.0))
        weights.append(weight)
        chosen = np.asarray(jax.random.uniform(key_keep, (DRAWS,))) * max(w.max() for w in weights) < weight
        kept.append(np.asarray(theta)[chosen])
    return jnp.asarray(np.concatenate(kept)[:n]), float(np.mean(weights))


@dataclass
class Rounds:
    """State of sequential inference: simulations of all rounds, and the posterior after the last one."""

    state: FitState
    thetas: Array
    x: Array
    origin: Array  # [N] round of each row
    proposals: list[Distribution]
    posterior: Distribution | None = None
    infos: list[FitInfo] = field(default_factory=list)
    lost: float = 0.0  # `division`: weight of the components that could not be divided
    volume: float = 1.0  # `truncated`: share of the prior that was simulated last


def sequential(
    key: Array,
    settings: InferenceSettings,
    space: object,
    simulate: Callable[[Array, Array], Array],
    x: Array,
    simulations: Sequence[int],
    method: str = "apt",
    ftune: bool = True,
) -> Rounds:
    """Posterior of the summaries x [n, D] of real trajectories after rounds of `simulations` each.

    `simulate(key, thetas [N, d])` gives summaries [N, D]. The first round is drawn from the prior. ftune keeps one
    network over the rounds; otherwise each round trains a new one. Logit coordinates are refused but for `truncated`.
    """
    if settings.chart == "logit" and method != "truncated":
        raise ValueError(f"method = {method!r} needs plain or probit coordinates, not logit; there is truncated too")
    prior = Distribution.prior(space, 1, settings.chart)  # type: ignore[arg-type]
    keys = jax.random.split(key, 1 + len(simulations))
    empty = jnp.zeros((0, len(prior.names)))
    rounds = Rounds(_network(keys[0], settings, space, x), empty, x[:0], jnp.zeros(0, jnp.int32), [])
    for i, count in enumerate(simulations):
        key_theta, key_x, key_fit, key_new = jax.random.split(keys[i + 1], 4)
        proposal = prior if rounds.posterior is None else proposal_of(rounds.posterior, method)
        if method == "truncated" and rounds.posterior is not None:
            thetas, rounds.volume = draw_truncated(key_theta, proposal, count)
        else:
            thetas = proposal.sample(key_theta, count)
        rounds.thetas = jnp.concatenate([rounds.thetas, thetas])
        rounds.x = jnp.concatenate([rounds.x, simulate(key_x, thetas)])
        rounds.origin = jnp.concatenate([rounds.origin, jnp.full(count, i, jnp.int32)])
        rounds.proposals.append(proposal)
        if i and not ftune:
            rounds.state = _network(key_new, settings, space, x)
        _learn(key_fit, rounds, x, method)
    return rounds


def _network(key: Array, settings: InferenceSettings, space: object, x: Array) -> FitState:
    return init(key, settings, space, x.shape[1])


def _learn(key: Array, rounds: Rounds, x: Array, method: str) -> None:
    """Fit the rows that the method may use, and condition on the real trajectories."""
    first = len(rounds.proposals) == 1
    use, correction = slice(None), dict[str, Any]()
    if method == "division":  # only the last round: its network is that of one proposal
        use = slice(len(rounds.thetas) - int((rounds.origin == len(rounds.proposals) - 1).sum()), None)
    elif method == "apt" and not first:
        correction = {"proposals": stack(rounds.proposals), "origin": rounds.origin}
    state, info = fit(key, rounds.state, rounds.thetas[use], rounds.x[use], **correction)
    rounds.state = state
    rounds.infos.append(info)
    if method == "division" and not first:
        rounds.posterior, rounds.lost = _quotient(state, x, rounds.proposals[-1])
    else:
        rounds.posterior = infer(state, x, state.settings.components)


def _quotient(state: FitState, x: Array, proposal: Distribution) -> tuple[Distribution, float]:
    """Posterior of x [n, D] from a network trained on one Gaussian proposal: each factor divided by it, multiplied."""
    parts = [infer(state, row[None]).divide(proposal) for row in x]
    first, *others = [q for q, _ in parts]
    posterior = first.product(*others, components=state.settings.components)
    return posterior, float(np.mean([lost for _, lost in parts]))
