"""The host's loop around the jitted update: chunks of iterations, metrics once per log interval."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from bayessim_mjx.compat import program
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.device import cores
from bayessim_mjx.errors import DivergedError, UserError
from bayessim_mjx.physics.warp import OVERFLOW, refuse_overflow
from bayessim_mjx.progress import shown
from bayessim_mjx.quantities import compact, is_number
from bayessim_mjx.rl import catalogue, checks, distil, episodes, not_finite, ppo, sharding
from bayessim_mjx.rl.networks import Policy
from bayessim_mjx.rl.state import TrainState, policy_of

if TYPE_CHECKING:
    from bayessim_mjx.distributions import Distribution
    from bayessim_mjx.env import Env

Metrics = dict[str, Any]
LOSSES = ("Loss/value", "Loss/surrogate", "Loss/behavior")
# what an update reports, by TensorBoard tag: averaged over the log interval, or as it is at its end
MEANS = (
    "Loss/value", "Loss/surrogate", "Loss/entropy", "Loss/kl", "Loss/clip_fraction", "Loss/explained_variance",
    "Policy/grad_norm",
)  # fmt: skip
LATEST = (
    "Train/mean_reward", "Train/mean_episode_length", "Loss/learning_rate", "Policy/mean_std", "env_steps",
)  # fmt: skip


def tags(config: PPOConfig) -> tuple[str, ...]:
    """List what an update reports under these settings."""
    return MEANS + LATEST + tuple(tag for e in catalogue.active(config) for tag in (*e.means, *e.latest))


@lru_cache(maxsize=32)
def _make_chunk(env: Env, config: PPOConfig, distils: bool = False) -> Any:
    """chunk(state, given, count): `count` updates in one dispatch, one program for any count. Takes over the state.

    given: what an update needs besides, the domain, and the teacher where one is imitated.
    """
    update, reported = (distil.update, distil.TAGS) if distils else (ppo.update, tags(config))
    latest = {*LATEST, *(tag for extension in catalogue.active(config) for tag in extension.latest)}

    def chunk(state: TrainState, given: tuple, count: jax.Array) -> tuple[TrainState, Metrics]:
        announced = (*reported, *episodes.tags_of_steps(getattr(state.env_states, "metrics", {})))

        def body(_: jax.Array, carry: tuple[TrainState, Metrics]) -> tuple[TrainState, Metrics]:
            state, metrics = update(env, config, carry[0], *given)
            _check_announced(metrics, announced)
            return state, {k: v if k in latest else carry[1][k] + v / count for k, v in metrics.items()}

        zeros = {tag: jnp.float32(0) for tag in announced} | {"env_steps": jnp.uint32(0)}
        return jax.lax.fori_loop(0, count, body, (state, zeros))

    return program(chunk, env, donate_argnums=0)


def _check_announced(metrics: Metrics, reported: Sequence[str]) -> None:
    """Refuse an extension whose figures are not those of its `means` and `latest`."""
    if wrong := {*metrics} ^ {*reported}:
        raise UserError(
            f"ppo.extensions: {', '.join(sorted(wrong))}: the tags of an extension's figures have to be those that its "
            "`means` and `latest` announce"
        )


def start(
    env: Env,
    config: PPOConfig,
    key: jax.Array,
    domain: Distribution | None = None,
    mesh: Mesh | None = None,
    teacher: Policy | None = None,
    clock: int = 0,
) -> TrainState:
    """`ppo.init`, with the program of `run` compiled beside its own where there are processor cores for both.

    Args:
        env, config, key, domain, mesh, clock: see `ppo.init`.
        teacher: what `run` will be given.
    """
    checks.check(env, config, mesh)
    if cores() == 1 or jax.process_count() > 1:
        return ppo.init(env, config, key, domain, mesh, clock)
    given = _given(domain, teacher, mesh)
    chunk = _make_chunk(env, config, teacher is not None)

    def compile_program() -> None:
        state = ppo.outline(env, config, domain, mesh)
        chunk.lower(state, given, np.int32(1)).compile()

    with ThreadPoolExecutor(1) as beside:
        compiling = beside.submit(compile_program)
        state = ppo.init(env, config, key, domain, mesh, clock)
        compiling.result()
    return state


def _given(domain: Distribution | None, teacher: Policy | None, mesh: Mesh | None) -> tuple:
    """List what an update needs besides the state, the same on all devices."""
    given = (domain,) if teacher is None else (domain, teacher)
    return given if mesh is None else sharding.agreed(given)


def run(
    env: Env,
    config: PPOConfig,
    state: TrainState,
    domain: Distribution | None = None,
    iterations: int | None = None,
    progress: Callable[[Metrics, TrainState], None] | None = None,
    teacher: Policy | None = None,
    seen: dict[str, int] | None = None,
) -> tuple[TrainState, Metrics]:
    """Run `iterations` more updates: the new state, and metrics of the last interval.

    The host sees metrics every config.log_interval updates, Loss/* averaged over them.

    Args:
        env, config: as the state was made with.
        state: to go on from; it stays valid.
        domain: where new episodes draw theta from; None: all at the nominal one.
        iterations: None: config.max_iterations.
        progress: called with the metrics and the state of each interval. That state's buffers are reused by the next
            interval: copy what is to be kept.
        teacher: its actions are imitated, see `distil`; None: PPO.
        seen: {tag: iteration} of what the task returned without being finite, to be told once in several calls.

    Raises:
        DivergedError: the loss is no longer finite.
        UserError: contacts had no room (`physics.warp`); the task's numbers are not finite as training begins.
    """
    total = config.max_iterations if iterations is None else iterations
    state = sharding.put(state, state.mesh, ppo.layout(state))  # the caller's state stays valid
    given = _given(domain, teacher, state.mesh)
    done, metrics, seen = 0, {}, {} if seen is None else seen
    not_finite.at_reset(env, state)
    while done < total:
        count = min(config.log_interval, total - done)
        start = time.perf_counter()
        state, on_device = _make_chunk(env, config, teacher is not None)(state, given, np.int32(count))
        metrics = {k: v.item() for k, v in jax.device_get(on_device).items()}
        seconds = time.perf_counter() - start
        done += count
        if not np.isfinite(sum(metrics[tag] for tag in LOSSES if tag in metrics)):
            raise DivergedError(
                f"the loss is not finite after iteration {int(state.iteration)} ({metrics}): check that the task's "
                "observations and rewards stay finite over the whole domain, and lower ppo.learning_rate"
            )
        refuse_overflow(metrics.get(f"Train/{OVERFLOW}", 0.0), f"the steps before iteration {int(state.iteration)}")
        not_finite.watch(env, metrics, int(state.iteration), int(state.iteration) == count, seen)
        metrics["Perf/total_fps"] = count * config.num_envs * config.num_steps / seconds
        metrics["Perf/iteration_time"] = seconds / count
        if progress is not None:
            progress(metrics, state)
    return state, metrics


def train(
    env: Env,
    config: PPOConfig,
    key: jax.Array,
    domain: Distribution | None = None,
    *,
    state: TrainState | None = None,
    iterations: int | None = None,
    progress: Callable[[Metrics, TrainState], None] | bool | None = None,
    mesh: Mesh | None = None,
) -> tuple[Policy, Metrics]:
    """Train from scratch or go on from a state: the policy, and metrics of the last interval.

    Args:
        env, config, domain, iterations: see `run`.
        key, mesh: see `ppo.init`; not used with `state`.
        state: to go on from; None: `start`.
        progress: a function, see `run`; or whether to show it on stderr, None: on a terminal or in a notebook.
    """
    own = progress if callable(progress) else None
    with shown(False if own else progress) as show:
        total = config.max_iterations if iterations is None else iterations
        show("compiling the training", 0, 1)
        if state is None:
            state = start(env, config, key, domain, mesh)
        begun = int(state.iteration)
        show("training", 0, total)

        def watch(metrics: Metrics, now: TrainState) -> None:
            earned = metrics["Train/mean_reward"]  # NaN until an episode has ended
            note = f"{compact(metrics['Perf/total_fps'])} steps/s"
            note += f", return {compact(earned)}" if is_number(earned) else ""
            show("training", int(now.iteration) - begun, total, note)

        state, metrics = run(env, config, state, domain, iterations, own or watch)
    return policy_of(state), metrics
