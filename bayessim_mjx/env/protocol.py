"""Brax's functional protocol plus `reset(key, theta)`.

An environment never resets itself: `done` is the termination of this step, `info["truncated"]` the time limit.
"""

import abc
import functools
from typing import Any

import jax
import mujoco
import numpy as np
from flax import struct

from bayessim_mjx import compat
from bayessim_mjx.mirrors import MirrorMap
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics.nuisance import Nuisance

compat.supply()  # our environments are Brax's too: so that Brax's own trainers can run

Observations = dict[str, jax.Array]


class State(struct.PyTreeNode):
    """What `reset` and `step` return; Brax's field names.

    Attributes:
        pipeline_state: what the next step needs (`World` in our own tasks).
        obs: groups of observations, "policy" always; "state" and "privileged_state" are the names Brax looks up.
        reward: `[]` float32; done: `[]` float32, 1 where this step terminated the episode.
        metrics: scalars to look at.
        info: `terminated`, `truncated` (float32), `final_observation` (this step's obs, before any auto-reset), `steps`
            (int32, since reset); wrappers may add keys, which are kept.
    """

    pipeline_state: Any
    obs: Observations
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array] = struct.field(default_factory=dict)
    info: dict[str, Any] = struct.field(default_factory=dict)


class Env(abc.ABC):
    """An environment. Pure and stateless: `reset` and `step` may be jitted, vmapped and scanned."""

    name: str = ""
    backend: str = "mjx"
    episode_length: int
    mirrors: tuple[MirrorMap, ...] = ()
    nuisance: Nuisance | None = None  # with it, reset takes a `Course` too, and info["nuisance"] is a `Drawn`

    @abc.abstractmethod
    def reset(self, key: jax.Array, theta: jax.Array | None = None) -> State:
        """Start an episode with parameters `theta` `[d]` (None: nominal)."""

    @abc.abstractmethod
    def step(self, state: State, action: jax.Array) -> State:
        """One control step with `action` `[action_size]` in [-1, 1]."""

    @property
    @abc.abstractmethod
    def action_size(self) -> int:
        """Number of actions."""

    @property
    @abc.abstractmethod
    def dt(self) -> float:
        """Control step, s."""

    @property
    @abc.abstractmethod
    def space(self) -> ParameterSpace:
        """The randomised parameters."""

    @property
    @abc.abstractmethod
    def mj_model(self) -> mujoco.MjModel:
        """The nominal MuJoCo model."""

    @functools.cached_property
    def observation_size(self) -> dict[str, tuple[int, ...]]:
        """Shape of each observation group."""
        state = jax.eval_shape(self.reset, jax.random.PRNGKey(0))
        return {group: value.shape for group, value in state.obs.items()}

    def marks(self, qpos: np.ndarray, observation: np.ndarray) -> np.ndarray | None:
        """Poses `[T, nmocap, 7]` (m, quaternion) of the model's mocap bodies, as goals that pictures show; None: none.

        Args:
            qpos: `[T, nq]`, as measured.
            observation: `[T, S]` of the group "policy".
        """
        return None

    @property
    def unwrapped(self) -> "Env":
        """The environment itself."""
        return self
