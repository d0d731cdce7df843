"""Training of the inference network in one jitted program, and conditioning it on measured summaries.

Arrays are padded to a capacity and the number of rows is traced: a growing data set does not recompile.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax import Array
from jax.flatten_util import ravel_pytree

from bayessim_mjx.distributions import Distribution, charts
from bayessim_mjx.distributions.storage import coordinates
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import coverage_factor, identify, mdn, whitening
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.linalg import product

GOLDEN = np.uint32(2654435769)  # 2^32 / golden ratio: spreads the validation rows evenly over any number of rows
SCORED = 256  # validation rows for which the truncated density is reported
CURVE = 40  # points of the loss curves, at least
SHARPNESS = np.geomspace(0.35, 4.0, 21).astype(np.float32)  # of the parts, tried on the held-out rows
LADDER = 1  # power of the members' places that their dropout rises with
PACE = 0.5  # of steps in these trials: at the full rate a basis was once judged by how it shook (damped pendulum)
FEW = 3000  # rows up to which dropout is as set; with more it falls in proportion: many need none
TRIED = 150  # gradient steps at least (and a fortieth) that bases are tried for, and before a training may end early
MEMBERS = "members"  # axis of the ensemble
WORTH = 2.0  # nats, over all held-out rows, that another choice of a part has to gain: with few rows the best is luck
CLIMBS, SWEEPS = 50, 2  # steps towards the parts' weights; rounds of choosing them


@struct.dataclass
class FitState:
    """What the next fit needs: weights and the standardisation of the inputs. Arrays only, but for the two settings."""

    params: Any  # of all members of the ensemble: leaves [E, ...]
    x_mean: Array  # [D]
    x_rate: Array  # [D] 1 / sd of the first fit's data; 0 drops a constant column
    basis: Array | None  # [D, D] what standardised inputs are multiplied by; None: nothing
    fits: Array  # [] int32, fits done so far
    identified: Array  # [d] bool, parameters whose marginal beats the prior on the last fit's held-out rows
    settings: InferenceSettings = struct.field(pytree_node=False)
    space: Any = struct.field(pytree_node=False)

    @property
    def coordinates(self) -> dict[str, Any]:
        """What the network's outputs mean, as of a `Distribution`."""
        return coordinates(self.space, self.settings.chart)

    def inputs(self, x: Array) -> Array:
        """Summaries x [n, D] as the network takes them in [n, D]."""
        z = _standardise(x, self.x_mean, self.x_rate, self.settings.clip)[0]
        return z if self.basis is None else _rotated(z, self.basis, self.settings.clip)


@struct.dataclass
class FitInfo:
    """What a person wants to see. Scores are means over held-out rows, in nats."""

    train_loss: Array  # [E] negative log density relative to the prior
    val_loss: Array  # [E], both are means over the ensemble
    steps: Array  # [] gradient steps taken
    best: Array  # [] index into the curves of the weights kept (the latest of the ensemble); -1: those before this fit
    gain: Array  # [] log q(theta | x) - log p(theta), density not truncated (but in truncated coordinates)
    gain_truncated: Array  # [] the same for the truncated density, over the first 256 held-out rows
    log_q: Array  # [] truncated log density in theta units: gain_truncated + log p(theta)
    inside: Array  # [] mean mass of the untruncated mixture inside the box
    parameter_gain: Array  # [d] the same for each parameter's marginal by itself
    identified: Array  # [d] bool: that gain is significant and relevant
    clipped: Array  # [] share of input entries clipped
    n_train: Array  # []
    n_val: Array  # []
    n_invalid: Array  # [] rows left out: not finite, or theta outside the box
    skipped: Array  # [] steps left out because the gradient was not finite


