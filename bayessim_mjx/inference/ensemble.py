"""The ensemble's mixture: its parts and their weights by the held-out rows, its posteriors and their scores."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.distributions import Distribution, charts, evaluate
from bayessim_mjx.inference import identify, mdn, temperature, truncation_moments
from bayessim_mjx.inference.numbers import EPS, FEW, NEGLIGIBLE, TURNS
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.inference.state import Data, FitState
from bayessim_mjx.inference.train import objective_of

# sharpnesses of the parts that are tried on held-out rows; before there were several of each member, regions of
# BayesSimIG's *fixed* held .738 .899 .976. source: benchmarks/history.md, posteriors; the range is a rule of thumb
SHARPNESS = np.geomspace(0.35, 4.0, 21).astype(np.float32)
BEYOND = -NEGLIGIBLE / EPS  # log mass inside the box: float32 knows what is inside to NEGLIGIBLE of itself


def posteriors(state: FitState, z: Array) -> Distribution:
    """Turn the network's inputs [n, D] into a batched Distribution, a trace of the prior mixed in.

    Far from what it was trained on a network may leave the box altogether: what is then inside is the rounding of huge
    numbers, which tells nothing. The prior stays.
    """
    build = partial(
        Distribution.from_unit, state.space, prior_weight=state.settings.defensive, chart=state.settings.chart
    )
    found = jax.vmap(build)(*mixtures(state, z))
    return replace(found, prior_weight=jnp.where(found.log_inside < BEYOND, 1.0, found.prior_weight))


def mixtures(state: FitState, z: Array) -> mdn.Heads:
    """Log weights [n, E K], means and factors of the ensemble's mixture."""
    d, settings = len(state.space), state.settings
    own = parts(state.params)
    found = joined(jax.vmap(lambda params: mdn.mixture(params, z, d, settings))(own), state.params["share"])
    return truncation_moments.weighed(*found)[:3] if settings.coordinates == "matched" else found


def parts(params: Any) -> Any:
    """Pick the networks of the mixture's parts [E, ...]: a member may be several, more or less sharp, or none."""
    own = {name: params[name] for name in ("sharpness", "share", "member")}
    return {**jax.tree.map(lambda leaf: leaf[params["member"]], params), **own}


def heads(params: Any, data: Data, settings: InferenceSettings) -> mdn.Heads:
    """Compute outputs of each member by itself on the held-out rows: leaves [E, V, K, ...].

    All that follows training is computed from it: each forward pass would be compiled once more.
    """
    x, d = data.x[data.held], data.y.shape[-1]
    return jax.vmap(lambda p: mdn.forward({**p, "sharpness": jnp.ones(())}, x, d, settings))(params)


def parts_of(members: mdn.Heads, params: Any) -> mdn.Heads:
    """Pick the mixture's parts from what the members make of the same rows: leaves [E, V, K, ...]."""
    weights, means, factors = (leaf[params["member"]] for leaf in members)
    return weights, means, factors * params["sharpness"].reshape(-1, *[1] * (factors.ndim - 1))


def joined(leaves: mdn.Heads, share: Array) -> mdn.Heads:
    """One mixture per row of those of its parts, leaves [E, n, K, ...] -> [n, E K, ...]."""
    logits = leaves[0] + share[:, None, None]
    found = [jnp.moveaxis(leaf, 0, 1).reshape(leaf.shape[1], -1, *leaf.shape[3:]) for leaf in (logits, *leaves[1:])]
    return found[0], found[1], found[2]


