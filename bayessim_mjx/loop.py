"""The outer loop: train on physics drawn from the domain, try the policy on the real side, infer a sharper domain.

One round (BayesSimIG's order): PPO under the current domain; evaluation on the surrogate real; simulated trajectories
over the *prior* and a fit of q(theta | summary); the real trajectories so far, multiplied, give the next domain.
Simulating from the prior needs no proposal correction. All of a round runs on the device.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx import inference, rl
from bayessim_mjx.collection import Recorded, Source, domain_or_prior, make_source
from bayessim_mjx.config import BayesSimConfig, Config
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.env import Env
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import calibration, checks, misspecification
from bayessim_mjx.rl import Policy, TrainState
from bayessim_mjx.rollout import Trajectory, replay, select

CHUNK = 2500  # trajectories simulated at once while collecting
KEPT_ROUNDS = 4  # rounds of simulated trajectories kept for the fit where the collection policy does not change
PREDICTIVE_DRAWS = 64
REFERENCE = 10000  # simulations that `reexamine` compares real trajectories with, at most
CLIPPED = 0.01  # share of clipped summary entries worth a warning


@flax.struct.dataclass
class LoopState:
    """All that the next round needs, as arrays: it is the checkpoint."""

    round: Array  # int32, rounds finished
    train: TrainState
    domain: Distribution | None  # what physics is drawn from
    fit: Any  # FitState of the inference network; None for the uniform ablation
    thetas: Array  # [kept rounds * trainTrajs, d] simulated parameters; none where every round uses its own alone
    features: Array  # [capacity, D] and their summaries
    real_features: Array  # [realIters * realTrajs, D], the first round * realTrajs rows are filled
    real_posteriors: Distribution | None  # q(theta | x) of each real trajectory at the time it was seen


@dataclasses.dataclass
class RoundInfo:
    """What a person wants to see of a round; numbers on the host."""

    round: int
    rounds: int
    domain: Distribution | None  # what this round trained on
    posterior: Distribution | None  # what it inferred
    truth: np.ndarray | None
    returns: np.ndarray  # [n] on the real side (surrogate) or under the domain (logs)
    lengths: np.ndarray
    real: Trajectory | None  # this round's real trajectories
    predictive: dict[str, np.ndarray] | None  # qpos [n, T+1, nq], qvel: the first one, re-simulated
    fit: dict[str, Any]
    scores: dict[str, float]  # log p(truth), gain over the prior, credible level, contraction per parameter
    seconds: dict[str, float]
    warnings: list[str]
    checks: checks.Checks | None = None  # calibration, misfit, walls; None: none asked for


class Monitor(Protocol):
    """What the loop tells while it runs; every method may do nothing."""

    def training(self, round_: int, metrics: dict[str, float], state: LoopState) -> None: ...
    def round(self, info: RoundInfo, policy: Policy) -> None: ...


class Checkpoints(Protocol):
    def save(
        self,
        step: int,
        tree: Any,
        *,
        evaluation: float | None = None,
        meta: dict | None = None,
        supersede: bool = False,
    ) -> Any: ...


@dataclasses.dataclass(frozen=True, eq=False)
class Loop:
    """The parts that do not move."""

    env: Env
    config: Config
    source: Source | None
    feature_size: int

    @property
    def settings(self) -> BayesSimConfig:
        return self.config.bayessim

    @property
    def capacity(self) -> int:
        """Rows of simulated trajectories kept from round to round; 0: a round's own are fitted and dropped."""
        b = self.settings
        keeps = b.ftune and self.source is not None and not self.source.policy_dependent
        return b.trainTrajs * min(b.realIters, KEPT_ROUNDS) if keeps else 0

    def key(self, round_: int, purpose: str) -> Array:
        """Every random draw has its own key, a function of the seed alone: a resumed run draws the same."""
        purposes = ("init", "train", "evaluate", "simulate", "fit", "real", "predict")
        return jax.random.fold_in(
            jax.random.PRNGKey(self.config.seed), round_ * len(purposes) + purposes.index(purpose)
        )


