"""Env: Brax's functional protocol plus `reset(key, theta)`; Task: the base of the MuJoCo tasks in tasks/."""

from bayessim_mjx.env.protocol import Env, Observations, State
from bayessim_mjx.env.task import Task

__all__ = ["Env", "Observations", "State", "Task"]
