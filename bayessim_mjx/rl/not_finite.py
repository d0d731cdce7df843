"""What the user hears of a task whose numbers are not finite: an error as training begins, later a warning."""

from __future__ import annotations

import warnings
from collections.abc import MutableMapping
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from bayessim_mjx.env.finite import shares
from bayessim_mjx.errors import UserError
from bayessim_mjx.quantities import percent

if TYPE_CHECKING:
    from bayessim_mjx.env import Env
    from bayessim_mjx.rl.state import TrainState

DO = "mend it where it divides by 0, or takes a root or logarithm of what may be negative"


def at_reset(env: Env, state: TrainState) -> None:
    """Refuse a task some of whose first observations are not finite, before anything is learnt.

    Raises:
        UserError: naming the task, the part and its share of the worlds.
    """
    metrics = getattr(state.env_states, "metrics", {})
    if int(state.iteration) or jax.process_count() > 1:
        return
    found = {words: float(np.mean(metrics[name])) for name, words in shares(metrics)}
    _refuse(env, found, "the worlds, at reset")


def watch(env: Env, metrics: dict[str, Any], iteration: int, begins: bool, seen: MutableMapping[str, int]) -> None:
    """Refuse or warn where an interval of training has such numbers; drop the curves of parts that never had.

    Args:
        env: the task.
        metrics: of the interval.
        iteration: after it.
        begins: whether training began with this interval: then it is refused.
        seen: {tag: iteration at which it was above 0 first}; those of this interval are added.

    Raises:
        UserError: as `at_reset`, of the steps of the first interval.
    """
    found = dict(shares(metrics))
    new = {tag: words for tag, words in found.items() if metrics[tag] > 0 and tag not in seen}
    if begins:
        _refuse(
            env,
            {words: metrics[tag] for tag, words in new.items()},
            f"the steps of the first {iteration} iteration{'s' if iteration > 1 else ''}",
        )
    for tag, words in new.items():
        seen[tag] = iteration
        warnings.warn(
            f"task {env.name}: {words} is not finite in {percent(metrics[tag])} of the steps, first before iteration "
            f"{iteration}. 0 stands in its place, so that the policy may learn to reach these states. Stop and {DO}; "
            f"{tag} has the curve",
            stacklevel=3,
        )
    for tag in found:
        if tag not in seen:
            del metrics[tag]


def evaluated(env: Env, lost: dict[str, Any]) -> None:
    """Warn of episodes that were evaluated with such numbers. lost: {metric: [n], 1 where an episode had some}."""
    for name, words in shares(lost):
        if (share := float(np.mean(lost[name]))) > 0:
            warnings.warn(
                f"task {env.name}: {words} is not finite in {percent(share)} of the episodes that were evaluated, and "
                f"0 stands in its place; {DO}",
                stacklevel=4,
            )


def _refuse(env: Env, found: dict[str, float], of: str) -> None:
    """UserError where a share is above 0."""
    told = ", ".join(f"{words} in {percent(share)}" for words, share in found.items() if share > 0)
    if told:
        raise UserError(
            f"task {env.name}: not finite are {told} of {of}, in worlds that have not diverged; {DO} (docs/own_task.md)"
        )
