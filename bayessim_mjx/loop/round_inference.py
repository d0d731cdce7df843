"""The inference of one round of the outer loop, and what it needs from round to round.

Simulated trajectories over the prior (or over the last posterior, see inference/rounds.py), a fit of
q(theta | summary), tests of it, and the product of the posteriors of all real trajectories so far.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx import inference
from bayessim_mjx.config.settings import summary_of
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import InferenceSettings, calibration, checks, misspecification, rounds
from bayessim_mjx.loop.sources import Source, domain_or_prior
from bayessim_mjx.loop.state import Loop, LoopState, RoundInfo
from bayessim_mjx.rl import Policy
from bayessim_mjx.rollout import Trajectory, select

CHUNK = 2500  # trajectories simulated at once while collecting
PREDICTIVE_DRAWS = 64
REFERENCE = 10000  # simulations that `reexamine` compares real trajectories with, at most
CLIPPED = 0.01  # share of clipped summary entries worth a warning
LOST = 0.05  # weight of a posterior that cannot be divided by the proposal worth a warning


def blank(loop: Loop) -> dict[str, Any]:
    """The inference's fields of a LoopState before the first round: no data, the prior as domain."""
    b, space, d = loop.settings, loop.env.space, len(loop.env.space)
    domain = domain_or_prior(space, b.components, loop.chart)
    infers = b.modelClass is not None
    capacity, real_rows = (loop.capacity, b.realIters * b.realTrajs) if infers else (0, 0)
    return {
        "domain": domain,
        "fit": _new_network(loop, 0) if infers else None,
        "thetas": jnp.zeros((capacity, d)),
        "features": jnp.zeros((capacity, loop.feature_size)),
        "real_features": jnp.zeros((real_rows, loop.feature_size)),
        "real_posteriors": _no_factors(loop, real_rows) if infers else None,
        **_no_proposals(loop),
        "temperature": jnp.float32(1.0),
    }


def _no_factors(loop: Loop, rows: int) -> Distribution:
    settings = InferenceSettings.of(loop.settings).at(loop.env.space)
    factor = Distribution.prior(loop.env.space, settings.components * settings.ensemble, settings.chart)
    return jax.tree.map(lambda leaf: jnp.zeros((rows, *leaf.shape)), factor)


