"""What the numbers of a summary mean, in words: "corr(angle, torque) lag 1"."""

from __future__ import annotations

from collections.abc import Sequence

from bayessim_mjx.config.names import SUMMARIES
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import summaries
from bayessim_mjx.inference.summarizers import get, size


def names(summary: str, steps: int, states: Sequence[str], actions: Sequence[str]) -> tuple[str, ...]:
    """A name for every feature of `summary` (as in summarizers.get) of trajectories of `steps` actions, in order.

    Raises:
        UserError: a user's own summary that fails, or gives other numbers of names and features.
    """
    entry, options = summaries.entry(summary)
    if entry.name in SUMMARIES.library and entry.names is not None:
        return tuple(entry.names(steps, states, actions, **options))
    try:
        count = size(get(summary), steps, len(states), len(actions))
        short = entry.name.removeprefix("summary_")
        if entry.names is None:
            return tuple(f"{short} {i + 1}" for i in range(count))
        own = tuple(entry.names(steps, states, actions, **options))
    except Exception as error:
        raise UserError(f"{entry.name} fails on trajectories of {steps} steps: {error}") from error
    if len(own) != count:
        raise UserError(f"{entry.name} names {len(own)} features and gives {count}")
    return own
