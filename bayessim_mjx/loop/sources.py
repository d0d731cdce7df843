"""Where real trajectories come from: a surrogate real (the simulator at hidden parameters), or recorded logs.

Both are turned into summaries by the same function as the simulated trajectories, so the features always mean the same.
"""

from __future__ import annotations

from bayessim_mjx.config import Config
from bayessim_mjx.env import Env
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import summarizers
from bayessim_mjx.loop.collection import policy_function
from bayessim_mjx.loop.range_limits import limits_of
from bayessim_mjx.loop.real_parameters import real_parameters
from bayessim_mjx.loop.recorded import Recorded, recorded
from bayessim_mjx.loop.seen import Seen
from bayessim_mjx.loop.surrogate import Surrogate

__all__ = ["Recorded", "Seen", "Source", "Surrogate", "make_source", "policy_function", "real_parameters"]

Source = Surrogate | Recorded


def make_source(config: Config, env: Env) -> Source:
    """The real side that `config` asks for: logs if `real.logs` is set, else the surrogate of `env.realParams`."""
    summarizer = summarizers.get(config.bayessim.summarizerFxn)
    if config.real.logs:
        return recorded(config, env, summarizer)
    if config.bayessim.collectPolicy == "policy_replay":
        raise UserError("bayessim.collectPolicy=policy_replay replays logged commands and needs real.logs=DIR")
    b = config.bayessim
    ends = limits_of(env) if b.range_ends == "move" else None  # reality may lie beyond a range that may move
    weights, means, sds = real_parameters(config.env.realParams, env.space, ends)
    return Surrogate(
        env, env.space, weights, means, sds, b.collectPolicy, b.trainTrajLen, config.real.noise, summarizer, ends
    )
