"""The training state: all that the next update needs, as plain arrays."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
from jax.sharding import Mesh
from jax.tree_util import GetAttrKey

from bayessim_mjx.config import PPOConfig
from bayessim_mjx.rl import episodes, networks, normalise, sharding
from bayessim_mjx.rl.networks import Policy


@jax.tree_util.register_pytree_with_keys_class
@dataclasses.dataclass(frozen=True)
class TrainState:
    """Saving and restoring it resumes training bit for bit (CPU).

    As a pytree, an extension's state lies beside the other fields under the extension's own name, so that checkpoints
    have leaves "rnd.predictor..." whatever else is registered. `config` and `mesh` are no arrays.
    """

    params: networks.Params
    opt_state: Any  # Adam over the flattened parameters
    normalizer: dict[str, normalise.Moments]  # by observation group
    learning_rate: jax.Array  # []
    env_states: Any  # State with leading axis num_envs
    episodes: episodes.Episodes
    key: jax.Array  # [2] uint32
    iteration: jax.Array  # [] int32
    env_steps: jax.Array  # [] uint32
    config: PPOConfig  # that the networks were made with
    extensions: dict[str, Any] = dataclasses.field(default_factory=dict)  # states of those that keep one, by name
    mesh: Mesh | None = None  # of the devices that share the worlds

    def replace(self, **changes: Any) -> TrainState:
        """Return a copy with other fields."""
        return dataclasses.replace(self, **changes)

    def tree_flatten_with_keys(self) -> tuple[list[tuple[GetAttrKey, Any]], Any]:
        names = tuple(sorted(self.extensions))
        own = [(GetAttrKey(name), getattr(self, name)) for name in ARRAYS]
        return [*own, *((GetAttrKey(name), self.extensions[name]) for name in names)], (names, self.config, self.mesh)

    @classmethod
    def tree_unflatten(cls, static: Any, leaves: Any) -> TrainState:
        names, config, mesh = static
        fields, more = dict(zip(ARRAYS, leaves, strict=False)), leaves[len(ARRAYS) :]
        return cls(**fields, config=config, extensions=dict(zip(names, more, strict=True)), mesh=mesh)


FIELDS = tuple(f.name for f in dataclasses.fields(TrainState))
ARRAYS = tuple(name for name in FIELDS if name not in ("config", "extensions", "mesh"))  # in the order of checkpoints


def policy_of(state: TrainState) -> Policy:
    """Make the policy of a training state, with its normaliser; of several devices, as host arrays."""
    config = state.config
    policy = Policy(
        actor=state.params["actor"],
        normalizer=state.normalizer["policy"],
        activation=config.activation,
        normalize=config.normalize_observations,
        action_clip=config.action_clip,
        squash=config.action_bound == "tanh",
        std_range=config.std_range,
        beta=config.distribution == "beta",
    )
    return sharding.at_home(policy)
