"""The protocol of what PPO can be extended by: hooks that do nothing unless an extension says otherwise.

An extension is a frozen dataclass whose fields are its settings; `catalogue` lists those that there are. Every hook but
`shown` and `check` runs inside a jitted program and is a pure function of arrays.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import jax
from jax.sharding import Mesh

from bayessim_mjx.config import PPOConfig
from bayessim_mjx.rl import normalise
from bayessim_mjx.rl.networks import Params
from bayessim_mjx.rl.segments import Batch
from bayessim_mjx.rl.sharding import EVERYWHERE
from bayessim_mjx.rl.state import TrainState

if TYPE_CHECKING:
    from bayessim_mjx.env import Env

Figures = dict[str, jax.Array]  # by TensorBoard tag


@dataclass(frozen=True)
class Learner:
    """What the hooks know of the training; none of it is traced."""

    env: Any  # as the learner sees it: with what extensions show
    config: PPOConfig
    extensions: tuple[Extension, ...] = ()  # the active ones
    mesh: Mesh | None = None

    @property
    def critic_group(self) -> str:
        """The observation group that the critic sees: "critic" where the environment has one, else "policy"."""
        return "critic" if "critic" in self.env.observation_size else "policy"


@dataclass(frozen=True)
class Sizes:
    """What the state of an extension is made for."""

    observation: Mapping[str, tuple[int, ...]]  # shape of each observation group
    action: int
    partial: jax.Array  # [N] 1 in worlds whose first episode began late, see `episodes.init`


class Extension:
    """Hooks in the order in which an update calls them.

    In what follows `own` is the extension's own state, None where `init` returns None. T control steps, N worlds.
    """

    name: ClassVar[str]  # in settings and checkpoints
    incompatible_with: ClassVar[Mapping[str, str]] = {}  # settings of `ppo:` or other extensions, and what to say then
    means: ClassVar[tuple[str, ...]] = ()  # tags that it reports, averaged over the log interval
    latest: ClassVar[tuple[str, ...]] = ()  # and those that are as they are at its end

    @classmethod
    def of(cls, config: PPOConfig) -> Extension | None:
        """Make the extension of the settings; None where they switch it off. For those with settings in `ppo:`."""
        raise NotImplementedError

    def shown(self, env: Env) -> Any:
        """Wrap the environment as the learner is to see it; the same object for the same environment."""
        return env

    def check(self, learner: Learner) -> None:
        """UserError where it does not go with the environment or the settings."""

    def groups(self, sizes: Mapping[str, tuple[int, ...]]) -> tuple[str, ...]:
        """Observation groups, of those in `sizes`, that it needs beside those of actor and critic."""
        return ()

    def init(self, key: jax.Array, sizes: Sizes, config: PPOConfig) -> Any:
        """Its state, a pytree of arrays, or None. PPO uses `key` itself: fold in a number of your own."""
        return None

    def reward(self, own: Any, data: dict, key: jax.Array, learner: Learner) -> tuple[Any, jax.Array | None, Figures]:
        """(its state after what was collected, a reward [T, N] to add, figures of any shape that are averaged).

        Args:
            own: its state.
            data: arrays [T, N, ...]: observation and final_observation by group, reward (the task's), terminated,
                truncated, extras.
            key: which PPO shuffles minibatches by: fold in a number of your own.
            learner: environment and settings.
        """
        return own, None, {}

    def attach(
        self,
        state: TrainState,
        data: dict,
        normalizer: Mapping[str, normalise.Moments],
        log_prob: jax.Array,
        learner: Learner,
    ) -> Any:
        """Arrays [T, N, ...] that go with the transitions into minibatches, there `batch.extra[name]`; None: nothing.

        Args:
            state: before this update.
            data: as for `reward`.
            normalizer: statistics of observations that the update learns with, by group.
            log_prob: [T, N] of the actions by the policy that took them.
            learner: environment and settings.
        """
        return None

    def samples(self, batch: Batch) -> Batch:
        """Add samples for surrogate and critic behind the batch, where there are some."""
        return batch

    def loss(
        self, params: Params, batch: Batch, means: jax.Array, learner: Learner
    ) -> tuple[jax.Array | None, Figures]:
        """Compute (a term to add to the loss of a minibatch, or None; figures without axes).

        Args:
            params: actor and critic.
            batch: B transitions, without what `samples` put behind.
            means: [B + ..., A] mean raw actions at these and behind them at the further samples.
            learner: environment and settings.
        """
        return None, {}

    def metrics(self, own: Any, figures: Figures, learner: Learner) -> Figures:
        """Figures after the update, without axes; `figures` are those of PPO itself."""
        return {}

    def layout(self, own: Any) -> Any:
        """`own` with the layout of each array instead, see `sharding`: FIRST for those of worlds [N, ...]."""
        return jax.tree.map(lambda _: EVERYWHERE, own)

    def in_worlds_of(self, own: Any, other: Any) -> Any:
        """`own` with the sums over worlds of `other`: learning goes on in new worlds."""
        return own
