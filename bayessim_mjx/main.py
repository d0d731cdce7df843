"""`bayessim-mjx COMMAND`, the console script, and its command `main`: adaptive domain randomisation.

`python -m bayessim_mjx.main` is `bayessim-mjx main`, and so for the module of every command.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from bayessim_mjx import cli, trust
from bayessim_mjx.cli import commands
from bayessim_mjx.config import Config, to_yaml
from bayessim_mjx.device import setup_jax
from bayessim_mjx.errors import UserError, unknown

ABOUT = """\
Policies that hold on the real system: adaptive domain randomisation with
BayesSim, and diagnosis of the gap between a simulator and recorded motion."""
AFTER = f"""\
`{cli.SCRIPT} help COMMAND` shows flags, defaults and examples of a command.
Documentation: {commands.SITE}"""
DESCRIPTION = (
    "Adaptive domain randomisation: rounds of PPO training, evaluation, simulation and inference of the physics."
)
COMPLETION = (
    'Print a script of completions. bash: eval "$(bayessim-mjx completion bash)" in ~/.bashrc; '
    "fish: bayessim-mjx completion fish | source; zsh: write it to _bayessim-mjx in a folder of $fpath."
)


class Watched:
    """The loop's monitor and checkpoints with stops at whole states: after a log interval, and after a round is saved.

    What is reported lies on the disk before the checkpoint that follows it: a resumed run repeats nothing before that.
    """

    def __init__(self, session: Any, stop: cli.Stop, run: Any, parts: Any):
        self.session, self.stop, self.run, self.parts = session, stop, run, parts

    def training(self, round_: int, metrics: dict[str, float], state: Any) -> None:
        from bayessim_mjx import loop

        self.session.training(round_, metrics, state)
        if self.stop.requested:
            step, tree = loop.checkpoint_step(self.parts, round_, state.train), loop.tree_of(self.parts, state)
            self.save(step, tree, meta=loop.meta_of(state))

    def part(self, round_: int, name: str) -> None:
        self.stop.when = "at the end of this round, which may take minutes"
        self.session.part(round_, name)

    def round(self, info: Any, policy: Any) -> None:
        self.session.round(info, policy)  # no stop here: the round is not saved yet

    def save(
        self,
        step: int,
        tree: Any,
        *,
        evaluation: float | None = None,
        meta: dict | None = None,
        supersede: bool = False,
    ) -> None:
        self.session.flush()
        clock = {**(meta or {}), "seconds": self.session.wall.mark()}
        self.run.save(step, tree, evaluation=evaluation, meta=clock, supersede=supersede)
        if not self.parts.finished(tree["state"]):
            self.stop.check()
            self.stop.when = cli.Stop.when


def _parser() -> cli.Parser:
    return cli.Parser("main", DESCRIPTION, resume=True)


def _prepare(args: argparse.Namespace) -> tuple[Config, Any]:
    """Return (settings, run to go on with or None)."""
    if args.resume:
        run = cli.run_to_resume(args.resume, "main")
        if args.max_iterations is not None:
            raise UserError(
                "--max_iterations: all rounds of a run have the same number, also those that are done; to train longer "
                f"under its posterior: bayessim-mjx train --domain {run.path} --checkpoint {run.path} "
                f"--max_iterations {args.max_iterations}"
            )
        return cli.resumed_config(args, run.config), run
    more = {"--checkpoint": ("bayessim.policyCheckpt", args.checkpoint)} if args.checkpoint else {}
    config = cli.pin_policy(cli.config_of(args, more))
    if config.ppo.teacher is not None:
        raise UserError(
            f"ppo.teacher = {config.ppo.teacher!r}: main has no use for it; use bayessim-mjx train --distil RUN"
        )
    if config.domain is not None:
        raise UserError(
            f"domain = {config.domain!r}: main draws from its own posterior; use bayessim-mjx train --domain"
        )
    if config.agent != "own":
        raise UserError(f"agent = {config.agent!r}: main has our own PPO alone; use bayessim-mjx train --agent")
    return config, None


def _run(config: Config, run: Any, device: Any, command: Sequence[str], console: Any) -> int:
    from bayessim_mjx import loop, registry, runs
    from bayessim_mjx.monitor.clock import CompileClock
    from bayessim_mjx.monitor.opening import opening

    env = registry.make(config.task, config=config)
    other = "" if run is not None else cli.of_another_task(config, env)
    console.start(opening(config, env, device))
    if other:
        console.warning(other)
    console.phase("compiling the training")
    compiling = CompileClock()
    try:
        parts = loop.make(config, env)
        config = parts.config  # with the surrogate's parameters: the run keeps them
        state, resumed_at = _state(parts, run, console)
    except KeyboardInterrupt:
        console.say("interrupted while compiling: nothing was written; give the same command again")
        raise
    compiling.report(console, "the training")
    if run is None:
        run = runs.Run.create(config.logdir, config.task, config.name, config, command)
    else:
        cli.say_changes(run, console)
    console.say(f"run folder {run.path}")
    with cli.running(run, console.say):
        if parts.finished(state):
            console.say("this run had finished; there is nothing to go on with")
        else:
            state = _rounds(parts, state, run, console, resumed_at)
        _report(console, parts, state)
    which = "best" if run.manifest["best"] is not None else "latest"
    console.command(f"{which} policy", f"{cli.prog_of('play')} --checkpoint {run.path}{trust.flags()} --video")
    console.command("pictures", f"tensorboard --logdir {run.path} --samples_per_plugin images=1000")
    return 0


def _state(parts: Any, run: Any, console: Any) -> tuple[Any, int | None]:
    """(state to begin with, second of the run's clock that its checkpoint lies at: -1 none yet, None a new run)."""
    from bayessim_mjx import loop
    from bayessim_mjx.monitor.writers import marked

    state = loop.init(parts, progress=False)  # the console shows it
    if run is not None and run.checkpoints:
        tree, meta = run.restore("latest", loop.tree_of(parts, state), fall_back=True)
        return tree["state"], marked(meta)
    train = cli.warm_start(state.train, parts.config, parts.env, console.say)
    return dataclasses.replace(state, train=train), None if run is None else -1


def _rounds(parts: Any, state: Any, run: Any, console: Any, resumed_at: int | None) -> Any:
    """Run the remaining rounds, watched; return the last state."""
    from bayessim_mjx import loop
    from bayessim_mjx.monitor.film import film
    from bayessim_mjx.monitor.session import Session

    config, env = parts.config, parts.env
    truth = None if parts.source is None else parts.source.truth
    with cli.graceful() as stop:
        session = Session(run.path, config, env, console, film(env, config), state, resumed_at, truth)
        try:
            session.describe(to_yaml(config.to_dict()))
            watched = Watched(session, stop, run, parts)
            return loop.run(parts, state, watched, watched)[0]
        finally:
            session.close()


def _report(console: Any, parts: Any, state: Any) -> None:
    """Print the closing table of parameters."""
    import numpy as np

    if parts.settings.modelClass is None:
        return
    posterior, space, truth = state.domain, state.domain.space, parts.source.truth
    numbers = posterior.estimates()
    truths = [None] * len(space.names) if truth is None else np.asarray(truth)
    rows = [
        row | {"name": name, "unit": unit, "truth": true, "width": wide}
        for (name, row), unit, true, wide in zip(
            posterior.describe().items(), space.units, truths, numbers.width, strict=True
        )
    ]
    console.table(rows, beside=numbers.sentence())


def _adapt(argv: Sequence[str] | None) -> int:
    """Run the outer loop; exit code 0, 2 (bad input) or 130 (Ctrl-C, after a checkpoint)."""
    argv = list(sys.argv[1:] if argv is None else argv)
    args = _parser().parse(argv)
    if args.list_tasks:
        return cli.list_tasks()
    config, run = _prepare(args)
    if config.randomization.get("randomize") is False and config.bayessim.modelClass is not None:
        raise UserError("task.randomize = False: there is nothing to infer; use bayessim-mjx train for PPO alone")
    if run is None:
        cli.writable(config.logdir, "--logdir")
    from bayessim_mjx.monitor.console import Console

    device = setup_jax(config)
    with cli.first_writes(config, run) as (config, run), Console(headless=args.headless) as console:
        return _run(config, run, device, [cli.SCRIPT, "main", *argv], console)


def main(argv: Sequence[str] | None = None) -> int:
    """`bayessim-mjx`: the command that the first word names; flags or settings without a command are those of main."""
    argv = list(sys.argv[1:] if argv is None else argv)
    first = argv[0] if argv else "--help"
    if first in ("-h", "--help"):
        return cli.command(_help)([word for word in argv[1:2] if commands.name_of(word) in commands.COMMANDS])
    adapts = first.startswith("-") or "=" in first
    return cli.command(_adapt if adapts else _named)(argv)


def _named(argv: Sequence[str] | None) -> int:
    """Find the command that the first word names, with a hyphen or an underscore."""
    written, *rest = argv or ()
    name = commands.name_of(written)
    if name not in commands.COMMANDS:
        raise unknown("command", written, commands.COMMANDS)
    own = {"main": _adapt, "completion": _completion, "help": _help}
    return own[name](rest) if name in own else _module(name).main(rest)


def _module(name: str) -> Any:
    return import_module(f"bayessim_mjx.{commands.module_of(name)}")


def _help_parser() -> cli.PlainParser:
    about = "Show the help of a command, the list of all commands, or all settings with their defaults."
    parser = cli.PlainParser("help", description=about, usage="%(prog)s [COMMAND | settings [SECTION]]")
    what = "a command, and its part where it has parts; or settings, and a section, such as ppo"
    parser.add_argument("words", metavar="COMMAND", nargs="*", help=what)
    return parser


def _help(argv: Sequence[str] | None) -> int:
    """Print the help of a command, all commands in their groups, or settings; exit code 0, or 2 (no such command)."""
    words = _help_parser().parse_args(argv).words
    if words[:1] == ["settings"]:
        if len(words) > 2:
            raise UserError(f"help settings {' '.join(words[1:])}: give one section, such as ppo")
        from bayessim_mjx.config import listing

        print(listing.text(*words[1:]))
        return 0
    if words:
        return _named([*words, "--help"])
    text = f"{ABOUT}\n\n{commands.overview()}"
    cli.PlainParser(prog=cli.SCRIPT, description=text, usage="%(prog)s COMMAND [options]", epilog=AFTER).print_help()
    return 0


def _completion_parser() -> cli.PlainParser:
    parser = cli.PlainParser("completion", description=COMPLETION, usage="%(prog)s SHELL")
    parser.add_argument("shell", choices=commands.SHELLS, help="whose script")
    return parser


def _completion(argv: Sequence[str] | None) -> int:
    """Print the script for a shell; exit code 0, or 2 (another shell, or shtab is not installed)."""
    parser = _completion_parser()
    shell, own = parser.parse_args(argv).shell, {"main": _parser(), "completion": parser, "help": _help_parser()}
    of = {name: own.get(name) or _module(name)._parser() for name in commands.COMMANDS}
    print(commands.script(shell, {name: (commands.COMMANDS[name].about, of[name]) for name in of}))
    return 0


if __name__ == "__main__":
    sys.exit(main(["main", *sys.argv[1:]]))
