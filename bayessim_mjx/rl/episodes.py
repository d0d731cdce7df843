"""Returns and lengths of the episodes seen while training: running sums per world, and a window of the last ones."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from bayessim_mjx.env.finite import NOT_FINITE
from bayessim_mjx.physics.warp import OVERFLOW
from bayessim_mjx.rl.sharding import FIRST

WINDOW = 100
TERM = "reward_"  # how metrics are called that are parts of the reward


@struct.dataclass
class Episodes:
    """Statistics as plain arrays; part of the training state."""

    running_return: jax.Array  # [N] of the unfinished episodes, unscaled rewards
    running_length: jax.Array  # [N]
    partial: jax.Array  # [N] 1 while in an episode whose clock did not start at 0
    returns: jax.Array  # [WINDOW] of finished episodes, a ring
    lengths: jax.Array  # [WINDOW]
    finished: jax.Array  # [] int32, episodes finished in all


def init(partial: jax.Array) -> Episodes:
    """No episodes yet; partial [N] marks worlds whose first time limit comes early: it does not count as an episode."""
    zeros = jnp.zeros_like(partial)
    return Episodes(zeros, zeros, partial, jnp.zeros(WINDOW), jnp.zeros(WINDOW), jnp.zeros((), jnp.int32))


def layout(everywhere: Any) -> Any:
    """Where the counters lie, of their layout `everywhere`: the running sums with their worlds."""
    return replace(everywhere, running_return=FIRST, running_length=FIRST, partial=FIRST)


def update(episodes: Episodes, reward: jax.Array, terminated: jax.Array, truncated: jax.Array) -> Episodes:
    """Add time-major steps, [T, N] each."""

    def step(carry: tuple, now: tuple) -> tuple[tuple, tuple]:
        total, length, partial = carry
        reward, terminated, truncated = now
        total, length = total + reward, length + 1
        going = (1 - terminated) * (1 - truncated)
        counts = (1 - going) * (1 - partial * truncated) > 0
        return (total * going, length * going, partial * going), (total, length, counts)

    carry = (episodes.running_return, episodes.running_length, episodes.partial)
    carry, (totals, lengths, counts) = jax.lax.scan(step, carry, (reward, terminated, truncated))
    counts = counts.reshape(-1)
    rank = jnp.cumsum(counts)  # 1 for the first finished one
    last = counts & (rank > rank[-1] - WINDOW)
    slot = jnp.where(last, (episodes.finished + rank - 1) % WINDOW, WINDOW)  # WINDOW: out of range, dropped
    return Episodes(
        *carry,
        returns=episodes.returns.at[slot].set(totals.reshape(-1), mode="drop"),
        lengths=episodes.lengths.at[slot].set(lengths.reshape(-1), mode="drop"),
        finished=episodes.finished + rank[-1],
    )


def metrics(episodes: Episodes) -> dict[str, jax.Array]:
    """Means over the window; nan until an episode has finished."""
    seen = jnp.arange(WINDOW) < episodes.finished
    count = jnp.where(episodes.finished > 0, jnp.minimum(episodes.finished, WINDOW), jnp.nan)
    return {
        "Train/mean_reward": jnp.where(seen, episodes.returns, 0).sum() / count,
        "Train/mean_episode_length": jnp.where(seen, episodes.lengths, 0).sum() / count,
    }


def tags_of_steps(metrics: dict[str, jax.Array]) -> dict[str, str]:
    """{tag: metric} of those of a task's metrics, `[N, ...]`, that are one number a world."""
    return {_tag(name): name for name, x in metrics.items() if x.ndim == 1}


def _tag(name: str) -> str:
    if name.startswith(TERM):
        return f"Reward/{name.removeprefix(TERM)}"
    return f"{'Train' if name == OVERFLOW or name.startswith(NOT_FINITE) else 'Metric'}/{name}"


def of_steps(data: dict[str, Any]) -> dict[str, jax.Array]:
    """Mean per step of each of the task's metrics, of what was collected."""
    return {_tag(name): x.mean() for name, x in data["metrics"].items()}
