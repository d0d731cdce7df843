"""Training of the inference network in one jitted program, and conditioning it on measured summaries.

Arrays are padded to a capacity and the number of rows is traced: a growing data set does not recompile.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.compat import brief, program
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import ensemble, identify, mdn, whitening
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.inference.state import Again, Data, FitInfo, FitState, prepare, rotated
from bayessim_mjx.inference.train import MEMBERS, train

# rows up to which dropout is as set; with more it falls in proportion: the pendulum gains 7.27 -> 7.31 nats,
# BayesSimIG's *random* 3.72 -> 3.79. source: benchmarks/history.md, posteriors
FEW = 3000


@partial(brief, static_argnums=(1, 2, 3))
def _blank(key: Array, settings: InferenceSettings, dim_x: int, d: int) -> dict[str, Any]:
    """Weights of the whole ensemble `[E, ...]`, and what a FitState has besides them: one program."""
    counts = jnp.asarray(mdn.counts(settings))
    width = whitening.width(settings, dim_x, d)
    params = jax.vmap(lambda k, count: mdn.init(k, settings, width, d, count))(
        jax.random.split(key, settings.ensemble), counts
    )
    params["member"] = jnp.arange(settings.ensemble, dtype=jnp.int32)
    square = whitening.count(settings, dim_x) > 1
    basis = jnp.eye(dim_x) if square else jnp.zeros((dim_x, width)) if width < dim_x else None
    scales = {"x_mean": jnp.zeros(dim_x), "x_rate": jnp.ones(dim_x), "basis": basis}
    return {"params": params, **scales, "fits": jnp.asarray(0, jnp.int32), "identified": jnp.ones(d, bool)}


def init(key: Array, settings: InferenceSettings, space: Any, dim_x: int) -> FitState:
    """Fresh network for summaries of `dim_x` features and the parameters of `space`."""
    if dim_x < 1:
        raise UserError(f"dim_x = {dim_x}: a summary needs at least one feature")
    settings = settings.at(space)
    blank = _blank(key, settings, dim_x, len(space))
    return FitState(**blank, settings=settings, space=space)


def fit(
    key: Array,
    state: FitState,
    thetas: Array,
    x: Array,
    count: int | Array | None = None,
    proposals: Distribution | None = None,
    origin: Array | None = None,
    again: Again | None = None,
) -> tuple[FitState, FitInfo]:
    """Maximum likelihood on the first `count` rows of thetas [N, d] and x [N, D]; the rest is padding.

    Goes on from the weights in `state` with a fresh schedule. The weights with the best held-out score are kept, the
    starting ones included. Inputs keep the standardisation of the first fit, unless settings.restandardise. ValueError
    on wrong shapes or when no row is usable.

    Rows simulated from other proposals than the prior are corrected for (mdn.log_tilt): `proposals` are distributions
    with a leading axis R (proposal.stack), `origin` [N] says from which of them each row comes. The scores in the
    FitInfo are then means over held-out rows of all proposals.

    Args:
        key: consumed.
        state: of `init`, or of the fit before.
        thetas: [N, d] in the units of the parameters.
        x: [N, D] their summaries.
        count: how many of the rows there are; None: all. Traced, so that a growing data set does not recompile.
        proposals: what the rows were simulated from; None: the prior.
        origin: [N] the proposal of each row.
        again: further draws of the measurement noise of rows, of which training sees another one in every epoch; None:
            there are none. Scores are those of x.
    """
    count = thetas.shape[0] if count is None else count
    d, dim_x = len(state.space), state.x_mean.shape[0]
    if thetas.ndim != 2 or x.ndim != 2 or thetas.shape[1] != d or x.shape != (thetas.shape[0], dim_x):
        raise ValueError(f"need thetas [N, {d}] and x [N, {dim_x}], not {thetas.shape} and {x.shape}")
    if isinstance(count, int | np.integer) and not 1 <= count <= thetas.shape[0]:
        raise ValueError(f"count = {count}: the arrays hold {thetas.shape[0]} rows")
    if proposals is not None:
        _check_proposals(state, thetas, proposals, origin)
        origin = jnp.asarray(origin, jnp.int32)
    thetas, x = jnp.asarray(thetas, jnp.float32), jnp.asarray(x, jnp.float32)
    state, info = _fit(key, state, thetas, x, jnp.asarray(count, np.int32), proposals, origin, again)
    if not isinstance(info.n_train, jax.core.Tracer) and int(info.n_train) == 0:
        raise UserError(f"none of the {int(count)} rows is usable: summaries not finite, or thetas outside the box")
    return state, info


def _check_proposals(state: FitState, thetas: Array, proposals: Distribution, origin: Array | None) -> None:
    if origin is None or np.shape(origin) != (thetas.shape[0],):
        raise ValueError(
            f"proposals need origin [{thetas.shape[0]}], not {None if origin is None else np.shape(origin)}"
        )
    chart = state.settings.chart
    if chart == "logit" or proposals.chart != chart:
        raise ValueError(f"proposals in the {proposals.chart} chart, network in {chart}: both must be probit, or plain")


def condition(state: FitState, x: Array) -> Distribution:
    """Posterior of each summary x [n, D]: a Distribution whose leaves have the leading axis n (see its `split`)."""
    if x.ndim != 2 or x.shape[1] != state.x_mean.shape[0]:
        raise ValueError(f"need summaries [n, {state.x_mean.shape[0]}], not {x.shape}")
    return _condition(state, jnp.asarray(x, jnp.float32))


@jax.jit
def _condition(state: FitState, x: Array) -> Distribution:
    return ensemble.posteriors(state, state.inputs(x))


@program
def _fit(
    key: Array,
    state: FitState,
    thetas: Array,
    x: Array,
    count: Array,
    proposals: Distribution | None,
    origin: Array | None,
    again: Again | None = None,
) -> tuple[FitState, FitInfo]:
    settings = state.settings
    state, data, clipped, n_invalid = prepare(state, thetas, x, count, again)
    matrices = _bases(state, data)
    data = data._replace(
        proposals=proposals, origin=origin, x=jax.vmap(lambda m: rotated(data.x, m, settings.clip))(matrices)
    )
    member = partial(train, data=data, settings=settings, fresh=state.fits == 0)
    # it rises from member to member: most have little
    few = jnp.minimum(1.0, FEW / jnp.maximum(jnp.sum(data.train.astype(jnp.float32)), 1.0))
    rates = few * settings.dropout * jnp.linspace(0.0, 1.0, settings.ensemble)
    params, basis, best, steps, skipped, curves = jax.vmap(member, axis_name=MEMBERS)(
        jax.random.split(key, settings.ensemble), {**state.params, "sharpness": jnp.ones(settings.ensemble)}, rates
    )
    data = data._replace(x=data.x[basis[0], : len(data.train)])
    state = replace(state, basis=None if state.basis is None else matrices[basis[0]])
    members = ensemble.heads(params, data, settings)
    state = replace(state, params=ensemble.weigh(params, data, settings, members), fits=state.fits + 1)
    own = ensemble.parts_of(members, state.params)
    mixture = ensemble.joined(mdn.converted(own, settings), state.params["share"])
    marginals = ensemble.marginal_gain(mixture, data.y[data.held], settings)
    parameter_gain, identified = identify.identified(marginals, data.mask)
    state = replace(state, identified=identified)
    if proposals is None:  # else held-out truths are not from the prior, and lie elsewhere in their posteriors
        state = ensemble.as_deep(state, data, members)
        own = ensemble.parts_of(members, state.params)
        mixture = ensemble.joined(mdn.converted(own, settings), state.params["share"])
    scores = {"parameter_gain": parameter_gain, "clipped": clipped, "n_invalid": n_invalid}
    scores |= {"steps": steps[0], "best": jnp.max(best), "skipped": jnp.sum(skipped)}
    scores |= ensemble.truncated_scores(state, data, thetas, own, mixture)
    gain = ensemble.average(ensemble.held_out(own, state.params["share"], data, settings), data.mask)
    return state, _info(state, data, gain, curves, scores)


def _info(state: FitState, data: Data, gain: Array, curves: Array, scores: dict[str, Array]) -> FitInfo:
    """Collect the scores of a fit, from its curves [E, 2, P] and its mean log density of y."""
    # densities of y -> densities of u; the same for every weight
    volume = jnp.sum(jnp.where(data.train, data.slopes, 0.0)) / jnp.maximum(jnp.sum(data.train.astype(jnp.float32)), 1)
    held_volume = jnp.sum(data.slopes[data.held] * data.mask) / jnp.sum(data.mask)
    return FitInfo(
        train_loss=jnp.mean(curves[:, 0], axis=0) - volume,
        val_loss=jnp.mean(curves[:, 1], axis=0) - held_volume,
        gain=held_volume + gain,
        identified=state.identified,
        n_train=jnp.sum(data.train.astype(jnp.int32)),
        n_val=jnp.sum(data.mask).astype(jnp.int32),
        **scores,
    )


def _bases(state: FitState, data: Data) -> Array:
    """Make the matrices [M, D, inputs] that a first fit chooses from; later ones keep its choice.

    Of features that are standardised anew, regressions are made anew too: what their columns mean stays the same.
    """
    x, noise, (dim_x, d) = data.x[: len(data.train)], None, (data.x.shape[1], data.y.shape[1])
    if whitening.width(state.settings, dim_x, d) < dim_x:
        assert state.basis is not None
        found = whitening.regressed(x, data.y, data.train)[None]
        return found if state.settings.restandardise else jnp.where(state.fits == 0, found, state.basis)
    tried = whitening.count(state.settings, dim_x)
    if data.own is not None and tried > 1:  # rows measured at least twice
        again = data.x[len(x) :].reshape(data.draws - 1, -1, dim_x)[0][data.own]
        noise = whitening.noise_of(x, again, data.train & (data.own >= 0))
    found = whitening.candidates(x, data.y, data.train, tried, noise)
    if state.basis is None:
        return found
    kept = state.basis
    if tried > 2 and state.settings.restandardise:
        kept = jnp.where(whitening.is_padded(kept), found[-1], kept)
    return jnp.where(state.fits == 0, found, kept[None])


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
