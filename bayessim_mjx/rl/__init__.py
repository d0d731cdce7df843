"""Proximal policy optimisation on batched worlds; every update is one jitted program."""

from bayessim_mjx.rl import ppo
from bayessim_mjx.rl.evaluate import evaluate, evaluate_together
from bayessim_mjx.rl.extension import Extension
from bayessim_mjx.rl.networks import Policy
from bayessim_mjx.rl.ppo import init, make_update
from bayessim_mjx.rl.state import TrainState, policy_of
from bayessim_mjx.rl.train import run, start, train

__all__ = [
    "Extension",
    "Policy",
    "TrainState",
    "evaluate",
    "evaluate_together",
    "init",
    "make_update",
    "policy_of",
    "ppo",
    "run",
    "start",
    "train",
]