def weigh(params: Any, data: Data, settings: InferenceSettings, known: mdn.Heads | None = None) -> Any:
    """Choose the mixture's parts by the held-out density: whose network each is, how sharp, its weight.

    Networks that disagree make a mixture that is wider than it need be, a single one is narrower than it may be; and
    where a network is far better in some places than in others, itself sharper and itself wider make the peak and the
    tails of a posterior that holds as often as it says. `known` are the `heads`, where there are.
    """
    own = heads(params, data, settings) if known is None else known

    def scores(sharpness: Array) -> Array:
        density = jax.vmap(lambda h: objective_of(mdn.sharper(h, sharpness), data.held, data, settings))(own)
        return jnp.where(data.mask[None, :] > 0, jnp.maximum(density, -1e6), 0.0)  # [E, V]

    table = jax.lax.map(scores, jnp.asarray(SHARPNESS))  # [S, E, V]
    table = table.reshape(-1, table.shape[-1])
    everyone = jnp.arange(len(table), dtype=jnp.int32)

    def mixed(choice: Array, share: Array) -> tuple[Array, Array]:
        """Log weights [E], climbing from `share`, and total log density of the parts `choice` [E]."""
        density = table[choice]

        def climb(share: Array, _: None) -> tuple[Array, None]:
            # expectation maximisation; one row's worth of every part for few rows
            mine = jax.nn.softmax(density + share[:, None], axis=0) @ data.mask + 1.0
            return jnp.log(mine) - jnp.log(jnp.sum(mine)), None

        share, _ = jax.lax.scan(climb, share, length=FEW)
        return share, data.mask @ jax.nn.logsumexp(density + share[:, None], axis=0)

    def improve(carry: tuple[Array, Array], part: Array) -> tuple[tuple[Array, Array], None]:
        """Choose the best for one part, the others held."""
        choice, share = carry
        tries = jnp.where(jnp.arange(settings.ensemble) == part, everyone[:, None], choice[None, :])
        shares, values = jax.vmap(lambda t: mixed(t, share))(tries)
        # another choice has to gain what it costs to name one of so many: the best of many is luck
        worth = np.float32(np.log(len(table)))
        best = jnp.nanargmax(jnp.where(everyone == choice[part], values + worth, values))
        return (tries[best], shares[best]), None

    # each member at its best at first
    alone = (table @ data.mask).reshape(len(SHARPNESS), settings.ensemble)
    members = jnp.arange(settings.ensemble, dtype=jnp.int32)
    first = jnp.nanargmax(alone, axis=0).astype(jnp.int32) * settings.ensemble + members
    alike = jnp.full(settings.ensemble, np.float32(-np.log(settings.ensemble)))

    def turn(carry: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        i, before, _, share = carry
        (choice, share), _ = jax.lax.scan(improve, (before, share), members)
        return i + 1, choice, jnp.any(choice != before), share

    start = jnp.asarray(0, jnp.int32), first, jnp.asarray(True), mixed(first, alike)[0]
    _, choice, _, share = jax.lax.while_loop(lambda c: c[2] & (c[0] < TURNS), turn, start)
    sharpness, member = jnp.asarray(SHARPNESS)[choice // settings.ensemble], choice % settings.ensemble
    return {**params, "sharpness": sharpness, "member": member, "share": mixed(choice, share)[0]}


def as_deep(state: FitState, data: Data, members: mdn.Heads) -> FitState:
    """All parts sharper or wider by one factor, so that held-out truths lie as deep in their posteriors as they should.

    The weights and sharpnesses of the best density leave them too wide where errors have long tails, as most are then
    smaller than it says: 62 % of truths in the 50 % regions of BayesSimIG's data. And they are those of all parameters
    together: a network that is too wide for what it tells may be just right for the others, of which it makes flat
    Gaussians. So it is judged as it is used, with the prior where state.identified has nothing.
    """
    settings, share, keep = state.settings, state.params["share"], state.identified
    centre, sd = (np.float32(v) for v in charts.SCORE[settings.chart])
    own = parts_of(members, state.params)
    logits, means, scales = joined(mdn.converted(own, settings), share)
    inside, learnt = None, (means, scales)
    if settings.coordinates == "matched":  # masses are long to compute: those of other factors are taken to be the same
        logits, _, _, inside = truncation_moments.weighed(logits, means, scales)
    means, scales = identify.beside_prior(means, scales, keep, settings.chart)

    def at(factor: Array) -> mdn.Heads:
        if mdn.bounded(settings):
            weights, centres, widths = joined(mdn.converted(mdn.sharper(own, factor), settings), share)
            return weights, *identify.beside_prior(centres, widths, keep, settings.chart)
        if inside is not None:
            before_cut = truncation_moments.shapes(learnt[0], learnt[1] / factor)
            return logits, *identify.beside_prior(*before_cut, keep, settings.chart)
        return logits, means, scales / jnp.where(keep, factor, 1.0)[None, None, :, None]

    mask, truth = data.mask, data.y[data.held] * sd + centre
    # the same draws in every fit: weights that are kept keep their factor
    factor = temperature.coverage_factor(jax.random.PRNGKey(0), at, truth, mask, keep, settings.chart, inside)
    return replace(state, params={**state.params, "sharpness": state.params["sharpness"] * factor})


def held_out(own: mdn.Heads, share: Array, data: Data, settings: InferenceSettings) -> Array:
    """Log density of y of the mixture of these parts at the held-out rows [V]."""
    value = jax.vmap(lambda h: objective_of(h, data.held, data, settings))(own)
    return jax.nn.logsumexp(value + share[:, None], axis=0)


def average(value: Array, mask: Array) -> Array:
    """Mean over the held-out rows [V]."""
    return jnp.sum(jnp.where(mask > 0, value, 0.0)) / jnp.sum(mask)


def marginal_gain(mixture: mdn.Heads, y: Array, settings: InferenceSettings) -> Array:
    """log marginal density of each parameter relative to its prior at y [n, d] -> [n, d]."""
    centre, sd = (np.float32(v) for v in charts.SCORE[settings.chart])
    z = y * sd + centre
    if settings.chart == "plain":
        return identify.marginal_gain(*mixture, z)
    logits, means, scales = mixture
    spread = jnp.sqrt(jnp.sum(scales**2, axis=-1))  # [n, K, d]
    density = jax.scipy.stats.norm.logpdf((z[:, None, :] - means) / spread) - jnp.log(spread)
    marginal = jax.nn.logsumexp(jax.nn.log_softmax(logits)[:, :, None] + density, axis=1)
    return marginal + charts.log_slope(z[..., None], settings.chart)


def truncated_scores(
    state: FitState, data: Data, thetas: Array, own: mdn.Heads, mixture: mdn.Heads
) -> dict[str, Array]:
    """Scores of the density cut off at the box, from the parts and from their mixture at the held-out rows."""
    settings, rows, mask = state.settings, data.held, data.mask
    truth = jnp.where(mask[:, None] > 0, thetas[rows], jnp.asarray(state.space.nominal)[None, :])
    # as a `Distribution` has it: of the prior, not of a proposal, and cut off afterwards
    plain = settings if settings.coordinates != "truncated" else replace(settings, coordinates="plain")
    value = held_out(own, state.params["share"], data._replace(proposals=None, origin=None), plain)
    inside = jnp.zeros(len(rows))
    if settings.chart == "plain":
        inside = jax.lax.map(lambda row: evaluate.log_inside(*row, FEW), mixture, batch_size=FEW)
    w0 = settings.defensive
    gain = jnp.log1p(-w0) + value + data.slopes[rows] - inside
    gain = jnp.logaddexp(jnp.log(w0), gain)
    prior = jax.vmap(state.space.log_prior)(truth)
    scores = {"gain_truncated": average(gain, mask), "log_q": average(gain + prior, mask)}
    return {**scores, "inside": average(jnp.exp(inside), mask)}
