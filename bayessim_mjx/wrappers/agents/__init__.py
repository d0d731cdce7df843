"""Other libraries' PPO in our commands: `train --agent sb3`. Their networks become policies of ours at checkpoints.

So `play`, videos, ONNX and `main --checkpoint` work with them as with ours. Every setting of `ppo:` reaches the library
or is refused by its name: those that none of them has are in `OURS`, those of one library in its `refuse`.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from bayessim_mjx.config import Config
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import Policy
from bayessim_mjx.rl.groups import size_of
from bayessim_mjx.wrappers.worlds import Worlds

Progress = Callable[[Mapping[str, float]], None]

# settings that only our own PPO has, with the values at which they ask for nothing
OURS: dict[str, tuple[Any, ...]] = {
    "memory": (0,), "policy_theta": (False,), "critic_theta": (False,), "shared_trunk": (False,), "segment": (0,),
    "memory_layers": (1,), "gradient_length": (0,), "actor_groups": ((), []), "critic_groups": ((), []),
    "distribution": ("gaussian",), "std_type": ("log",), "std_range": ((), []),
    "state_dependent_std": (False,), "teacher": (None,), "extensions": ((), []), "action_bound": ("clip",),
    "action_clip": (1.0,), "symmetry": (None,), "rnd": (None,),
    "precision": ("float32",), "weight_init": ("orthogonal",), "normalize_advantage_per_minibatch": (False,),
}  # fmt: skip


class Agent(Protocol):
    """A library's PPO on worlds of ours."""

    iteration: int  # PPO iterations done

    def learn(self, iterations: int) -> dict[str, float]:
        """Go on for so many iterations; what to log of the last one, by our tags."""

    def policy(self) -> Policy:
        """Return the policy now, at its mean."""

    def save(self, folder: Path) -> None:
        """Networks, optimizer and scales into an empty folder."""

    def load(self, folder: Path) -> None:
        """Load what `save` wrote there; episodes begin anew."""


def make(config: Config, env: Any, domain: Any) -> Agent:
    """Make the agent that `config.agent` names, with the settings of `ppo:` in its library's terms.

    Raises:
        UserError: as `check`.
    """
    module = check(config, env)
    scale = config.ppo.reward_scale
    return module.make(config, Worlds(env, domain, config.ppo.num_envs, config.seed, reward_scale=scale))


def check(config: Config, env: Any) -> Any:
    """Check that `config.agent` can train on `env` and return its module; nothing is made yet.

    Raises:
        UserError: the library is not installed; a setting that its PPO has not; observations that are no vectors.
    """
    module = importlib.import_module(f"bayessim_mjx.wrappers.agents.{config.agent}")
    refuse(config, module.TAKES, module.ACTIVATIONS)
    size_of(env, "policy")
    if "critic" in env.observation_size:
        size_of(env, "critic")
    module.refuse(config, env)
    return module


def refuse(config: Config, takes: Sequence[str], activations: Collection[str]) -> None:
    """UserError for the first setting that `config.agent` does not have."""
    if config.bayessim.policyCheckpt is not None:
        raise UserError(f"--checkpoint: --agent {config.agent} begins with a policy of its own; leave it out")
    if config.devices != "1":
        raise UserError(f"devices = {config.devices!r}: --agent {config.agent} trains on one device; leave it out")
    for name, neutral in OURS.items():
        value = getattr(config.ppo, name)
        if name not in takes and value not in neutral:
            allowed = neutral[0]
            raise UserError(
                f"ppo.{name} = {value!r}: --agent {config.agent} has no such thing; allowed is {allowed!r}, or train "
                "with our own PPO (leave --agent out)"
            )
    if config.ppo.activation not in activations:
        allowed = ", ".join(activations)
        raise UserError(f"ppo.activation = {config.ppo.activation!r}: --agent {config.agent} takes {allowed}")
