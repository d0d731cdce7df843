"""The configuration that flags ask for, and the names of tasks."""

import argparse
import dataclasses
import sys
import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from bayessim_mjx.cli.flags import FLAGS, RESUMABLE, ZERO_IS_NONE
from bayessim_mjx.config import Config, load, replace
from bayessim_mjx.errors import UserError

if TYPE_CHECKING:
    from bayessim_mjx.runs import Run


def config_of(args: argparse.Namespace, more: Mapping[str, tuple[str, Any]] | None = None) -> Config:
    """Return the configuration of flags (and `more` like them), files and overrides; the task has to exist."""
    flags = dict(more or {})
    for flag, (key, _, _) in FLAGS.items():
        value = getattr(args, flag[2:], None)  # not every command has every flag
        if value is not None and not (flag in ZERO_IS_NONE and value == 0):
            flags[flag] = (key, _drawn() if flag == "--seed" and value == -1 else value)
    task = args.task and task_name(args.task)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        settings = load(task, cfg_env=args.cfg_env, cfg_train=args.cfg_train, flags=flags, overrides=args.overrides)
    for warning in caught:
        print(f"note: {warning.message}", file=sys.stderr)
    task_name(settings.task)
    if args.idle:
        raise UserError(f"{args.idle[0]}: {args.command} has no use for it; leave it out")
    return settings


def _drawn() -> int:
    """Return a seed from the system."""
    import random  # here, so that commands start fast

    return random.SystemRandom().randrange(10_000)


def resumed_config(args: argparse.Namespace, config: Config, also: Sequence[str] = ()) -> Config:
    """Return the settings of the run to resume; only devices, cache and videos may change.

    The run's own task may be named: that allows its file.

    also: further flags that the command takes; it sees to what they set.
    """
    same = ("--task",) if args.task and task_name(args.task) == config.task else ()
    fixed = [flag for flag in args.given if flag not in (*RESUMABLE, *same, *also)] + list(args.overrides)
    if fixed:
        raise UserError(f"--resume goes on with the run's own settings, which {fixed[0]} would change; start a new run")
    video = {k: getattr(args, k) for k in ("video_length", "video_interval", "video") if getattr(args, k) is not None}
    top = {k: getattr(args, k) for k in ("device", "devices", "cache_dir") if getattr(args, k) is not None}
    monitor = dataclasses.replace(config.monitor, **video)
    return dataclasses.replace(config, monitor=monitor, **top)


def prolonged_config(args: argparse.Namespace, run: "Run") -> Config:
    """Return the settings of the run of PPO alone to resume, with `--max_iterations` in all; the run may be finished.

    Raises:
        UserError: the run has done as many iterations already.
    """
    config, total = resumed_config(args, run.config, ("--max_iterations",)), args.max_iterations
    if total is None:
        return config
    done = run.manifest["latest"] or 0
    if total <= done:
        raise UserError(
            f"--max_iterations {total}: the run has done {done} PPO iterations already; give more, the number in all"
        )
    return replace(config, ppo={"max_iterations": total})


def say_changes(run: "Run", console: Any) -> None:
    """Warn of all that is not as it was when the run to go on with was started; its manifest keeps it."""
    for text in run.resumed():
        console.warning(f"changed since the run was started: {text}")


def task_name(name: str) -> str:
    """Return the task's proper name; UserError with the close ones where there is none, or where its file has none."""
    from bayessim_mjx import registry
    from bayessim_mjx.outside_tasks import is_file

    registry.no_file(name, "--task")
    if is_file(name):
        registry.class_of(name)
        return name
    if name.split(":")[0] in registry.EXTERNAL and ":" in name:
        return name
    return registry.proper(name, "--task")


def list_tasks() -> int:
    """Print the names of our own tasks."""
    from bayessim_mjx import registry

    print("\n".join(registry.names()))
    return 0
