"""Many worlds in one batch that restart by themselves: what the wrappers for foreign trainers stand on.

    worlds("Ant", 1024)                          nominal physics
    worlds("Ant", 1024, domain="prior")          physics from the task's ranges, new in every episode
    worlds("logs/Ant/RUN", 1024)                 the run's own task under the posterior that it ended with

Arrays stay on their device; the wrappers hand them on by DLPack, or copy them where a trainer wants numpy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx import registry
from bayessim_mjx.compat import program
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.env import Env, Observations
from bayessim_mjx.errors import UserError
from bayessim_mjx.physics.warp import OVERFLOW, refuse_overflow
from bayessim_mjx.rl.worlds import aged, clock, drawn, held, reset_at
from bayessim_mjx.rollout import next_episodes, select, traced


class Batch(NamedTuple):
    """What a step led to in N worlds; ended ones have begun again.

    Attributes:
        obs: groups `[N, ...]`, of the new episode where the old one ended.
        reward: `[N]` float32, times the worlds' `reward_scale`.
        terminated: `[N]` bool, the episode ended for good.
        truncated: `[N]` bool, it ended by its time limit alone.
        final: groups `[N, ...]`, the observations that the step itself led to: the last ones of ended episodes.
        returns: `[N]` float32, sum of the episode's rewards as the task gives them, this one included.
        lengths: `[N]` int32, its steps so far.
        metrics: the task's scalars `[N]`.
        theta: `[N, d]`, the parameters of the episodes that `obs` belongs to.
    """

    obs: Observations
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    final: Observations
    returns: jax.Array
    lengths: jax.Array
    metrics: dict[str, jax.Array]
    theta: jax.Array


class _Running(NamedTuple):
    """Worlds between two steps: states, their theta, sums so far; and new episodes in store, with which were used."""

    state: Any
    theta: jax.Array
    returns: jax.Array
    lengths: jax.Array
    store: tuple[Any, jax.Array]
    used: jax.Array


class Worlds:
    """`num_envs` worlds of `env`; theta comes from `domain` anew in each episode (None: nominal).

    Args:
        env: a task, or any environment of our protocol.
        domain: where theta comes from.
        num_envs: worlds in the batch.
        seed: of resets and theta.
        reward_scale: factor on the rewards that a learner sees.

    Raises:
        UserError: `num_envs` below 1; a step before the first reset, or after one without room for contacts; actions or
            theta of another shape.
    """

    def __init__(
        self, env: Env, domain: Distribution | None = None, num_envs: int = 64, seed: int = 0, reward_scale: float = 1.0
    ) -> None:
        if not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise UserError(f"num_envs = {num_envs!r}: must be a whole number of at least 1")
        self.env, self.num_envs, self.domain, self.reward_scale = env, int(num_envs), domain, float(reward_scale)
        self.seed(seed)
        self._begin, self._advance = _programs(env, self.num_envs, self.reward_scale)
        self._running: _Running | None = None
        self.watch: Callable[[Batch], None] | None = None  # is shown every batch
        self._lost: Any = 0.0  # metric of the last step; looked at before the next one, as the host would wait now
        self._fixed: jax.Array | None = None  # theta [N, d] that `set_theta` gave

    def seed(self, seed: int) -> None:
        """Seed what is drawn from now on."""
        # bound to its device as tensors of other libraries are: else the second step would be compiled again
        key = jax.random.PRNGKey(seed)
        self._key = jax.device_put(key, key.devices().pop())

    def set_theta(self, theta: Any = None) -> None:
        """Episodes that begin from now on have `theta`, `[d]` or `[num_envs, d]`; None: what `domain` draws."""
        if self._running is not None:  # episodes in store have others
            self._running = self._running._replace(used=jnp.ones(self.num_envs, bool))
        if theta is None:
            self._fixed = None
            return
        d, value = len(self.env.space.nominal), np.asarray(theta, np.float32)
        if value.shape not in ((d,), (self.num_envs, d)):
            raise UserError(f"theta has shape {list(value.shape)}; expected {[d]} or {[self.num_envs, d]}")
        self._fixed = jnp.broadcast_to(value, (self.num_envs, d))

    def set_lengths(self, steps: jax.Array) -> None:
        """Set the age of the running episodes to `steps` `[N]`, so that their time limits do not come all at once."""
        if self._running is None:
            self.reset()
        old: _Running = self._running  # type: ignore[assignment]
        steps = jnp.asarray(steps, jnp.int32)
        self._running = old._replace(state=aged(old.state, steps), lengths=steps)

    def reset(self) -> Observations:
        """Begin new episodes in all worlds; return their first observations, groups `[N, ...]`."""
        self._key, key = jax.random.split(self._key)
        self._running = self._begin(key, self.domain, self._fixed)
        return self._running.state.obs

    def step(self, action: Any) -> Batch:
        """One control step with `action` `[N, A]` in [-1, 1]."""
        if self._running is None:
            raise UserError("step before reset: call reset() first")
        refuse_overflow(self._lost, "the worlds in the step before")
        if tuple(action.shape) != (expected := (self.num_envs, self.env.action_size)):
            raise UserError(f"actions have shape {list(action.shape)}; expected {list(expected)}")
        batch, self._running, self._key = self._advance(self._key, self._running, action, self.domain, self._fixed)
        self._lost = batch.metrics[OVERFLOW].mean() if OVERFLOW in batch.metrics else 0.0
        if self.watch is not None:
            self.watch(batch)
        return batch

    @property
    def obs(self) -> Observations:
        """The worlds' observations now, groups `[N, ...]`; the first call resets."""
        return self.reset() if self._running is None else self._running.state.obs

    @property
    def theta(self) -> jax.Array:
        """Parameters of the running episodes, `[N, d]`."""
        if self._running is None:
            raise UserError("theta before reset: call reset() first")
        return self._running.theta

    @property
    def lengths(self) -> jax.Array:
        """Steps of the running episodes, `[N]` int32."""
        return jnp.zeros(self.num_envs, jnp.int32) if self._running is None else self._running.lengths

    @property
    def qpos(self) -> jax.Array:
        """Positions `[N, nq]`, for pictures."""
        if self._running is None:
            raise UserError("a picture before reset: call reset() first")
        return self._running.state.pipeline_state.qpos