def make(config: Config, env: Env) -> Loop:
    """Build the loop's static parts; refuses configurations that cannot work."""
    b = config.bayessim
    if b.modelClass is None:
        # The ablation infers nothing, but is scored on the same surrogate.
        source = make_source(config, env) if len(env.space) else None
        return Loop(env, config, source, 0)
    if not len(env.space):
        raise UserError(
            f"task {env.name!r} has no parameters to infer: name some under task.randomization_params, "
            "or set bayessim.modelClass=None to train without inference"
        )
    source = make_source(config, env)
    if isinstance(source, Recorded) and source.supply is not None and source.supply < b.realTrajs * b.realIters:
        rounds = source.supply // b.realTrajs
        raise UserError(
            f"real.logs hold {source.supply} segments, enough for {rounds} rounds of bayessim.realTrajs={b.realTrajs}; "
            f"set bayessim.realIters={rounds} or fewer, or a shorter bayessim.trainTrajLen"
        )
    shape = jax.eval_shape(lambda key: source.real(key, 0, 1, _untrained(env, config))[0], jax.random.PRNGKey(0))
    return Loop(env, config, source, int(shape.shape[-1]))


def _untrained(env: Env, config: Config) -> Policy:
    return rl.policy_of(rl.init(env, config.ppo, jax.random.PRNGKey(0), domain_or_prior(env.space, 1)))


def init(loop: Loop) -> LoopState:
    """The state before round 0: an untrained policy, the prior as domain, no data."""
    b, space, d = loop.settings, loop.env.space, len(loop.env.space)
    domain = domain_or_prior(space, b.components)
    infers = b.modelClass is not None
    real_rows = b.realIters * b.realTrajs
    return LoopState(
        round=jnp.int32(0),
        train=_new_policy(loop, 0, domain),
        domain=domain,
        fit=_new_network(loop, 0) if infers else None,
        thetas=jnp.zeros((loop.capacity if infers else 0, d)),
        features=jnp.zeros((loop.capacity if infers else 0, loop.feature_size)),
        real_features=jnp.zeros((real_rows if infers else 0, loop.feature_size)),
        real_posteriors=jax.tree.map(lambda leaf: jnp.zeros((real_rows, *leaf.shape)), domain) if infers else None,
    )


def _new_policy(loop: Loop, round_: int, domain: Distribution | None) -> TrainState:
    return rl.init(loop.env, loop.config.ppo, loop.key(round_, "init"), domain)


def _new_network(loop: Loop, round_: int) -> Any:
    changing = loop.source is not None and loop.source.policy_dependent
    settings = inference.InferenceSettings.of(loop.settings, restandardise=changing)
    return inference.init(jax.random.fold_in(loop.key(round_, "fit"), 1), settings, loop.env.space, loop.feature_size)


def training_target(loop: Loop, round_: int) -> int:
    """PPO iterations after which the training of `round_` is over (BayesSimIG: max_iterations *per round*)."""
    n = loop.config.ppo.max_iterations
    return n * (round_ + 1) if loop.settings.ftuneRL else n


def train(loop: Loop, state: LoopState, progress: Callable[[dict, TrainState], None] | None = None) -> LoopState:
    """PPO under the current domain until this round's iterations are done (the rest of them, after a resume)."""
    todo = training_target(loop, int(state.round)) - int(state.train.iteration)
    if todo <= 0:
        return state
    trained, _ = rl.run(loop.env, loop.config.ppo, state.train, state.domain, iterations=todo, progress=progress)
    return dataclasses.replace(state, train=trained)


