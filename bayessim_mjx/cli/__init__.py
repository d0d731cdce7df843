"""What the commands share: flags, configuration from them, checkpoints by name, clean ends. No jax before parsing."""

from bayessim_mjx.cli.commands import COMMANDS, SCRIPT, prog_of
from bayessim_mjx.cli.ends import DEBUG_VARIABLE, command
from bayessim_mjx.cli.flags import Parser
from bayessim_mjx.cli.folders import open_run, run_to_resume, writable
from bayessim_mjx.cli.parsers import PlainParser, integer, of_urdf, one_robot, positive, task, urdf_words, whole
from bayessim_mjx.cli.policies import (
    find_checkpoint,
    load_policy,
    of_another_task,
    origin,
    physics_settings,
    pin_policy,
    privileged,
    warm_start,
)
from bayessim_mjx.cli.settings import config_of, list_tasks, prolonged_config, resumed_config, say_changes, task_name
from bayessim_mjx.cli.status import Stop, first_writes, graceful, running

__all__ = [
    "COMMANDS", "DEBUG_VARIABLE", "SCRIPT", "Parser", "PlainParser", "Stop", "command", "config_of", "find_checkpoint",
    "first_writes", "graceful", "integer", "list_tasks", "load_policy", "of_another_task", "of_urdf", "one_robot",
    "open_run", "origin", "physics_settings", "pin_policy", "positive", "privileged", "prog_of", "prolonged_config",
    "resumed_config", "run_to_resume", "running", "say_changes", "task", "task_name", "urdf_words", "warm_start",
    "whole", "writable",
]  # fmt: skip
