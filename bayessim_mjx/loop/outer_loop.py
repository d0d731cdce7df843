"""The outer loop: train on physics drawn from the domain, try the policy on the real side, infer a sharper domain.

One round (BayesSimIG's order): PPO under the current domain; evaluation on the surrogate real; simulated trajectories
over the prior (or over the last posterior, see inference/rounds.py) and a fit of q(theta | summary); the real
trajectories so far, multiplied, give the next domain. All of a round runs on the device.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx import memory, rl
from bayessim_mjx.config import Config
from bayessim_mjx.device import mesh
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.env import Env
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import InferenceSettings, rounds
from bayessim_mjx.keys import branch
from bayessim_mjx.loop import ranges
from bayessim_mjx.loop.examination import reexamine
from bayessim_mjx.loop.round_inference import PREDICTIVE_DRAWS, infer, new_network, score
from bayessim_mjx.loop.sources import Recorded, make_source, with_surrogate
from bayessim_mjx.loop.state import KEPT_ROUNDS, UNWATCHED, Begin, Loop, LoopState, RoundInfo, domain_or_prior
from bayessim_mjx.loop.trajectories import no_motion
from bayessim_mjx.loop.watching import Monitor, Watching
from bayessim_mjx.parameters.ranged import Ranged
from bayessim_mjx.progress import shown
from bayessim_mjx.rl import Policy, TrainState
from bayessim_mjx.rl.recurrent import remembering

__all__ = [
    "PREDICTIVE_DRAWS", "Checkpoints", "Loop", "LoopState", "Monitor", "RoundInfo", "checkpoint_step", "init", "make",
    "meta_of", "reexamine", "run", "score", "step", "train", "training_target", "tree_of",
]  # fmt: skip


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


def make(config: Config, env: Env) -> Loop:
    """Build the loop's static parts; refuses configurations that cannot work."""
    b, units = config.bayessim, config.ppo.memory_size
    env, config = remembering(env, units) if units else env, with_surrogate(config, env)
    if b.modelClass is None:
        # The ablation infers nothing, but is scored on the same surrogate.
        source = make_source(config, env) if len(env.space) else None
        return Loop(env, config, source, 0)
    if not len(env.space):
        raise UserError(
            f"task {env.name!r} has no parameters to infer: name some under task.randomization_params, "
            "or set bayessim.modelClass=None to train without inference"
        )
    if b.refine == "likelihood" and getattr(env, "physics", None) is None:
        raise UserError(
            f"bayessim.refine=likelihood replays trajectories on a task's own MuJoCo model; {env.name!r} has none; "
            "allowed: auto, off"
        )
    source = make_source(config, env)
    if isinstance(source, Recorded) and source.supply is not None and source.supply < b.realTrajs * b.realIters:
        most = source.supply // b.realTrajs
        raise UserError(
            f"real.logs hold {source.supply} segments, enough for {most} rounds of bayessim.realTrajs={b.realTrajs}; "
            f"set bayessim.realIters={most} or fewer, or a shorter bayessim.trainTrajLen"
        )
    names = source.channels.features(b.summarizerFxn)
    rows = b.trainTrajs * (min(b.realIters, KEPT_ROUNDS) if b.ftune else 1)
    what = f"bayessim.trainTrajs = {b.trainTrajs} summaries of {len(names)} features"
    memory.refuse([(what, 4.0 * rows * (len(names) + len(env.space)))])
    return Loop(env, config, source, len(names), names)


def init(loop: Loop, trains: bool = True, progress: bool | None = None) -> LoopState:
    """Make the state before round 0: an untrained policy, the prior as domain, no data.

    Args:
        trains: whether training comes next, its program then being compiled beside the first reset's.
        progress: as `run` takes it.
    """
    fields = blank(loop)
    with shown(progress) as show:
        show("compiling the training" if trains else "setting up", 0, 1)
        policy = _new_policy(loop, 0, fields["domain"], rl.start if trains else rl.init)
    return LoopState(round=jnp.int32(0), train=policy, **fields)


def blank(loop: Loop) -> dict[str, Any]:
    """Make the inference's fields of a LoopState before the first round: no data, the prior as domain."""
    b, space, d = loop.settings, loop.space, len(loop.env.space)
    domain = domain_or_prior(space, b.components, loop.chart)
    infers = b.modelClass is not None
    capacity, real_rows = (loop.capacity, b.realIters * b.realTrajs) if infers else (0, 0)
    return {
        "domain": domain,
        "fit": new_network(loop, 0, space) if infers else None,
        "thetas": jnp.zeros((capacity, d)),
        "features": jnp.zeros((capacity, loop.feature_size)),
        "real_features": jnp.zeros((real_rows, loop.feature_size)),
        "real_posteriors": _no_factors(loop, real_rows) if infers else None,
        **_no_proposals(loop),
        "temperature": jnp.float32(1.0),
        "moving": ranges.unmoved(space) if isinstance(space, Ranged) else None,
        "motion": no_motion(loop, real_rows) if infers and loop.refines else None,
        "standing": domain if infers else None,
        "standing_gain": jnp.float32(-jnp.inf) if infers else None,
        "standing_round": jnp.int32(0) if infers else None,
        "settled": jnp.asarray(False) if infers and b.untilSettled else None,
    }


def _no_factors(loop: Loop, rows: int) -> Distribution:
    settings = InferenceSettings.of(loop.settings).at(loop.env.space)
    factor = Distribution.prior(loop.space, settings.components * settings.ensemble, settings.chart)
    return jax.tree.map(lambda leaf: jnp.zeros((rows, *leaf.shape)), factor)