def step(loop: Loop, state: LoopState) -> tuple[LoopState, RoundInfo]:
    """The rest of a round, after training: evaluate, collect, fit, condition on all real trajectories."""
    started, seconds = time.perf_counter(), {}
    round_, policy = int(state.round), rl.policy_of(state.train)
    returns, lengths = _evaluate(loop, state, policy)
    seconds["evaluate"] = time.perf_counter() - started
    info = RoundInfo(
        round=round_,
        rounds=loop.settings.realIters,
        domain=state.domain,
        posterior=None,
        truth=None if loop.source is None else loop.source.truth,
        returns=returns,
        lengths=lengths,
        real=None,
        predictive=None,
        fit={},
        scores={},
        seconds=seconds,
        warnings=[],
    )
    if loop.settings.modelClass is not None:
        state = _infer(loop, state, policy, info)
    state = dataclasses.replace(state, round=state.round + 1)
    if round_ + 1 < loop.settings.realIters:
        # new episodes under the new domain also where the policy goes on
        new = _new_policy(loop, round_ + 1, state.domain)
        kept = dataclasses.replace(state.train, env_states=new.env_states, episodes=new.episodes)
        state = dataclasses.replace(state, train=kept if loop.settings.ftuneRL else new)
    return state, info


def _evaluate(loop: Loop, state: LoopState, policy: Policy) -> tuple[np.ndarray, np.ndarray]:
    """Deterministic episodes on the surrogate real; without one (logs), on physics drawn from the domain."""
    key, n = loop.key(int(state.round), "evaluate"), loop.settings.realEvals
    if isinstance(loop.source, Recorded) or loop.source is None:
        # no truth to try it on: the physics it will be randomised over next, as far as that is known now
        thetas = jnp.zeros((n, 0)) if state.domain is None else state.domain.sample(key, n)
    else:
        thetas = loop.source.sample(key, n)
    result = rl.evaluate(loop.env, policy, jax.random.fold_in(key, 1), thetas)
    return np.asarray(result["return"]), np.asarray(result["length"])