def _no_proposals(loop: Loop) -> dict[str, Any]:
    if not loop.sequential:
        return {"proposal": None, "proposals": None}
    b = loop.settings
    prior = rounds.first(loop.env.space, b.proposal, b.components, loop.chart)
    return {"proposal": prior, "proposals": rounds.repeated(prior, max(1, loop.capacity // b.trainTrajs))}


def _new_network(loop: Loop, round_: int) -> Any:
    changing = loop.source is not None and loop.source.policy_dependent
    learned = summary_of(loop.settings.summarizerFxn)[0] == "summary_learned"
    embedding = loop.source.channels.embedding() if learned and loop.source is not None else None
    settings = InferenceSettings.of(loop.settings, restandardise=changing, embedding=embedding)
    return inference.init(jax.random.fold_in(loop.key(round_, "fit"), 1), settings, loop.env.space, loop.feature_size)


def _simulate(
    source: Source, key: Array, policy: Policy, proposal: Distribution, method: str, count: int
) -> tuple[Array, Array]:
    """`count` simulated trajectories: theta [count, d], features [count, D], in chunks that fit the memory."""
    chunks = -(-count // CHUNK)
    k_theta, k_roll = jax.random.split(key)
    thetas = rounds.draw(k_theta, proposal, method, -(-count // chunks) * chunks)
    features = _features(source, k_roll, thetas.reshape(chunks, -1, thetas.shape[-1]), policy)
    return thetas[:count], features[:count]


@functools.partial(jax.jit, static_argnums=0)
def _features(source: Source, key: Array, thetas: Array, policy: Policy) -> Array:
    """Features [chunks * n, D] of trajectories at thetas [chunks, n, d]."""
    keys = jax.random.split(key, thetas.shape[0])
    features = jax.lax.map(lambda at: source.simulate(at[0], at[1], policy), (keys, thetas))
    return features.reshape(-1, features.shape[-1])


def infer(loop: Loop, state: LoopState, policy: Policy, info: RoundInfo) -> LoopState:
    """A round's inference: simulate, fit, test, condition on all real trajectories; what was found goes into `info`."""
    b, source, round_ = loop.settings, loop.source, int(state.round)
    assert source is not None and state.domain is not None
    clock = time.perf_counter()
    state, fitted, held = _collect(loop, state, policy)
    jax.block_until_ready(fitted)
    info.seconds["simulate"] = time.perf_counter() - clock

    clock = time.perf_counter()
    known_before = np.asarray(state.fit.identified)
    state = _learn(loop, state, fitted, info)
    info.seconds["fit"] = time.perf_counter() - clock

    clock = time.perf_counter()
    seen = round_ * b.realTrajs
    real_features, real = source.real(loop.key(round_, "real"), seen, b.realTrajs, policy)
    state = dataclasses.replace(
        state, real_features=jax.lax.dynamic_update_slice(state.real_features, real_features, (seen, 0))
    )
    verdict = _examine(loop, state, fitted, held, info)
    widening = b.temperature or (verdict[0].temperature if verdict is not None else None) or 1.0
    state = dataclasses.replace(state, temperature=jnp.float32(widening))
    state = dataclasses.replace(state, real_posteriors=_factors(loop, state, info))
    posterior = _posterior(loop, state, info)
    info.warnings += _complaints(posterior.names, info.fit, known_before)
    info.posterior, info.real = posterior, jax.tree.map(np.asarray, real)
    info.scores = score(posterior, source.truth)
    domain = posterior
    if verdict is not None:
        info.checks = checks.conclude(*verdict, posterior, b.distrust)
        told = posterior.names if round_ else _unknown(posterior.names, info.fit)
        info.warnings += info.checks.warnings(told)
        domain = checks.guarded(posterior, info.checks.prior_share)
    info.predictive = _predict(loop, posterior, seen, real, loop.key(round_, "predict"))
    info.seconds["condition"] = time.perf_counter() - clock - info.seconds.get("check", 0.0)
    following = rounds.following(posterior, b.proposal) if loop.sequential else None
    return dataclasses.replace(state, domain=domain, proposal=following)


def _collect(
    loop: Loop, state: LoopState, policy: Policy
) -> tuple[LoopState, tuple[Array, Array, int], tuple[Array, Array]]:
    """Simulate this round's trajectories: (thetas, features, valid rows) to fit, and fresh pairs that test the fit."""
    b, round_ = loop.settings, int(state.round)
    # one program for what is fitted and what tests the fit
    thetas, x = _simulate(
        loop.source,  # type: ignore[arg-type]
        loop.key(round_, "simulate"),
        policy,
        _proposal(loop, state),
        b.proposal,
        b.trainTrajs + b.checkTrajs,
    )
    held, thetas, x = (thetas[b.trainTrajs :], x[b.trainTrajs :]), thetas[: b.trainTrajs], x[: b.trainTrajs]
    slot = round_ % max(1, loop.capacity // b.trainTrajs)
    if loop.sequential:
        assert state.proposals is not None and state.proposal is not None
        state = dataclasses.replace(state, proposals=rounds.stored(state.proposals, slot, state.proposal))
    if not loop.capacity:
        return state, (thetas, x, b.trainTrajs), held
    row, count = slot * b.trainTrajs, min((round_ + 1) * b.trainTrajs, loop.capacity)
    thetas = jax.lax.dynamic_update_slice(state.thetas, thetas, (row, 0))
    x = jax.lax.dynamic_update_slice(state.features, x, (row, 0))
    return dataclasses.replace(state, thetas=thetas, features=x), (thetas, x, count), held


def _proposal(loop: Loop, state: LoopState) -> Distribution:
    """What this round is simulated from."""
    return Distribution.prior(loop.env.space, loop.settings.components) if state.proposal is None else state.proposal


def _learn(loop: Loop, state: LoopState, fitted: tuple[Array, Array, int], info: RoundInfo) -> LoopState:
    """Fit the network, the one so far or a new one."""
    b, round_, (thetas, x, count) = loop.settings, int(state.round), fitted
    network = state.fit if b.ftune or round_ == 0 else _new_network(loop, round_)
    correction: dict[str, Any] = {}
    if b.proposal == "apt":
        correction = {"proposals": state.proposals, "origin": np.arange(len(thetas), dtype=np.int32) // b.trainTrajs}
    network, fit_info = inference.fit(loop.key(round_, "fit"), network, thetas, x, jnp.int32(count), **correction)
    info.fit = {name: np.asarray(value) for name, value in dataclasses.asdict(fit_info).items()}
    return dataclasses.replace(state, fit=network)


def _examine(
    loop: Loop, state: LoopState, fitted: tuple, held: tuple, info: RoundInfo
) -> tuple[calibration.Report, misspecification.Misfit] | None:
    """Calibration and misfit, or None where they are switched off or too few fresh simulations are usable."""
    clock, b, round_ = time.perf_counter(), loop.settings, int(state.round)
    if not b.checkTrajs:
        return None
    known = slice(round_ * b.realTrajs if loop.source.policy_dependent else 0, (round_ + 1) * b.realTrajs)  # type: ignore[union-attr]
    # what the network of this round is tested on comes from what it was simulated from
    tilt = (
        state.proposals and _at(state.proposals, round_ % state.proposals.logits.shape[0])
        if b.proposal == "apt"
        else None
    )
    key = jax.random.fold_in(loop.key(round_, "fit"), 2)
    try:
        return checks.examine(
            key, state.fit, fitted, held, state.real_features, known,
            temperature=b.temperature, tilt=tilt, names=loop.feature_names,
        )  # fmt: skip
    except UserError as error:
        info.warnings.append(str(error))
        return None
    finally:
        info.seconds["check"] = time.perf_counter() - clock


def _factors(loop: Loop, state: LoopState, info: RoundInfo) -> Distribution:
    """q(theta | x) of every real trajectory, leaves [real trajectories, ...]."""
    b, seen = loop.settings, int(state.round) * loop.settings.realTrajs
    factors = _conditioned(state.fit, state.real_features, state.temperature)
    if b.proposal == "division":
        assert state.proposals is not None
        rows = jax.tree.map(np.asarray, factors).split()
        done = seen + b.realTrajs
        quotients, lost = rounds.divided(rows[:done], _at(state.proposals, 0))
        factors = jax.tree.map(lambda *leaves: jnp.stack(leaves), *quotients, *rows[done:])
        if lost > LOST:
            info.warnings.append(f"{100 * lost:.0f} % of the posterior's weight cannot be divided by the proposal")
    factors = _kept(factors, state.fit.identified, b.priorShare)
    if not loop.source.policy_dependent:  # type: ignore[union-attr]
        return factors
    # an older trajectory was made by an older policy: its posterior stays that of the network of its time
    return select(jnp.arange(factors.logits.shape[0]) >= seen, factors, state.real_posteriors)


@jax.jit
def _conditioned(network: Any, features: Array, widening: Array) -> Distribution:
    return calibration.widened(inference.condition(network, features), widening)


@jax.jit
def _kept(factors: Distribution, identified: Array, prior_share: float) -> Distribution:
    """The prior where nothing is identified, and a share of it everywhere."""
    factors = jax.vmap(inference.restore_prior, in_axes=(0, None))(factors, identified)
    return dataclasses.replace(factors, prior_weight=jnp.full_like(factors.prior_weight, prior_share))


def _at(batch: Distribution, row: int) -> Distribution:
    return jax.tree.map(lambda leaf: leaf[row], batch)


def _posterior(loop: Loop, state: LoopState, info: RoundInfo) -> Distribution:
    """The product of the factors of all real trajectories so far."""
    b, known = loop.settings, (int(state.round) + 1) * loop.settings.realTrajs
    rows = jax.tree.map(
        np.asarray, state.real_posteriors
    ).split()  # on the host: an index on the device compiles each time
    usable = [row for row in rows[:known] if row.sound]
    if len(usable) < known:
        info.warnings.append(f"{known - len(usable)} real trajectories left out: their posteriors are no densities")
    if not usable:
        return Distribution.prior(loop.env.space, b.components, loop.chart)
    return inference.combine(usable, b.components).rechart(loop.chart)


def _complaints(names: tuple[str, ...], fit: dict[str, Any], known_before: np.ndarray) -> list[str]:
    """What a person should know about this round's fit."""
    texts, unknown = [], _unknown(names, fit)
    if unknown and not np.array_equal(fit["identified"], known_before):
        texts.append(f"not identified by these trajectories, kept at the prior: {', '.join(unknown)}")
    if fit["clipped"] > CLIPPED:
        texts.append(f"{100 * float(fit['clipped']):.1f} % of the summaries' entries lie beyond 10 sd and were clipped")
    if fit["n_invalid"] > 0:
        texts.append(f"{int(fit['n_invalid'])} simulated trajectories left out: their summaries are not finite")
    if fit["skipped"] > 0:
        texts.append(f"{int(fit['skipped'])} steps of the fit skipped: gradient not finite")
    return texts


def reexamine(loop: Loop, state: LoopState, policy: Policy, pairs: int, seed: int = 0) -> checks.Checks:
    """The checks of a round done again, on `pairs` fresh simulations and with a posterior predictive check.

    `state` is that after the round and `policy` the one that it was evaluated with, as in its checkpoint. The posterior
    is tested as the round used it: with its temperature, on parameters from what the round was simulated from.
    """
    b, source, done = loop.settings, loop.source, int(state.round)
    domain = state.domain
    assert source is not None and domain is not None
    key = jax.random.fold_in(jax.random.fold_in(jax.random.PRNGKey(seed), 0xCA11), done)  # seen by no fit
    known, last = min(b.trainTrajs, REFERENCE), max(1, loop.capacity // b.trainTrajs)
    used = None if state.proposals is None else _at(state.proposals, (done - 1) % last)
    state, temperature = dataclasses.replace(state, proposal=used), float(state.temperature)
    thetas, x = _simulate(source, jax.random.fold_in(key, 1), policy, _proposal(loop, state), b.proposal, known + pairs)
    held = thetas[known:], x[known:]
    rows = slice((done - 1) * b.realTrajs if source.policy_dependent else 0, done * b.realTrajs)
    judged: dict[str, Any] = {"temperature": temperature, "tilt": used if b.proposal == "apt" else None}
    verdict = checks.examine(
        key, state.fit, (thetas[:known], x[:known], known), held, state.real_features, rows,
        names=loop.feature_names, **judged,
    )  # fmt: skip
    again = checks.replicated(
        jax.random.fold_in(key, 2), state.fit, held[1], lambda k, t: source.simulate(k, t, policy), **judged
    )
    report = dataclasses.replace(verdict[0], predictive=again)
    return checks.conclude(report, verdict[1], domain, b.distrust)


def _unknown(names: tuple[str, ...], fit: dict[str, Any]) -> tuple[str, ...]:
    """Parameters that the fit gives back their prior."""
    return tuple(name for name, known in zip(names, fit["identified"], strict=True) if not known)


def score(domain: Distribution, truth: np.ndarray | None) -> dict[str, float]:
    """Log density of the truth where it is known, and per-parameter contraction against the prior."""
    contraction = np.asarray(domain.contraction())
    scores = {f"contraction/{name}": float(c) for name, c in zip(domain.space.names, contraction, strict=True)}
    if truth is not None:
        scores["log_p_truth"] = float(domain.log_prob(jnp.asarray(truth)))
        scores["gain_over_prior"] = float(domain.log_gain(jnp.asarray(truth)))
        scores["credible_level"] = float(domain.credible_level(jnp.asarray(truth)))
    return scores


def _predict(
    loop: Loop, domain: Distribution, first: int, real: Trajectory, key: Array
) -> dict[str, np.ndarray] | None:
    """Posterior predictive: the first real trajectory's commands replayed from its first state at posterior draws."""
    if getattr(loop.env, "physics", None) is None:
        return None
    assert loop.source is not None
    motion = loop.source.repeated(first, real, domain.sample(key, PREDICTIVE_DRAWS))
    return {name: np.asarray(value) for name, value in motion.items()}
