"""Environments of other libraries for our trainer: Brax's (`brax:ant`) and MuJoCo Playground's (`playground:<name>`).

They have no parameters of ours: their space is empty and theta is ignored.
"""

import dataclasses
import difflib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco

from bayessim_mjx.config.settings import implementation
from bayessim_mjx.env import Env, Observations, State
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics.warp import quieter, without_warp

if TYPE_CHECKING:
    from bayessim_mjx.config import Config


class BraxEnv(Env):
    """A Brax-like environment with an episode length of its own; its state is carried in `pipeline_state`."""

    def __init__(self, env: Any, name: str, episode_length: int) -> None:
        self.env = env
        self.name = name
        self.episode_length = int(episode_length)
        self._space = ParameterSpace(())

    def reset(self, key: jax.Array, theta: jax.Array | None = None) -> State:
        inner = self._after(self.env.reset(key))
        reward, done, metrics = jax.tree.map(_real, (inner.reward, inner.done, dict(inner.metrics)))
        return self._state(inner.replace(reward=reward, done=done, metrics=metrics), jnp.zeros((), jnp.int32))

    def step(self, state: State, action: jax.Array) -> State:
        inner = self._after(self.env.step(self._before(state.pipeline_state), jnp.clip(action, -1.0, 1.0)))
        after = self._state(_like(inner, state.pipeline_state), state.info["steps"] + 1)
        return dataclasses.replace(after, info={**state.info, **after.info})

    def _before(self, inner: Any) -> Any:
        """Its state as its `step` takes it, from what is carried on."""
        return inner

    def _after(self, inner: Any) -> Any:
        """Return the part of its state that is carried on."""
        return inner

    def _state(self, inner: Any, steps: jax.Array) -> State:
        obs, done = _groups(inner.obs), inner.done
        info = {
            "terminated": done,
            "truncated": (steps >= self.episode_length).astype(jnp.float32),
            "final_observation": obs,
            "steps": steps,
        }
        return State(inner, obs, inner.reward, done, dict(inner.metrics), info)

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def dt(self) -> float:
        return float(self.env.dt)

    @property
    def space(self) -> ParameterSpace:
        return self._space

    @property
    def mj_model(self) -> mujoco.MjModel:
        return self.env.sys.mj_model if hasattr(self.env, "sys") else self.env.mj_model


class WarpEnv(BraxEnv):
    """One of Playground's whose physics is MuJoCo Warp's.

    Warp's own part of a world's data is scratch, laid out for all worlds together: it is not carried from step to step,
    where worlds begin anew one by one.
    """

    def __init__(self, env: Any, name: str, episode_length: int) -> None:
        super().__init__(env, name, episode_length)
        env._mjx_model = env.mjx_model.tree_replace(quieter(env.mjx_model))
        self._scratch = jax.jit(env.reset)(jax.random.PRNGKey(0)).data._impl

    def _before(self, inner: Any) -> Any:
        return inner.replace(data=inner.data.replace(_impl=self._scratch))

    def _after(self, inner: Any) -> Any:
        return inner.replace(data=inner.data.replace(_impl=None))


def _real(x: Any) -> jax.Array:
    return jnp.asarray(x, jnp.float32)


def _like(tree: Any, reference: Any) -> Any:
    """`tree` with the dtypes of `reference`: a state must not change its type from one step to the next."""
    return jax.tree.map(lambda x, ref: jnp.asarray(x, jnp.result_type(ref)), tree, reference)


def _groups(obs: Any) -> Observations:
    """Brax's and Playground's names of observation groups under ours."""
    if not isinstance(obs, Mapping):
        return {"policy": obs, "state": obs}
    groups = {**obs, "policy": obs["state"]}
    return {**groups, "critic": obs["privileged_state"]} if "privileged_state" in obs else groups


def make(name: str, *, config: "Config | None" = None, **overrides: Any) -> BraxEnv:
    """`brax:<name>` or `playground:<name>`; env.episodeLength (or the override) sets the episode's length.

    With `env.impl=warp` Playground's have their physics by MuJoCo Warp, which is these environments' own choice.
    """
    library, _, rest = name.partition(":")
    length = overrides.pop("episodeLength", None if config is None else config.env.episodeLength)
    impl = implementation(overrides.pop("impl", "jax" if config is None else config.env.impl))
    if overrides:
        raise UserError(f"env.{next(iter(overrides))}: {name} has no such setting (it has: episodeLength, impl)")
    if library == "playground":
        return make_playground(rest, length, impl == "warp")
    if impl == "warp":
        raise UserError(f"env.impl = 'warp': {name} is not simulated here; leave it out")
    return make_brax(rest, length)


def make_brax(name: str, episode_length: int | None = None) -> BraxEnv:
    """Make the Brax environment `name` on MJX, episodes of 1000 steps by default."""
    from brax import envs

    _known(name, list(envs._envs), "brax")
    return BraxEnv(envs.get_environment(name, backend="mjx"), f"brax:{name}", episode_length or 1000)


def make_playground(name: str, episode_length: int | None = None, warp: bool = False) -> BraxEnv:
    """Make the Playground environment `name` at its default settings, on MJX's JAX implementation or MuJoCo Warp."""
    try:
        from mujoco_playground import registry
    except ImportError as error:
        raise UserError(
            f"playground:{name} needs MuJoCo Playground: pip install 'bayessim-mjx[playground]' ({error})"
        ) from error
    _known(name, list(registry.ALL_ENVS), "playground")
    length = episode_length or registry.get_default_config(name).episode_length
    if not warp:
        return BraxEnv(registry.load(name, config_overrides={"impl": "jax"}), f"playground:{name}", length)
    try:
        return WarpEnv(registry.load(name, config_overrides={"impl": "warp"}), f"playground:{name}", length)
    except RuntimeError as error:
        raise without_warp(error) from None


def _known(name: str, names: list[str], library: str) -> None:
    if name not in names:
        close = difflib.get_close_matches(name, names)
        hint = f"did you mean {close[0]}? " if close else ""
        raise UserError(f"task {library}:{name}: {hint}there are: {', '.join(sorted(names))}")