@functools.partial(jax.jit, static_argnums=(0, 1))
def _simulate(source: Source, count: int, key: Array, policy: Policy, prior: Distribution) -> tuple[Array, Array]:
    """`count` trajectories over the prior: theta [count, d], features [count, D], in chunks that fit the memory."""
    chunks = -(-count // CHUNK)
    size = -(-count // chunks)

    def chunk(key: Array) -> tuple[Array, Array]:
        k_theta, k_roll = jax.random.split(key)
        thetas = prior.sample(k_theta, size)
        return thetas, source.simulate(k_roll, thetas, policy)

    thetas, features = jax.lax.map(chunk, jax.random.split(key, chunks))
    return thetas.reshape(-1, thetas.shape[-1])[:count], features.reshape(-1, features.shape[-1])[:count]


def _infer(loop: Loop, state: LoopState, policy: Policy, info: RoundInfo) -> LoopState:
    b, source, round_ = loop.settings, loop.source, int(state.round)
    assert source is not None and state.domain is not None
    clock = time.perf_counter()
    prior = Distribution.prior(loop.env.space, b.components)
    # one program for what is fitted and what tests the fit
    pairs = _simulate(source, b.trainTrajs + b.checkTrajs, loop.key(round_, "simulate"), policy, prior)
    (thetas, features), held = (tuple(p[: b.trainTrajs] for p in pairs), tuple(p[b.trainTrajs :] for p in pairs))
    count = b.trainTrajs
    if loop.capacity:
        row, count = (round_ * b.trainTrajs) % loop.capacity, min((round_ + 1) * b.trainTrajs, loop.capacity)
        thetas = jax.lax.dynamic_update_slice(state.thetas, thetas, (row, 0))
        features = jax.lax.dynamic_update_slice(state.features, features, (row, 0))
        state = dataclasses.replace(state, thetas=thetas, features=features)
    jax.block_until_ready(features)
    info.seconds["simulate"] = time.perf_counter() - clock

    clock = time.perf_counter()
    network = state.fit if b.ftune or round_ == 0 else _new_network(loop, round_)
    network, fit_info = inference.fit(loop.key(round_, "fit"), network, thetas, features, jnp.int32(count))
    info.fit = {name: np.asarray(value) for name, value in dataclasses.asdict(fit_info).items()}
    info.seconds["fit"] = time.perf_counter() - clock

    clock = time.perf_counter()
    seen = round_ * b.realTrajs
    real_features, real = source.real(loop.key(round_, "real"), seen, b.realTrajs, policy)
    all_features = jax.lax.dynamic_update_slice(state.real_features, real_features, (seen, 0))
    fitted, known = (thetas, features, count), slice(seen if source.policy_dependent else 0, seen + b.realTrajs)
    verdict = _examine(loop, round_, network, fitted, held, all_features, known, info)
    widening = 1.0 if verdict is None else verdict[0].temperature or 1.0
    posteriors = _factors(network, all_features, b.priorShare, widening)
    if source.policy_dependent:
        # An older trajectory was made by an older policy: its posterior stays that of the network of its time.
        new = jnp.arange(all_features.shape[0]) >= seen
        posteriors = select(new, posteriors, state.real_posteriors)
    rows = jax.tree.map(np.asarray, posteriors).split()  # on the host: an index on the device compiles each time
    usable = [row for row in rows[: seen + b.realTrajs] if _finite(row)]
    posterior = inference.combine(usable, b.components) if usable else prior
    if len(usable) < seen + b.realTrajs:
        info.warnings.append(f"{seen + b.realTrajs - len(usable)} real trajectories left out: no finite posterior")
    info.warnings += _complaints(posterior.names, info.fit, known_before=np.asarray(state.fit.identified))
    info.posterior, info.real = posterior, jax.tree.map(np.asarray, real)
    info.scores = score(posterior, source.truth)
    domain = posterior
    if verdict is not None:
        info.checks = checks.conclude(*verdict, posterior, b.distrust)
        told = posterior.names if round_ else _unknown(posterior.names, info.fit)
        info.warnings += info.checks.warnings(told)
        domain = checks.guarded(posterior, info.checks.prior_share)
    info.predictive = _predict(loop, posterior, real, loop.key(round_, "predict"))
    info.seconds["condition"] = time.perf_counter() - clock - info.seconds.get("check", 0.0)
    return dataclasses.replace(
        state, fit=network, real_features=all_features, real_posteriors=posteriors, domain=domain
    )


def _examine(
    loop: Loop, round_: int, network: Any, fitted: tuple, held: tuple, real: Array, known: slice, info: RoundInfo
) -> tuple[calibration.Report, misspecification.Misfit] | None:
    """Calibration and misfit, or None where they are switched off or too few fresh simulations are usable."""
    clock = time.perf_counter()
    if not loop.settings.checkTrajs:
        return None
    key = jax.random.fold_in(loop.key(round_, "fit"), 2)
    try:
        return checks.examine(key, network, fitted, held, real, known)
    except ValueError as error:
        info.warnings.append(str(error))
        return None
    finally:
        info.seconds["check"] = time.perf_counter() - clock


@jax.jit
def _factors(network: Any, features: Array, prior_share: float, widening: float) -> Distribution:
    """q(theta | x) of every real trajectory: the prior where nothing is identified, and a share of it everywhere."""
    posteriors = calibration.widened(inference.condition(network, features), widening)
    posteriors = jax.vmap(inference.restore_prior, in_axes=(0, None))(posteriors, network.identified)
    return dataclasses.replace(posteriors, prior_weight=jnp.full_like(posteriors.prior_weight, prior_share))


def _finite(posterior: Distribution) -> bool:
    return all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(posterior))


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

    `state` is that after the round and `policy` the one that it was evaluated with, as in its checkpoint.
    """
    b, source, rows = loop.settings, loop.source, int(state.round) * loop.settings.realTrajs
    assert source is not None and state.domain is not None
    prior, key = Distribution.prior(loop.env.space, b.components), jax.random.PRNGKey(seed)
    key = jax.random.fold_in(jax.random.fold_in(key, 0xCA11), int(state.round))  # seen by no fit
    known = min(b.trainTrajs, REFERENCE)
    thetas, x = _simulate(source, known + pairs, jax.random.fold_in(key, 1), policy, prior)
    held = thetas[known:], x[known:]
    first = rows - b.realTrajs if source.policy_dependent else 0
    verdict = checks.examine(
        key, state.fit, (thetas[:known], x[:known], known), held, state.real_features, slice(first, rows)
    )
    again = checks.replicated(
        jax.random.fold_in(key, 2), state.fit, held[1], lambda k, t: source.simulate(k, t, policy)
    )
    report = dataclasses.replace(verdict[0], predictive=again)
    return checks.conclude(report, verdict[1], state.domain, b.distrust)


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


def _predict(loop: Loop, domain: Distribution, real: Trajectory, key: Array) -> dict[str, np.ndarray] | None:
    """Posterior predictive: the first real trajectory's commands replayed from its first state at posterior draws."""
    physics = getattr(loop.env, "physics", None)
    if physics is None:
        return None
    thetas = domain.sample(key, PREDICTIVE_DRAWS)
    first = [jnp.broadcast_to(x[0], (PREDICTIVE_DRAWS, *x.shape[1:])) for x in (real.qpos, real.qvel, real.command)]
    motion = replay(physics, first[0][:, 0], first[1][:, 0], first[2], thetas)
    return {name: np.asarray(value) for name, value in motion.items()}


def run(
    loop: Loop,
    state: LoopState,
    checkpoints: Checkpoints | None = None,
    monitor: Monitor | None = None,
) -> tuple[LoopState, list[RoundInfo]]:
    """All rounds from `state` on. Checkpoints every ppo.save_interval iterations and after each round.

    A round's checkpoint holds the state *after* it and the policy that was evaluated in it, so that "best" is the best
    evaluated policy.
    """
    infos = []
    while int(state.round) < loop.settings.realIters:
        round_, last = int(state.round), [int(state.train.iteration)]

        def progress(
            metrics: dict, trained: TrainState, state: LoopState = state, round_: int = round_, last: list[int] = last
        ) -> None:
            current, every = dataclasses.replace(state, train=trained), loop.config.ppo.save_interval
            if monitor is not None:
                monitor.training(round_, metrics, current)
            if checkpoints is not None and int(trained.iteration) // every > last[0] // every:
                last[0] = int(trained.iteration)
                checkpoints.save(checkpoint_step(loop, round_, trained), tree_of(loop, current), meta=meta_of(current))

        clock = time.perf_counter()
        state = train(loop, state, progress)
        seconds = time.perf_counter() - clock
        policy, number = rl.policy_of(state.train), checkpoint_step(loop, round_, state.train) + 1
        state, info = step(loop, state)
        info.seconds["train"] = seconds
        if monitor is not None:
            monitor.round(info, policy)  # first: a round that was not reported is not finished
        if checkpoints is not None:
            evaluation, tree = float(info.returns.mean()), {"policy": policy, "state": state}
            # under logs every round is evaluated on its own physics: only the newest evaluation counts
            checkpoints.save(number, tree, evaluation=evaluation, meta=meta_of(state), supersede=info.truth is None)
        infos.append(info)
    return state, infos


def tree_of(loop: Loop, state: LoopState) -> dict[str, Any]:
    """What a checkpoint holds; also the template to restore one."""
    return {"policy": rl.policy_of(state.train), "state": state}


def checkpoint_step(loop: Loop, round_: int, trained: TrainState) -> int:
    """Checkpoints are numbered by PPO iterations and rounds together, so that they always grow."""
    n = loop.config.ppo.max_iterations
    done = int(trained.iteration) - (n * round_ if loop.settings.ftuneRL else 0)
    return round_ * (n + 1) + done


def meta_of(state: LoopState) -> dict[str, int]:
    """What a checkpoint says of itself beside its arrays."""
    return {"round": int(state.round), "iteration": int(state.train.iteration)}