class _Data(NamedTuple):
    x: Array  # [N, D] as the network takes them in; in training [M, N, D] in each of the bases
    y: Array  # [N, d]
    slopes: Array  # [N] log density of u = log density of y + this
    train: Array  # [N] bool
    held: Array  # [V] indices of held-out rows, padded
    mask: Array  # [V] float32
    origin: Array | None  # [N] the proposal each row was simulated from
    proposals: Distribution | None  # leaves [R, ...]


@partial(jax.jit, static_argnums=(1, 2, 3))
def _weights(key: Array, settings: InferenceSettings, dim_x: int, d: int) -> Any:
    """Of the whole ensemble, `[M, ...]`."""
    counts = jnp.asarray(mdn.counts(settings))
    return jax.vmap(lambda k, count: mdn.init(k, settings, dim_x, d, count))(
        jax.random.split(key, settings.ensemble), counts
    )


def init(key: Array, settings: InferenceSettings, space: Any, dim_x: int) -> FitState:
    """Fresh network for summaries of `dim_x` features and the parameters of `space`."""
    if dim_x < 1:
        raise UserError(f"dim_x = {dim_x}: a summary needs at least one feature")
    settings = settings.at(space)
    params = _weights(key, settings, dim_x, len(space))
    known, fits = jnp.ones(len(space), bool), jnp.asarray(0, jnp.int32)
    basis = jnp.eye(dim_x) if whitening.count(settings, dim_x) > 1 else None
    params["member"] = jnp.arange(settings.ensemble, dtype=jnp.int32)
    return FitState(params, jnp.zeros(dim_x), jnp.ones(dim_x), basis, fits, known, settings, space)


def fit(
    key: Array,
    state: FitState,
    thetas: Array,
    x: Array,
    count: int | Array | None = None,
    proposals: Distribution | None = None,
    origin: Array | None = None,
) -> tuple[FitState, FitInfo]:
    """Maximum likelihood on the first `count` rows of thetas [N, d] and x [N, D]; the rest is padding.

    Goes on from the weights in `state` with a fresh schedule. The weights with the best held-out score are kept, the
    starting ones included. Inputs keep the standardisation of the first fit, unless settings.restandardise. ValueError
    on wrong shapes or when no row is usable.

    Rows simulated from other proposals than the prior are corrected for (mdn.log_tilt): `proposals` are distributions
    with a leading axis R (proposal.stack), `origin` [N] says from which of them each row comes. The scores in the
    FitInfo are then means over held-out rows of all proposals.
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
    state, info = _fit(key, state, thetas, x, jnp.asarray(count, jnp.int32), proposals, origin)
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
    return _posteriors(state, state.inputs(x))


def _posteriors(state: FitState, z: Array) -> Distribution:
    """The network's inputs [n, D] -> batched Distribution, a trace of the prior mixed in."""
    build = partial(
        Distribution.from_unit, state.space, prior_weight=state.settings.defensive, chart=state.settings.chart
    )
    return jax.vmap(build)(*_mixtures(state, z))


def _mixtures(state: FitState, z: Array) -> tuple[Array, Array, Array]:
    """Log weights [n, E K], means and factors of the ensemble's mixture."""
    d, settings = len(state.space), state.settings
    logits, *others = jax.vmap(lambda params: mdn.mixture(params, z, d, settings))(_parts(state.params))
    leaves = logits + state.params["share"][:, None, None], *others
    joined = [jnp.moveaxis(leaf, 0, 1).reshape(z.shape[0], -1, *leaf.shape[3:]) for leaf in leaves]
    return joined[0], joined[1], joined[2]


def _parts(params: Any) -> Any:
    """The networks of the mixture's parts [E, ...]: a member may be several of them, more or less sharp, or none."""
    own = {name: params[name] for name in ("sharpness", "share", "member")}
    return {**jax.tree.map(lambda leaf: leaf[params["member"]], params), **own}


