"""Rollouts: one whole episode per world, logged commands replayed, or endless collection with resets."""

from bayessim_mjx.rollout.collection import collect, next_episodes, ring, strong
from bayessim_mjx.rollout.episodes import PolicyFn, Trajectory, as_pytree, rollout, select, traced
from bayessim_mjx.rollout.open_loop import recording, remembered, replay, started

__all__ = [
    "PolicyFn", "Trajectory", "as_pytree", "collect", "next_episodes", "recording", "remembered", "replay", "ring",
    "rollout", "select", "started", "strong", "traced",
]  # fmt: skip
