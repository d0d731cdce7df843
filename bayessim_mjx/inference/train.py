"""Training of one member of the ensemble: where a first fit starts and in which basis, gradient steps, best weights."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.flatten_util import ravel_pytree

from bayessim_mjx.inference import densities, mdn
from bayessim_mjx.inference.densities import Params, density_of
from bayessim_mjx.inference.numbers import DEFENSIVE, NEGLIGIBLE
from bayessim_mjx.inference.settings import InferenceSettings
from bayessim_mjx.inference.state import Data
from bayessim_mjx.keys import GOLDEN
from bayessim_mjx.linalg import REGRESSED, inverse_lower, product, ridge

# factor on steps in the trials of bases: at the full rate whitening was once chosen on the damped pendulum, 6.2 nats
# for 7.3; at half none of six seeds did. source: benchmarks/history.md, posteriors
PACE = 0.5
MEMBERS = "members"  # axis of the ensemble


def schedule_length(settings: InferenceSettings, capacity: int) -> tuple[int, int]:
    """(points of the loss curve, gradient steps per point) for arrays of `capacity` rows."""
    per_epoch = -(-capacity // settings.batch)
    total = min(max(settings.epochs * per_epoch, settings.min_steps), settings.max_steps)
    # the losses are looked at once an epoch, and as often where the rows are few or the steps limited
    chunk = (
        max(1, min(per_epoch, total // settings.epochs)) if per_epoch > 1 else max(1, total // (2 * settings.epochs))
    )
    return -(-total // chunk), chunk


def objective(
    params: Any,
    rows: Array,
    data: Data,
    settings: InferenceSettings,
    drop: densities.Drop | None = None,
    x: Array | None = None,
) -> Array:
    """Compute the objective of training, per row: log q(theta | x), less the log of its integral under the proposal."""
    x = data.x[rows] if x is None else x
    return objective_of(mdn.forward(params, x, data.y.shape[-1], settings, drop), rows, data, settings)


def objective_of(heads: mdn.Heads, rows: Array, data: Data, settings: InferenceSettings) -> Array:
    """`objective` from what the network makes of the rows' summaries."""
    y = data.y[rows]
    if data.proposals is None or data.origin is None:
        return mdn.density(heads, y, settings)
    own = data.origin[rows]
    proposal = jax.tree.map(lambda leaf: leaf[own], data.proposals)
    return mdn.density(heads, y, settings) - mdn.log_tilt(heads, proposal, settings)