def schedule_length(settings: InferenceSettings, capacity: int) -> tuple[int, int]:
    """(points of the loss curve, gradient steps per point) for arrays of `capacity` rows."""
    per_epoch = -(-capacity // settings.batch)
    total = min(max(settings.epochs * per_epoch, settings.min_steps), settings.max_steps)
    chunk = max(1, min(per_epoch, total // CURVE)) if per_epoch > 1 else max(1, total // (2 * CURVE))
    return -(-total // chunk), chunk


@jax.jit
def _fit(
    key: Array,
    state: FitState,
    thetas: Array,
    x: Array,
    count: Array,
    proposals: Distribution | None,
    origin: Array | None,
) -> tuple[FitState, FitInfo]:
    settings = state.settings
    state, data, clipped, n_invalid = _prepare(state, thetas, x, count)
    matrices = _bases(state, data)
    data = data._replace(
        proposals=proposals, origin=origin, x=jax.vmap(lambda m: _rotated(data.x, m, settings.clip))(matrices)
    )
    member = partial(_train, data=data, settings=settings, fresh=state.fits == 0)
    # most members have little dropout
    few = jnp.minimum(1.0, FEW / jnp.maximum(jnp.sum(data.train.astype(jnp.float32)), 1.0))
    rates = few * settings.dropout * jnp.linspace(0.0, 1.0, settings.ensemble) ** LADDER
    params, basis, best, steps, skipped, curves = jax.vmap(member, axis_name=MEMBERS)(
        jax.random.split(key, settings.ensemble), {**state.params, "sharpness": jnp.ones(settings.ensemble)}, rates
    )
    data = data._replace(x=data.x[basis[0]])
    state = replace(state, basis=None if state.basis is None else matrices[basis[0]])
    state = replace(state, params=_weigh(params, data, settings), fits=state.fits + 1)
    if proposals is None:  # else held-out truths are not from the prior, and lie elsewhere in their posteriors
        state = _as_deep(state, data)
    marginals = _marginal_gain(_mixtures(state, data.x[data.held]), data.y[data.held], settings)
    parameter_gain, identified = identify.identified(marginals, data.mask)
    state = replace(state, identified=identified)
    # densities of y -> densities of u; the same for every weight
    volume = jnp.sum(jnp.where(data.train, data.slopes, 0.0)) / jnp.maximum(jnp.sum(data.train.astype(jnp.float32)), 1)
    held_volume = jnp.sum(data.slopes[data.held] * data.mask) / jnp.sum(data.mask)
    info = FitInfo(
        train_loss=jnp.mean(curves[:, 0], axis=0) - volume,
        val_loss=jnp.mean(curves[:, 1], axis=0) - held_volume,
        steps=steps[0],
        best=jnp.max(best),
        gain=held_volume + _held_out_gain(state, data),
        **_truncated_scores(state, data, thetas),
        parameter_gain=parameter_gain,
        identified=identified,
        clipped=clipped,
        n_train=jnp.sum(data.train.astype(jnp.int32)),
        n_val=jnp.sum(data.mask).astype(jnp.int32),
        n_invalid=n_invalid,
        skipped=jnp.sum(skipped),
    )
    return state, info


def _bases(state: FitState, data: _Data) -> Array:
    """The matrices [M, D, D] that a first fit chooses from; later ones keep its choice."""
    found = whitening.candidates(data.x, data.train, whitening.count(state.settings, data.x.shape[1]))
    return found if state.basis is None else jnp.where(state.fits == 0, found, state.basis[None])


def _train(
    key: Array, params: Any, rate: Array, data: _Data, settings: InferenceSettings, fresh: Array
) -> tuple[Any, Array, Array, Array, Array, Array]:
    """One member: its best weights, their basis, where they were on the curve, steps taken and skipped, curves [2, P].

    In a first training each member tries another basis for a while, then all start anew in the best of them. It ends
    early if no member has beaten the best start, the linear-Gaussian posterior, in a fortieth of it.
    """
    (points, chunk), tried = schedule_length(settings, data.x.shape[1]), data.x.shape[0]
    optimiser = optax.chain(
        optax.clip_by_global_norm(settings.grad_clip),
        optax.adamw(optax.cosine_decay_schedule(settings.lr, points * chunk), weight_decay=settings.weight_decay),
    )
    n_train = jnp.sum(data.train.astype(jnp.int32))
    batch = min(settings.batch, data.x.shape[1])
    params = jax.vmap(lambda x: _fresh(params, data._replace(x=x), settings, fresh))(data.x)
    fixed = {name: params[name][0] for name in mdn.FIXED if name in params}
    trained = {name: leaf for name, leaf in params.items() if name not in fixed}
    unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], trained))[1]
    # one vector of weights: a few kernels per step instead of some for every layer
    starts = jax.vmap(lambda tree: ravel_pytree(tree)[0])(trained)

    def objective(flat: Array, basis: Array, rows: Array, drop: mdn.Drop | None = None) -> Array:
        return _objective({**unravel(flat), **fixed}, rows, data, settings, drop, data.x[basis, rows])

    def loss(flat: Array, basis: Array, rows: Array, key: Array) -> Array:
        drop = (key, rate) if settings.ensemble > 1 and settings.dropout > 0 else None
        return -jnp.mean(objective(flat, basis, rows, drop))

    def held_out(flat: Array, basis: Array) -> Array:
        value = objective(flat, basis, data.held)
        return -jnp.sum(jnp.where(data.mask > 0, value, 0.0)) / jnp.sum(data.mask)

    def step(basis: Array, pace: Array, carry: tuple, inputs: tuple[Array, Array]) -> tuple[tuple, Array]:
        flat, opt_state, skipped = carry
        value, gradient = jax.value_and_grad(loss)(flat, basis, *inputs)
        usable = jnp.isfinite(optax.global_norm(gradient))
        with jax.numpy_dtype_promotion("standard"):  # optax computes decay**count, a float to an int32
            updates, new_opt = optimiser.update(gradient, opt_state, flat)
        new = flat + pace * updates, new_opt
        flat, opt_state = jax.tree.map(lambda a, b: jnp.where(usable, a, b), new, (flat, opt_state))
        return (flat, opt_state, skipped + 1 - usable.astype(jnp.int32)), value

    def begin(basis: Array) -> tuple[tuple, tuple]:
        """What is trained, and the best so far: held-out loss, weights, place on the curve."""
        flat = starts[basis]
        zero = jnp.asarray(0, jnp.int32)
        return (flat, optimiser.init(flat), zero), (values[basis], flat, zero - 1)

    def point(carry: tuple) -> tuple:
        i, _, basis, inner, best, curves = carry
        # the members' trials are over
        basis = jnp.where(i == 0, jnp.argmin(jax.lax.all_gather(best[0], MEMBERS)[:tried]), basis)
        inner, best = jax.tree.map(lambda a, b: jnp.where(i == 0, a, b), begin(basis), (inner, best))
        key = keys[i + trial]
        # a fresh order of the training rows; batches walk through it and wrap around
        order = jnp.argsort(jnp.where(data.train, jax.random.uniform(key, data.train.shape), jnp.inf))
        place = jnp.arange(chunk * batch, dtype=jnp.int32).reshape(chunk, batch) % jnp.maximum(n_train, 1)
        rows = order[place], jax.random.split(jax.random.fold_in(key, 1), chunk)
        inner, losses = jax.lax.scan(partial(step, basis, jnp.where(i < 0, PACE, 1.0)), inner, rows)
        value = held_out(inner[0], basis)
        better = value < best[0]
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), (value, inner[0], i), best)
        curves = curves.at[:, jnp.maximum(i, 0)].set(jnp.stack([jnp.mean(losses), value]))
        beaten = jax.lax.pmin(best[0], MEMBERS) < jax.lax.pmin(values[basis], MEMBERS)
        return i + 1, ~fresh | beaten | (i + 1 < patience), basis, inner, best, curves

    patience = max(points // 40, -(-TRIED // chunk))
    trial = patience if tried > 1 else 0
    keys = jax.random.split(key, trial + points)
    values = jax.vmap(held_out)(starts, jnp.arange(tried, dtype=jnp.int32))
    basis = jax.lax.axis_index(MEMBERS) % tried
    first = jnp.where(fresh, -trial, 0)
    carry = (first, jnp.asarray(True), basis, *begin(basis), jnp.zeros((2, points)))
    done, _, basis, inner, best, curves = jax.lax.while_loop(lambda c: c[1] & (c[0] < points), point, carry)
    curves = curves[:, jnp.minimum(jnp.arange(points, dtype=jnp.int32), done - 1)]
    return {**unravel(best[1]), **fixed}, basis, best[2], done * chunk, inner[2], curves


def _fresh(params: Any, data: _Data, settings: InferenceSettings, fresh: Array) -> Any:
    """The weights that training starts from: of a first fit, the linear-Gaussian posterior."""
    held = jnp.zeros_like(data.train).at[data.held].set(data.mask > 0)
    x = mdn.embedded(params, data.x, settings)
    new = mdn.choose_bandwidth(params, x, data.y, data.train, held, settings)
    new = mdn.linear_start(new, x, data.y, data.train.astype(jnp.float32), settings)
    return jax.tree.map(lambda a, b: jnp.where(fresh, a, b), new, params)


def _weigh(params: Any, data: _Data, settings: InferenceSettings) -> Any:
    """The mixture's parts, as many as members: whose network each is, how sharp, its weight; by the held-out density.

    Networks that disagree make a mixture that is wider than it need be, a single one is narrower than it may be; and
    where a network is far better in some places than in others, itself sharper and itself wider make the peak and the
    tails of a posterior that holds as often as it says.
    """
    score = partial(_objective, rows=data.held, data=data, settings=settings)

    def scores(sharpness: Array) -> Array:
        density = jax.vmap(lambda p: score({**p, "sharpness": sharpness}))(params)
        return jnp.where(data.mask[None, :] > 0, jnp.maximum(density, -1e6), 0.0)  # [E, V]

    table = jax.lax.map(scores, jnp.asarray(SHARPNESS))  # [S, E, V]
    table = table.reshape(-1, table.shape[-1])
    everyone = jnp.arange(len(table), dtype=jnp.int32)

    def mixed(choice: Array, share: Array, climbs: int) -> tuple[Array, Array]:
        """Log weights [E], climbing from `share`, and total log density of the parts `choice` [E]."""
        density = table[choice]

        def climb(share: Array, _: None) -> tuple[Array, None]:
            # expectation maximisation; one row's worth of every part for few rows
            mine = jax.nn.softmax(density + share[:, None], axis=0) @ data.mask + 1.0
            return jnp.log(mine) - jnp.log(jnp.sum(mine)), None

        share, _ = jax.lax.scan(climb, share, length=climbs)
        return share, data.mask @ jax.nn.logsumexp(density + share[:, None], axis=0)

    def improve(carry: tuple[Array, Array], part: Array) -> tuple[tuple[Array, Array], None]:
        """The best for one part, the others held."""
        choice, share = carry
        tries = jnp.where(jnp.arange(settings.ensemble) == part, everyone[:, None], choice[None, :])
        shares, values = jax.vmap(lambda t: mixed(t, share, CLIMBS // 4))(tries)
        best = jnp.nanargmax(jnp.where(everyone == choice[part], values + WORTH, values))
        return (tries[best], shares[best]), None

    # each member at its best at first
    alone = (table @ data.mask).reshape(len(SHARPNESS), settings.ensemble)
    members = jnp.arange(settings.ensemble, dtype=jnp.int32)
    first = jnp.nanargmax(alone, axis=0).astype(jnp.int32) * settings.ensemble + members
    turns = jnp.tile(members, SWEEPS)
    alike = jnp.full(settings.ensemble, np.float32(-np.log(settings.ensemble)))
    (choice, share), _ = jax.lax.scan(improve, (first, mixed(first, alike, CLIMBS)[0]), turns)
    sharpness, member = jnp.asarray(SHARPNESS)[choice // settings.ensemble], choice % settings.ensemble
    return {**params, "sharpness": sharpness, "member": member, "share": mixed(choice, share, CLIMBS)[0]}


def _as_deep(state: FitState, data: _Data) -> FitState:
    """All parts sharper or wider by one factor, so that held-out truths lie as deep in their posteriors as they should.

    The weights and sharpnesses of the best density leave them too wide where errors have long tails, as most are then
    smaller than it says: 62 % of truths in the 50 % regions of BayesSimIG's data.
    """
    rows = data.held[: coverage_factor.MOST]
    centre, sd = (np.float32(v) for v in charts.SCORE[state.settings.chart])

    def at(factor: Array) -> tuple[Array, Array, Array]:
        params = {**state.params, "sharpness": state.params["sharpness"] * factor}
        return _mixtures(replace(state, params=params), data.x[rows])

    mask = data.mask[: coverage_factor.MOST]
    # the same draws in every fit: weights that are kept keep their factor
    factor = coverage_factor.factor(jax.random.PRNGKey(0), at, data.y[rows] * sd + centre, mask, state.settings.chart)
    return replace(state, params={**state.params, "sharpness": state.params["sharpness"] * factor})


def _objective(
    params: Any,
    rows: Array,
    data: _Data,
    settings: InferenceSettings,
    drop: mdn.Drop | None = None,
    x: Array | None = None,
) -> Array:
    """What training maximises, per row: log q(theta | x), less the log of what the proposal makes of it."""
    x, y = data.x[rows] if x is None else x, data.y[rows]
    heads = mdn.forward(params, x, y.shape[-1], settings, drop)
    if data.proposals is None or data.origin is None:
        return mdn.density(heads, y, settings)
    own = data.origin[rows]
    proposal = jax.tree.map(lambda leaf: leaf[own], data.proposals)
    return mdn.density(heads, y, settings) - mdn.log_tilt(heads, proposal, settings)


def _prepare(state: FitState, thetas: Array, x: Array, count: Array) -> tuple[FitState, _Data, Array, Array]:
    """Mask, standardise and split. The split depends on the row number only, so it survives from fit to fit."""
    rows = jnp.arange(x.shape[0], dtype=jnp.int32)
    given = rows < count
    valid = given & jnp.all(jnp.isfinite(x), axis=1) & jax.vmap(state.space.contains)(thetas)
    nominal = jnp.asarray(state.space.nominal)[None, :]
    u = jnp.clip(jax.vmap(state.space.to_unit)(jnp.where(valid[:, None], thetas, nominal)), 0, 1)
    x = jnp.where(valid[:, None], x, 0.0)
    embedding = state.settings.embedding
    mean, rate = _column_scales(x, valid) if embedding is None else embedding.scales(x, valid)
    fresh = (state.fits == 0) | state.settings.restandardise
    mean, rate = jnp.where(fresh, mean, state.x_mean), jnp.where(fresh, rate, state.x_rate)
    z, clipped = _standardise(x, mean, rate, state.settings.clip)

    share = np.uint32(round(state.settings.validation * 2**32))
    held = valid & (rows.astype(jnp.uint32) * GOLDEN < share)
    held = jnp.where(jnp.any(held), held, valid)  # a handful of rows: better to validate on them than not at all
    room = min(x.shape[0], int(state.settings.validation * x.shape[0]) + 8, 4096)
    order = jnp.argsort(~held)[:room]
    train = jnp.where(jnp.any(valid & ~held), valid & ~held, valid)
    y = mdn.to_y(u, state.settings.chart)
    slopes = mdn.log_volume(y, state.settings.chart)
    data = _Data(z, y, slopes, train, order, held[order].astype(jnp.float32), None, None)
    n_invalid = jnp.sum((given & ~valid).astype(jnp.int32))
    entries = jnp.maximum(jnp.sum(valid.astype(jnp.float32)), 1.0) * x.shape[1]
    share_clipped = jnp.sum(jnp.where(valid[:, None], clipped, 0.0)) / entries
    return replace(state, x_mean=mean, x_rate=rate), data, share_clipped, n_invalid


def _column_scales(x: Array, valid: Array) -> tuple[Array, Array]:
    """Mean and 1 / sd per column over the valid rows; 0 where a column does not vary beyond rounding."""
    n = jnp.maximum(jnp.sum(valid.astype(jnp.float32)), 1.0)
    mean = jnp.sum(x, axis=0) / n
    deviation = jnp.where(valid[:, None], x - mean[None, :], 0.0)
    sd = jnp.sqrt(jnp.sum(deviation**2, axis=0) / n)
    varies = sd > 1e-5 * jnp.abs(mean) + 1e-12
    return mean, jnp.where(varies, 1.0 / jnp.where(varies, sd, 1.0), 0.0)


def _standardise(x: Array, mean: Array, rate: Array, clip: float) -> tuple[Array, Array]:
    z = (x - mean[None, :]) * rate[None, :]
    return jnp.clip(z, -clip, clip), (jnp.abs(z) > clip).astype(jnp.float32)


def _rotated(z: Array, basis: Array, clip: float) -> Array:
    return jnp.clip(product(z, basis), -clip, clip)


def _held_out_gain(state: FitState, data: _Data) -> Array:
    """Mean log density of y of the ensemble's mixture over the held-out rows."""
    value = jax.vmap(lambda params: _objective(params, data.held, data, state.settings))(_parts(state.params))
    value = jax.nn.logsumexp(value + state.params["share"][:, None], axis=0)
    return jnp.sum(jnp.where(data.mask > 0, value, 0.0)) / jnp.sum(data.mask)


def _marginal_gain(mixtures: tuple[Array, Array, Array], y: Array, settings: InferenceSettings) -> Array:
    """log marginal density of each parameter relative to its prior at y [n, d] -> [n, d]."""
    centre, sd = (np.float32(v) for v in charts.SCORE[settings.chart])
    z = y * sd + centre
    if settings.chart == "plain":
        return identify.marginal_gain(*mixtures, z)
    logits, means, scales = mixtures
    spread = jnp.sqrt(jnp.sum(scales**2, axis=-1))  # [n, K, d]
    density = jax.scipy.stats.norm.logpdf((z[:, None, :] - means) / spread) - jnp.log(spread)
    marginal = jax.nn.logsumexp(jax.nn.log_softmax(logits)[:, :, None] + density, axis=1)
    return marginal + charts.log_slope(z[..., None], settings.chart)


def _truncated_scores(state: FitState, data: _Data, thetas: Array) -> dict[str, Array]:
    rows, mask = data.held[:SCORED], data.mask[:SCORED]
    posterior = _posteriors(state, data.x[rows])
    truth = jnp.where(mask[:, None] > 0, thetas[rows], jnp.asarray(state.space.nominal)[None, :])
    gain = jax.vmap(lambda q, theta: q.log_gain(theta))(posterior, truth)
    prior = jax.vmap(state.space.log_prior)(truth)

    def average(value: Array) -> Array:
        return jnp.sum(jnp.where(mask > 0, value, 0.0)) / jnp.sum(mask)

    scores = {"gain_truncated": average(gain), "log_q": average(gain + prior)}
    return {**scores, "inside": average(jnp.exp(posterior.log_inside))}
