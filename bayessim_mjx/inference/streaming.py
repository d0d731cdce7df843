"""Summaries computed step by step inside a rollout, so that the trajectory need not be stored.

corr, corrdiff (any lags) and both signatures stream in memory of their own size. start and waypts *are* rows of the
trajectory, and summary_learned is the whole of it: for those the trajectory is stored.
"""

from __future__ import annotations

from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import summaries
from bayessim_mjx.inference.summaries import Stream

__all__ = ["Stream", "stream"]


def stream(name: str, steps: int, state_size: int, action_size: int, **options: int) -> Stream:
    """The streaming form of summarizer `name` for trajectories of `steps` actions; names and options as in `get`.

    Raises:
        UserError: if the summary has no streaming form, is too large, or `steps` are too few.
    """
    summary, given = summaries.entry(name)
    if summary.stream is None:
        others = [n.removeprefix("summary_") for n in summaries.names() if summaries.entry(n)[0].stream is not None]
        raise UserError(f"{summary.name} has no streaming form; {', '.join(others[:-1])} and {others[-1]} have one")
    return summary.stream(steps, state_size, action_size, **{**given, **options})
