"""How fast an environment is simulated: random actions, and new episodes drawn and begun as in training."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from bayessim_mjx.compat import program
from bayessim_mjx.rl import worlds as training
from bayessim_mjx.rollout import collect, strong

if TYPE_CHECKING:
    from bayessim_mjx.env import Env, State

REPETITIONS = 5


@dataclasses.dataclass(frozen=True)
class Speed:
    """Control steps per second of all worlds together, in each repetition; and seconds until the first step.

    `compiling` is what the first rollout took longer than the second: tracing, compiling, building kernels.
    """

    rates: tuple[float, ...]
    compiling: float

    @property
    def median(self) -> float:
        return statistics.median(self.rates)


def measure(
    env: Env, worlds: int, steps: int, seconds: float, now: Callable[[], float] = time.perf_counter, seed: int = 0
) -> Speed:
    """Measure the speed of rollouts of `steps` control steps, repeated for about `seconds`.

    Args:
        env: any environment.
        worlds: how many are simulated together.
        steps: of one rollout; with each, new episodes are drawn once, as with each update of PPO.
        seconds: of all repetitions together, without compiling. A rollout that takes longer is done once.
        now: clock in seconds.
        seed: of episodes and actions.
    """
    keys = iter(jax.random.split(jax.random.PRNGKey(seed), 10_000))
    begun = now()
    begin, run = _programs(env, worlds, steps)
    states, _ = jax.block_until_ready(run(next(keys), begin(next(keys))))
    first = now() - begun

    def again(states: State, count: int) -> tuple[State, float]:
        since = now()
        for _ in range(count):
            states, _ = run(next(keys), states)
        jax.block_until_ready(states)
        return states, now() - since

    states, second = again(states, 1)
    compiling = max(first - second, 0.0)
    if second >= seconds:
        return Speed((worlds * steps / second,), compiling)
    count = max(1, min(1000, round(seconds / REPETITIONS / second)))
    rates: list[float] = []
    left = seconds
    while len(rates) < REPETITIONS and left > 0:
        states, took = again(states, count)
        rates.append(count * worlds * steps / took)
        left -= took
    return Speed(tuple(rates), compiling)


def _programs(env: Env, worlds: int, steps: int) -> tuple[Callable[..., State], Callable[..., tuple[State, Any]]]:
    """(key -> worlds at random times of their episodes, (key, worlds) -> (worlds later on, means of what was seen))."""

    def begin(key: jax.Array) -> State:
        fresh, clocks = jax.random.split(key)
        state = training.reset(env, fresh, None, worlds)
        return strong(training.stagger(clocks, state, env.episode_length)[0])

    def act(action: jax.Array, obs: dict[str, jax.Array]) -> tuple[jax.Array, tuple]:
        return action, ()

    def run(key: jax.Array, states: State) -> tuple[State, Any]:
        drawn, acting = jax.random.split(key)
        pool = strong(training.reset(env, drawn, None, worlds, clock=training.clock(env, states)))
        actions = jax.random.uniform(acting, (steps, worlds, env.action_size), minval=-1.0)
        states, seen = collect(env, act, actions, states, pool)
        return strong(states), jax.tree.map(jnp.mean, seen)  # observations are computed only where they are used

    return program(begin, env), program(run, env)
