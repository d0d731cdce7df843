"""Brax's training wrapper with fresh episodes: every one begins anew, with its own physics.

Brax's own repeats the first episode of each world. Resets are dear: new episodes are drawn for all worlds at once, when
one of them needs its second.
"""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from brax.envs.base import Wrapper
from brax.envs.wrappers.training import EpisodeWrapper, VmapWrapper
from flax import struct

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.env import Env, State
from bayessim_mjx.errors import UserError
from bayessim_mjx.keys import branch
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.parameters.parameter import OVER
from bayessim_mjx.rl.worlds import clock, drawn, reset_at
from bayessim_mjx.rollout import next_episodes, select

STORE, OURS = "fresh", "ours"  # in `info`: episodes to begin with; what our environment keeps there


def wrap(env: Env, episode_length: int | None = None, action_repeat: int = 1, randomization_fn: Any = None) -> Any:
    """Make what Brax's trainers take as `wrap_env_fn`.

    Args:
        env: an environment of ours; `Under(env, domain)` draws theta.
        episode_length: control steps; None: the environment's own.
        action_repeat: steps for which an action holds.
        randomization_fn: None; the physics comes from the domain.

    Raises:
        UserError: a `randomization_fn`.
    """
    if randomization_fn is not None:
        raise UserError("randomization_fn: physics comes from a domain here; give wrappers.brax.ours(task, domain)")
    batched = VmapWrapper(Apart(env))  # type: ignore[arg-type]
    return FreshEpisodes(EpisodeWrapper(batched, episode_length or env.episode_length, action_repeat), env)


class Apart(Wrapper):
    """Our environment with its `info` in a place of its own: Brax's wrapper counts under the same names."""

    def reset(self, rng: jax.Array) -> Any:
        return _apart(self.env.reset(rng), {})

    def step(self, state: Any, action: jax.Array) -> Any:
        return _apart(self.env.step(state.replace(info=state.info[OURS]), action), state.info)


def _apart(state: Any, info: dict[str, Any]) -> Any:
    return state.replace(info={**info, OURS: state.info})


@struct.dataclass
class Store:
    """Episodes to begin with, for N worlds: their states, and [N] whether each was used."""

    key: jax.Array
    state: State
    used: jax.Array


class FreshEpisodes(Wrapper):
    """In the place of Brax's `AutoResetWrapper`; `source` is the environment of ours within `env`."""

    def __init__(self, env: Any, source: Env) -> None:
        super().__init__(env)
        self._source: Env = source.env if isinstance(source, Under) else source
        self._domain: Distribution | None = source.domain if isinstance(source, Under) else None
        self._begins = OVER if isinstance(source, Under) and source.schedules_over else 0  # the clock of schedules

    def _drawn(self, key: jax.Array, count: int, now: Any = 0) -> State:
        theta_key, reset_key = jax.random.split(key)
        return reset_at(self._source, reset_key, drawn(self._source, theta_key, self._domain, count), None, now)

    def reset(self, rng: jax.Array) -> Any:
        state: Any = self.env.reset(rng)
        key, first = jax.random.split(branch(rng[0], 1))
        if getattr(self._source, "nuisance", None) is not None:  # by the clock, which a reset alone does not know
            key, own = jax.random.split(key)
            begun = self._drawn(own, rng.shape[0], self._begins)
            seen = {"pipeline_state": begun.pipeline_state, "obs": begun.obs}
            state = state.replace(**seen, info={**state.info, OURS: begun.info})
        later = self._drawn(first, rng.shape[0], self._begins)
        store = Store(key, later, jnp.zeros(rng.shape[0], bool))
        return state.replace(info={**state.info, STORE: store})

    def step(self, state: Any, action: jax.Array) -> Any:
        info = dict(state.info)
        store, steps = info.pop(STORE), jnp.where(state.done > 0, 0.0, state.info["steps"])
        before = state.replace(done=jnp.zeros_like(state.done), info={**info, "steps": steps})
        after: Any = self.env.step(before, action)
        ours = State(after.pipeline_state, after.obs, after.reward, after.done, {}, after.info[OURS])
        ended = after.done > 0
        empty, (key, draw) = (ended & store.used).any(), jax.random.split(store.key)

        def renewed() -> State:
            fresh = self._drawn(draw, len(ended), clock(self._source, ours))
            return jax.tree.map(lambda x, old: jnp.asarray(x, jnp.result_type(old)), fresh, store.state)

        fresh = jax.lax.cond(empty, renewed, lambda: store.state)
        begun = next_episodes(self._source, ended, ours, fresh)
        info = {name: ours.info[name] for name in begun.info}
        new, old = (begun.pipeline_state, begun.obs, begun.info), (ours.pipeline_state, ours.obs, info)
        world, obs, kept = select(ended, new, old)
        left = Store(jnp.where(empty, key, store.key), fresh, (store.used & ~empty) | ended)
        return after.replace(pipeline_state=world, obs=obs, info={**after.info, OURS: kept, STORE: left})


# An environment of ours whose `reset(key)` draws its own physics, for trainers that know no theta


class Under(Env):
    """`env` under `domain`: a reset without theta draws it (domain None: the nominal one).

    In its own resets all schedules are over. `wrappers.fresh.wrap` begins them at its first reset, but where
    `schedules_over`, as evaluations want it.
    """

    def __init__(self, env: Env, domain: Distribution | None, schedules_over: bool = False) -> None:
        self.env, self.domain, self.schedules_over = env, domain, schedules_over
        self.name, self.episode_length = env.name, env.episode_length
        self.mirrors, self.nuisance = env.mirrors, env.nuisance

    def reset(self, key: jax.Array, theta: jax.Array | None = None) -> State:
        if theta is None and self.domain is not None:
            key, theta_key = jax.random.split(key)
            theta = self.domain.sample(theta_key, 1)[0]
        return self.env.reset(key, theta)

    def step(self, state: State, action: jax.Array) -> State:
        return self.env.step(state, action)

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def dt(self) -> float:
        return self.env.dt

    @property
    def space(self) -> ParameterSpace:
        return self.env.space

    @property
    def mj_model(self) -> mujoco.MjModel:
        return self.env.mj_model

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "env":
            raise AttributeError(name)
        return getattr(self.env, name)
