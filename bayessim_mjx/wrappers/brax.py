"""Brax's trainers on our tasks, which follow the protocol of its environments as they are.

`train(task, domain)` is its PPO on one of them under a distribution over the physics; its other trainers take
`ours(task, domain)` as environment and `wrap` as `wrap_env_fn`. Its environments for our trainer are in `external`.
"""

from typing import Any

from bayessim_mjx.env import Env
from bayessim_mjx.external import BraxEnv, make_brax, make_playground
from bayessim_mjx.wrappers.fresh import Under
from bayessim_mjx.wrappers.worlds import environment

__all__ = ["BraxEnv", "make_brax", "make_playground", "ours", "train"]


def ours(task: Any, domain: Any = None, **env_settings: Any) -> Under:
    """Make a task, or a run's task under its posterior (arguments as `wrappers.worlds.worlds`), for Brax's trainers."""
    return Under(*environment(task, domain, env_settings))


def train(task: Any, domain: Any = None, **settings: Any) -> tuple[Any, Any, dict]:
    """Brax's PPO on `ours(task, domain)`: (function that makes a policy of parameters, parameters, metrics).

    Every episode begins anew, with its own physics. Schedules begin with training; in evaluations they are over.
    `settings` are those of `brax.training.agents.ppo.train.train`;
    `episode_length` is the task's own unless given.
    """
    from brax.training.agents.ppo import train as ppo

    from bayessim_mjx.wrappers.fresh import wrap

    env = task if isinstance(task, Env) and domain is None else ours(task, domain)
    judged = Under(env.env, env.domain, True) if isinstance(env, Under) else Under(env, None, True)
    own = {"episode_length": env.episode_length, "eval_env": judged}
    return ppo.train(environment=env, wrap_env_fn=wrap, **(own | settings))