@dataclass(frozen=True)
class _Steps:
    """What happens to `num_envs` worlds, as pure functions."""

    env: Env
    num_envs: int
    reward_scale: float

    def episodes(self, key: jax.Array, domain: Any, fixed: jax.Array | None, now: Any = 0) -> tuple[Any, jax.Array]:
        theta_key, reset_key = jax.random.split(key)
        theta = drawn(self.env, theta_key, domain, self.num_envs) if fixed is None else fixed
        state = reset_at(self.env, reset_key, theta, None, now)
        return state, held(self.env, state, theta)

    def began(self, key: jax.Array, domain: Any, fixed: jax.Array | None) -> _Running:
        first, later = (self.episodes(k, domain, fixed) for k in jax.random.split(key))
        zero, n = jnp.zeros, self.num_envs
        return _Running(*first, zero(n), zero(n, jnp.int32), later, zero(n, bool))

    def advanced(
        self, key: jax.Array, old: _Running, action: jax.Array, domain: Any, fixed: jax.Array | None
    ) -> tuple[Batch, _Running, jax.Array]:
        # split here: one more call from Python would cost as much as a small task's physics
        later, key = jax.random.split(key)
        after = jax.vmap(traced(self.env.step))(old.state, jnp.asarray(action, jnp.float32))
        terminated = after.info["terminated"] > 0
        truncated = (after.info["truncated"] > 0) & ~terminated
        ended = terminated | truncated
        returns, lengths = old.returns + after.reward, old.lengths + 1
        # resets are dear: new episodes are drawn for all worlds at once, when one of them needs its second
        empty = (ended & old.used).any()
        renew = lambda: self.episodes(key, domain, fixed, clock(self.env, old.state))  # noqa: E731
        store = jax.lax.cond(empty, lambda: _as(renew(), old.store), lambda: old.store)
        fresh, theta = store
        fresh = next_episodes(self.env, ended, after, fresh)
        state, theta = select(ended, (fresh, held(self.env, fresh, theta)), (after, old.theta))
        reward, metrics = self.reward_scale * after.reward, dict(after.metrics)
        batch = Batch(state.obs, reward, terminated, truncated, after.obs, returns, lengths, metrics, theta)
        returns, lengths = jnp.where(ended, 0.0, returns), jnp.where(ended, 0, lengths)
        return batch, _Running(state, theta, returns, lengths, store, (old.used & ~empty) | ended), later