@dataclass(frozen=True)
class _Member:
    """Constant parts of all steps of a member's training.

    Its weights are one vector [W]: a few kernels per step instead of some for every layer.
    """

    data: Data
    settings: InferenceSettings
    rate: Array  # of dropout
    fixed: dict[str, Any]  # parameters that are not trained
    unravel: Callable[[Array], dict[str, Any]]  # [W] -> those that are
    optimiser: optax.GradientTransformation

    def objective(
        self, flat: Array, basis: Array, rows: Array, seen: Array, drop: densities.Drop | None = None
    ) -> Array:
        """Compute the objective of rows [B], by the summaries `seen` [B] of them."""
        params = {**self.unravel(flat), **self.fixed}
        return objective(params, rows, self.data, self.settings, drop, self.data.x[basis, seen])

    def loss(self, flat: Array, basis: Array, rows: Array, seen: Array, key: Array) -> Array:
        drop = (key, self.rate) if self.settings.ensemble > 1 and self.settings.dropout > 0 else None
        return -jnp.mean(self.objective(flat, basis, rows, seen, drop))

    def held_out(self, flat: Array, basis: Array) -> Array:
        value, mask = self.objective(flat, basis, self.data.held, self.data.held), self.data.mask
        return -jnp.sum(jnp.where(mask > 0, value, 0.0)) / jnp.sum(mask)

    def step(self, basis: Array, pace: Array, carry: tuple, inputs: tuple[Array, ...]) -> tuple[tuple, Array]:
        """One gradient step of (weights, optimiser's state, steps skipped) on (rows, summaries seen, key)."""
        flat, opt_state, skipped = carry
        value, gradient = jax.value_and_grad(self.loss)(flat, basis, *inputs)
        usable = jnp.isfinite(optax.global_norm(gradient))
        with jax.numpy_dtype_promotion("standard"):  # optax computes decay**count, a float to an int32
            updates, new_opt = self.optimiser.update(gradient, opt_state, flat)
        new = flat + pace * updates, new_opt
        flat, opt_state = jax.tree.map(lambda a, b: jnp.where(usable, a, b), new, (flat, opt_state))
        return (flat, opt_state, skipped + 1 - usable.astype(jnp.int32)), value

    def batches(self, key: Array, chunk: int) -> tuple[Array, Array, Array]:
        """Rows [chunk, batch], summaries seen and keys of as many steps: a fresh order of the rows trained on."""
        train = self.data.train
        batch = min(self.settings.batch, len(train))
        order = jnp.argsort(jnp.where(train, jax.random.uniform(key, train.shape), jnp.inf))
        count = jnp.maximum(jnp.sum(train.astype(jnp.int32)), 1)
        place = jnp.arange(chunk * batch, dtype=jnp.int32).reshape(chunk, batch)
        rows = order[place % count]
        # the next keys: those of other points of the curve are GOLDEN apart, and what drops units hashes its key
        keys = key[None, :] + jnp.arange(1, chunk + 1, dtype=key.dtype)[:, None]
        return rows, self.seen(rows, key[0] + (place // count).astype(key.dtype)), keys

    def seen(self, rows: Array, turn: Array) -> Array:
        """Places of the summaries of `rows` in x: each turn another draw of their noise, where there are several."""
        if self.data.own is None:
            return rows
        own, n, more = self.data.own[rows], len(self.data.train), self.data.draws - 1
        draw = ((turn + rows.astype(turn.dtype)) % np.uint32(more + 1)).astype(jnp.int32)
        apart = (self.data.x.shape[1] - n) // more
        return jnp.where((own < 0) | (draw == 0), rows, n + (draw - 1) * apart + own)


def train(
    key: Array, params: Any, rate: Array, data: Data, settings: InferenceSettings, fresh: Array
) -> tuple[Any, Array, Array, Array, Array, Array]:
    """One member: its best weights, their basis, where they were on the curve, steps taken and skipped, curves [2, P].

    In a first training each member tries another basis for a while, then all start anew in the best of them. It ends
    early if no member has beaten the best start, the linear-Gaussian posterior, in a tenth of it.

    Args:
        key: consumed.
        params: of this member.
        rate: of dropout.
        data: with summaries in each of the bases, x [M, N + K m, D]. Mapped over MEMBERS.
        fresh: whether this is the first fit.
    """
    rows, tried = len(data.train), data.x.shape[0]
    points, chunk = schedule_length(settings, rows)
    params = jax.vmap(lambda x: _start(params, data._replace(x=x), settings, fresh))(data.x[:, :rows])
    member, starts = _member(params, rate, data, settings, points * chunk)
    patience = max(1, round(DEFENSIVE * points))
    trial = patience if tried > 1 else 0
    values = jax.vmap(member.held_out)(starts, jnp.arange(tried, dtype=jnp.int32))

    def begin(basis: Array) -> tuple[tuple, tuple]:
        """Start of the training, and the best so far: held-out loss, weights, place on the curve."""
        flat, zero = starts[basis], jnp.asarray(0, jnp.int32)
        return (flat, member.optimiser.init(flat), zero), (values[basis], flat, zero - 1)

    def point(carry: tuple) -> tuple:
        i, _, basis, inner, best, curves = carry
        # the members' trials are over
        basis = jnp.where(i == 0, jnp.argmin(jax.lax.all_gather(best[0], MEMBERS)[:tried]), basis)
        inner, best = jax.tree.map(lambda a, b: jnp.where(i == 0, a, b), begin(basis), (inner, best))
        step = partial(member.step, basis, jnp.where(i < 0, PACE, 1.0))
        inner, losses = jax.lax.scan(step, inner, member.batches(key + (i + trial).astype(key.dtype) * GOLDEN, chunk))
        value = member.held_out(inner[0], basis)
        better = value < best[0]
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), (value, inner[0], i), best)
        curves = curves.at[:, jnp.maximum(i, 0)].set(jnp.stack([jnp.mean(losses), value]))
        beaten = jax.lax.pmin(best[0], MEMBERS) < jax.lax.pmin(values[basis], MEMBERS)
        return i + 1, ~fresh | beaten | (i + 1 < patience), basis, inner, best, curves

    basis = jax.lax.axis_index(MEMBERS) % tried
    first = jnp.where(fresh, -trial, 0)
    carry = (first, jnp.asarray(True), basis, *begin(basis), jnp.zeros((2, points)))
    done, _, basis, inner, best, curves = jax.lax.while_loop(lambda c: c[1] & (c[0] < points), point, carry)
    curves = curves[:, jnp.minimum(jnp.arange(points, dtype=jnp.int32), done - 1)]
    return {**member.unravel(best[1]), **member.fixed}, basis, best[2], done * chunk, inner[2], curves