def _no_proposals(loop: Loop) -> dict[str, Any]:
    if not loop.sequential:
        return {"proposal": None, "proposals": None}
    b = loop.settings
    prior = rounds.first(loop.space, b.proposal, b.components, loop.chart)
    return {"proposal": prior, "proposals": rounds.repeated(prior, max(1, loop.capacity // b.trainTrajs))}


def _new_policy(
    loop: Loop, round_: int, domain: Distribution | None, begin: Callable[..., TrainState] = rl.init
) -> TrainState:
    ppo = loop.config.ppo
    clock = round_ * ppo.max_iterations * ppo.num_steps  # schedules of randomisation go on from round to round
    return begin(loop.env, ppo, loop.key(round_, "init"), domain, mesh(loop.config), clock=clock)


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


def step(loop: Loop, state: LoopState, begin: Begin = UNWATCHED) -> tuple[LoopState, RoundInfo]:
    """Do the rest of a round, after training: evaluate, collect, fit, condition on all real trajectories."""
    begin("evaluating the policy")
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
        before = state.domain
        state, found = infer(loop, state, policy, begin)
        info = info.with_(found)
        if state.settled is not None and round_:
            info.settled = loop.settled(before, state.domain)
            state = dataclasses.replace(state, settled=jnp.asarray(bool(info.settled)))
    state = dataclasses.replace(state, round=state.round + 1)
    if not loop.finished(state):
        # new episodes under the new domain also where the policy goes on
        new = _new_policy(loop, round_ + 1, state.domain)
        kept = rl.ppo.in_worlds_of(state.train, new) if loop.settings.ftuneRL else new
        state = dataclasses.replace(state, train=kept)
    return state, info


def _evaluate(loop: Loop, state: LoopState, policy: Policy) -> tuple[np.ndarray, np.ndarray]:
    """Deterministic episodes on the surrogate real; without one (logs), on physics drawn from the domain."""
    key, n = loop.key(int(state.round), "evaluate"), loop.settings.realEvals
    if isinstance(loop.source, Recorded) or loop.source is None:
        # no truth to try it on: the physics it will be randomised over next, as far as that is known now
        thetas = jnp.zeros((n, 0)) if state.domain is None else state.domain.sample(key, n)
    else:
        thetas = loop.source.sample(key, n)
    result = rl.evaluate(loop.env, policy, branch(key, 1), thetas)
    return np.asarray(result["return"]), np.asarray(result["length"])


def run(
    loop: Loop,
    state: LoopState,
    checkpoints: Checkpoints | None = None,
    monitor: Monitor | None = None,
    progress: bool | None = None,
) -> tuple[LoopState, list[RoundInfo]]:
    """All rounds from `state` on. Checkpoints every ppo.save_interval iterations and after each round.

    A round's checkpoint holds the state *after* it and the policy that was evaluated in it, so that "best" is the best
    evaluated policy.

    Args:
        progress: whether to show it on stderr; None: without a monitor, and on a terminal or in a notebook.
    """
    with shown(False if progress is None and monitor is not None else progress) as show:
        return _rounds(loop, state, checkpoints, Watching(show, loop, monitor))


def _rounds(
    loop: Loop, state: LoopState, checkpoints: Checkpoints | None, monitor: Watching
) -> tuple[LoopState, list[RoundInfo]]:
    infos = []
    while not loop.finished(state):
        round_, last = int(state.round), [int(state.train.iteration)]

        def progress(
            metrics: dict, trained: TrainState, state: LoopState = state, round_: int = round_, last: list[int] = last
        ) -> None:
            current, every = dataclasses.replace(state, train=trained), loop.config.ppo.save_interval
            monitor.training(round_, metrics, current)
            if checkpoints is not None and int(trained.iteration) // every > last[0] // every:
                last[0] = int(trained.iteration)
                checkpoints.save(checkpoint_step(loop, round_, trained), tree_of(loop, current), meta=meta_of(current))

        monitor.begin(round_)
        clock = time.perf_counter()
        state = train(loop, state, progress)
        seconds = time.perf_counter() - clock
        policy, number = rl.policy_of(state.train), checkpoint_step(loop, round_, state.train) + 1
        state, info = step(loop, state, functools.partial(monitor.part, round_))
        info.seconds["train"] = seconds
        monitor.round(info, policy)  # first: a round that was not reported is not finished
        if checkpoints is not None:
            evaluation, tree = float(info.returns.mean()), {"policy": policy, "state": state}
            # under logs every round is evaluated on its own physics: only the newest evaluation counts
            checkpoints.save(number, tree, evaluation=evaluation, meta=meta_of(state), supersede=info.truth is None)
        infos.append(info)
    return state, infos


def tree_of(loop: Loop, state: LoopState) -> dict[str, Any]:
    """Contents of a checkpoint; also the template to restore one."""
    return {"policy": rl.policy_of(state.train), "state": state}


def checkpoint_step(loop: Loop, round_: int, trained: TrainState) -> int:
    """Checkpoints are numbered by PPO iterations and rounds together, so that they always grow."""
    n = loop.config.ppo.max_iterations
    done = int(trained.iteration) - (n * round_ if loop.settings.ftuneRL else 0)
    return round_ * (n + 1) + done


def meta_of(state: LoopState) -> dict[str, int]:
    """Numbers that a checkpoint keeps beside its arrays."""
    return {"round": int(state.round), "iteration": int(state.train.iteration)}
