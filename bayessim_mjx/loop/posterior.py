"""The posterior that a run ended with, for whoever draws physics from it: play, wrappers, a program of one's own."""

from __future__ import annotations

from pathlib import Path

from bayessim_mjx.config import Config
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.env import Env
from bayessim_mjx.loop.state import chart_of
from bayessim_mjx.parameters.ranged import Ranged
from bayessim_mjx.runs import checkpoints


def restored(checkpoint: Path, env: Env, config: Config) -> Distribution | None:
    """What a checkpoint's next round would draw physics from; None where it is not one of the adaptive loop.

    Args:
        checkpoint: its folder.
        env: the run's environment, or one with the same parameters.
        config: the run's settings.
    """
    if not checkpoints.has(checkpoint, "state.domain"):
        return None
    own = checkpoints.chart(checkpoint, "state.domain") or chart_of(config.bayessim, env.space)
    moves = checkpoints.has(checkpoint, "state.domain.space")
    like = Distribution.prior(Ranged(env.space) if moves else env.space, config.bayessim.components, own)
    return checkpoints.restore(checkpoint, {"state.domain": like})[0]["state.domain"]