def _member(params: Any, rate: Array, data: Data, settings: InferenceSettings, steps: int) -> tuple[_Member, Array]:
    """Make the parts of a training of so many steps, and its weights [M, W] by basis; params have leaves [M, ...]."""
    optimiser = optax.chain(
        optax.clip_by_global_norm(settings.grad_clip),
        optax.adamw(optax.cosine_decay_schedule(settings.lr, steps), weight_decay=settings.weight_decay),
    )
    fixed = {name: params[name][0] for name in mdn.fixed(settings)}
    trained = {name: leaf for name, leaf in params.items() if name not in fixed}
    unravel = ravel_pytree(jax.tree.map(lambda leaf: leaf[0], trained))[1]
    starts = jax.vmap(lambda tree: ravel_pytree(tree)[0])(trained)
    return _Member(data, settings, rate, fixed, unravel, optimiser), starts


def _start(params: Any, data: Data, settings: InferenceSettings, fresh: Array) -> Any:
    """Set the weights that training starts from: of a first fit, the linear-Gaussian posterior."""
    held = jnp.zeros_like(data.train).at[data.held].set(data.mask > 0)
    x, prepare, new = mdn.embedded(params, data.x, settings), densities.density_of(settings).prepare, params
    if prepare is not None:
        new = prepare(new, x, data.y, data.train, held, settings)
    new = linear_start(new, x, data.y, data.train.astype(jnp.float32), settings)
    return jax.tree.map(lambda a, b: jnp.where(fresh, a, b), new, params)


def linear_start(params: Params, x: Array, y: Array, weights: Array, settings: InferenceSettings) -> Params:
    """Set the linear path to the ridge regression of y [n, d] on x [n, D] and every component to its residuals.

    Training then starts at the best linear-Gaussian posterior instead of the prior; components keep their spread, in
    units of the residual sd. Features that do not change in training are regressed on too. No change beyond REGRESSED
    features, where the normal equations would cost more than they save.

    Args:
        params: of one member.
        x: [n, D] as the network takes them in.
        y: [n, d] in the network's coordinates.
        weights: [n] 1 for rows to use and 0 for the rest.
        settings: of the network.
    """
    (dim_x, d), k = (x.shape[1], y.shape[1]), settings.components
    regressed = density_of(settings).regressed
    design = jnp.concatenate([mdn.hidden(params, x, settings), x], axis=1) if regressed else x
    if design.shape[1] > REGRESSED or d == 0:
        return params
    mean, slope = ridge(design, y, weights)
    residual = (y - mean[None, :] - product(design, slope)) * weights[:, None]
    cov = product(residual.T, residual) / jnp.maximum(jnp.sum(weights), 1.0) + 1e-4 * jnp.eye(d)
    sd = jnp.sqrt(jnp.diagonal(cov))
    if mdn.bounded(settings):
        mean, slope, cov = _beyond_prior(mean, slope, cov)
    factor = inverse_lower(jnp.linalg.cholesky(cov))  # A^T A = cov^-1
    if not settings.fullCovariance:
        factor = jnp.diag(1.0 / jnp.sqrt(jnp.diagonal(cov)))
    last = params["layers"][-1]
    spread = last["b"][k : k + k * d].reshape(k, d)
    log_diagonal = 8 * jnp.arctanh(jnp.clip(jnp.log(jnp.diagonal(factor)) / 8, -0.99, 0.99))
    parts = [jnp.zeros(k), (mean[None, :] + spread * sd[None, :]).reshape(-1), jnp.tile(log_diagonal, k)]
    if settings.fullCovariance:
        parts.append(jnp.tile(factor[np.tril_indices(d, -1)], k))
    columns = jnp.tile(slope, (1, k))
    weight = last["w"]
    if regressed:
        weight = weight.at[:, k : k + k * d].add(columns[:-dim_x])
    skip = params["skip"].at[:, k : k + k * d].set(columns[-dim_x:])
    layers = [*params["layers"][:-1], {"w": weight, "b": jnp.concatenate(parts)}]
    return {**params, "layers": layers, "skip": skip}


def _beyond_prior(mean: Array, slope: Array, cov: Array) -> tuple[Array, Array, Array]:
    """Centre mu, its slope and (A^T A)^-1 of the component of precision I + A^T A with that posterior mean and cov."""
    values, vectors = jnp.linalg.eigh(cov)
    extra = jnp.maximum(1 / values - 1, NEGLIGIBLE)  # eigenvalues of A^T A
    stretch = product(vectors * ((1 + extra) / extra)[None, :], vectors.T)  # m = (I + A^T A)^-1 A^T A mu
    return stretch @ mean, product(slope, stretch), product(vectors / extra[None, :], vectors.T)
