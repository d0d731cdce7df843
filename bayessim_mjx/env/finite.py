"""A task's numbers that are not finite: the learner gets 0 in their place, and metrics count them by part."""

from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp

NOT_FINITE = "not_finite_"  # how metrics are called that count, of a healthy world's step: 1 where a part has no number
REWARD, GROUP, METRIC = "reward", "observation_", "metric_"


def finite(x: jax.Array) -> jax.Array:
    """Return the numbers with 0 where one is not finite."""
    return jnp.where(jnp.isfinite(x), x, 0.0)


def counted(sound: Any, groups: Mapping[str, Any], reward: Any, metrics: Mapping[str, Any]) -> dict[str, jax.Array]:
    """Count, as metrics of a step, the parts of what a task returned that are not finite.

    Args:
        sound: whether the world is healthy; one that diverged counts nowhere.
        groups, reward, metrics: as the task's methods returned them.
    """
    parts = {REWARD: reward} | {GROUP + name: x for name, x in groups.items()}
    parts |= {METRIC + name: x for name, x in metrics.items()}
    return {NOT_FINITE + part: (sound & ~jnp.isfinite(x).all()).astype(jnp.float32) for part, x in parts.items()}


def shares(metrics: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield (name, words for the part) of the metrics that count: reward, observations, metrics."""
    for name in sorted(metrics, reverse=True):  # jax gives dicts back by the alphabet, which has them the other way
        part = name.rpartition("/")[2]
        if part.startswith(NOT_FINITE):
            yield name, _words(part.removeprefix(NOT_FINITE))


def _words(part: str) -> str:
    if part.startswith(GROUP):
        return f"the observation group {part.removeprefix(GROUP)!r}"
    return "the reward" if part == REWARD else f"the metric {part.removeprefix(METRIC)!r}"