@lru_cache(maxsize=16)
def _programs(env: Env, num_envs: int, reward_scale: float) -> tuple[Any, Any]:
    """Compiled once for each environment and number of worlds, however many `Worlds` there are of them."""
    steps = _Steps(env, num_envs, reward_scale)
    return program(steps.began, env), program(steps.advanced, env)


def _as(tree: Any, reference: Any) -> Any:
    """`tree` with the dtypes of `reference`, as both ends of a condition need the same."""
    return jax.tree.map(lambda x, ref: jnp.asarray(x, jnp.result_type(ref)), tree, reference)


def worlds(task: Any, num_envs: int = 64, domain: Any = None, seed: int = 0, **env_settings: Any) -> Worlds:
    """Worlds of a task, or of a run's task under its posterior.

    Args:
        task: a task's name, an environment, or the folder of a run of `main` or `train`:
            then everything of the environment is as in the run, and `domain` is its posterior unless another is given.
        num_envs: worlds in the batch.
        domain: where theta comes from, anew in each episode. None or "nominal": the nominal one; "prior": the task's
            ranges; a `Distribution`; the folder of a run or of a checkpoint: its posterior; a file that
            `Distribution.save` wrote.
        seed: of resets and theta.
        env_settings: settings of `env:`, e.g. `episodeLength=100`.

    Raises:
        UserError: a task, run or file that there is not; a distribution over other parameters.
    """
    return Worlds(*environment(task, domain, env_settings, num_envs), num_envs=num_envs, seed=seed)


def environment(
    task: Any, domain: Any = None, env_settings: Mapping[str, Any] | None = None, num_envs: int | None = None
) -> tuple[Env, Distribution | None]:
    """(environment, distribution over its theta) of the arguments of `worlds`; num_envs: what `impl="auto"` goes by."""
    settings, together = dict(env_settings or {}), {} if num_envs is None else {"numEnvs": num_envs}
    if isinstance(task, Path) or (isinstance(task, str) and Path(task).is_dir()):
        config, checkpoint = run_of(task)
        env = registry.make(config.task, config=config, **settings | together)
        return env, domain_of(env, checkpoint if domain is None else domain)
    if isinstance(task, str):
        env = registry.make(task, **settings | together)
    elif settings:
        raise UserError(f"{next(iter(settings))}: settings go with a task's name, not with an environment")
    else:
        env = task
    return env, domain_of(env, domain)


def domain_of(env: Env, source: Any) -> Distribution | None:
    """Find the distribution over theta that `source` names (see `worlds`)."""
    if source is None or source == "nominal":
        return None
    if not isinstance(source, str | Path):
        return source
    if source == "prior":
        return Distribution.prior(env.space, 1) if len(env.space) else None
    path = Path(source)
    if path.is_file():
        return Distribution.load(path, env.space)
    if not path.is_dir():
        raise UserError(
            f"domain = {str(source)!r}: allowed are nominal, prior, a Distribution, the folder of a run or checkpoint, "
            "and a file that Distribution.save wrote"
        )
    config, checkpoint = run_of(path)
    found = posterior_of(env, checkpoint, config)
    if found is None and config.randomization.get("randomize") and len(env.space):
        return Distribution.prior(env.space, 1)  # PPO alone, on the prior
    return found


def posterior_of(env: Env, checkpoint: Path, config: Any) -> Distribution | None:
    """Load the posterior of a checkpoint of the loop, or that which PPO alone was trained on; None: neither."""
    from bayessim_mjx.loop.posterior import restored

    found = restored(checkpoint, env, config)
    return domain_of(env, config.domain) if found is None and config.domain is not None else found


def run_of(path: str | Path) -> tuple[Any, Path]:
    """Find (settings, checkpoint with the last state) of a run or of one of its checkpoints."""
    from bayessim_mjx.runs import MANIFEST, Run

    folder = Path(path).absolute()
    if (folder / MANIFEST).is_file():
        run = Run.open(folder)
        return run.config, run.checkpoint("latest")
    if (folder.parent.parent / MANIFEST).is_file():
        return Run.open(folder.parent.parent).config, folder
    raise UserError(f"{path}: neither a run nor a checkpoint of one (there is no {MANIFEST})")
