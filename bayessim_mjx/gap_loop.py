"""`bayessim-mjx gap-loop --task T --diagnosis DIR (--real LOGS | --surrogate FILE)`: worth of a correction.

Trains a policy on the simulator as it was and one on the corrected simulator, and says what return each is predicted to
reach, what it reaches on the surrogate real, and what retraining recovers (see docs/diagnosis.md).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bayessim_mjx import cli
from bayessim_mjx.config import Config
from bayessim_mjx.device import setup_jax
from bayessim_mjx.errors import UserError

DESCRIPTION = (
    "Measure how much return a diagnosed gap costs, and how much retraining on the corrected simulator recovers. "
    "Policies need a reward: your own robot needs a task (--task file.py:Class, docs/own_task.md), not a model alone."
)
WITHOUT = ("--max_iterations", "--video", "--video_length", "--video_interval", "--logger", "--logdir", "--name")


def _parser() -> cli.Parser:
    parser = cli.Parser("gap-loop", DESCRIPTION, without=WITHOUT, unused=("bayessim", "real", "monitor"))
    gap, real, trained = parser.group("diagnosis"), parser.group("real system"), parser.group("training")
    gap.add_argument("--diagnosis", metavar="DIR", help="folder that bayessim-mjx diagnose wrote")
    gap.add_argument("--parameters", metavar="FILE", help="the --parameters file that the diagnosis was given")
    text = (
        "time step of the corrected simulator in seconds (default: the task's, or the diagnosis' where the task's errs "
        "by more than the tolerance)"
    )
    gap.add_argument("--timestep", type=float, metavar="S", help=text)
    text = "logs of the real system; returns are then predicted, not measured"
    real.add_argument("--real", metavar="LOGS", nargs="+", help=text)
    text = "effects.yaml with the hidden truth of a simulated stand-in for the real system"
    real.add_argument("--surrogate", metavar="FILE", help=text)
    text = "time step of that stand-in in seconds (default: that of the task)"
    real.add_argument("--surrogate_timestep", type=float, metavar="S", help=text)
    text = "PPO iterations of each policy (default: ppo.max_iterations)"
    trained.add_argument("--iterations", metavar="N", type=cli.integer, help=text)
    trained.add_argument("--seeds", metavar="N", type=cli.integer, default=1, help="number of policies of each kind")
    trained.add_argument("--episodes", metavar="N", type=cli.integer, default=200, help="episodes in each evaluation")
    text = "folder for results and policies (default: <diagnosis>/gap_loop)"
    parser.group("output").add_argument("--out", metavar="DIR", help=text)
    return parser


def _check(args: argparse.Namespace) -> None:
    """Refuse what can be refused before anything is loaded."""
    if not args.diagnosis:
        raise UserError("--diagnosis is missing: give the folder that bayessim-mjx diagnose wrote")
    if not (Path(args.diagnosis) / "diagnosis.json").is_file():
        raise UserError(
            f"--diagnosis {args.diagnosis}: no diagnosis.json in it; give the --out of bayessim-mjx diagnose"
        )
    if bool(args.real) == bool(args.surrogate):
        raise UserError("give one of --surrogate FILE (a stand-in for the real system) and --real LOGS")
    if args.out:
        cli.writable(args.out, "--out")
    if args.surrogate and not Path(args.surrogate).is_file():
        raise UserError(f"--surrogate {args.surrogate}: no such file; expected the hidden truth as an effects.yaml")
    for flag, least in (("seeds", 1), ("episodes", 2), ("iterations", 1)):
        value = getattr(args, flag)
        if value is not None and value < least:
            raise UserError(f"--{flag} {value}: must be at least {least}")


def _config(args: argparse.Namespace) -> Config:
    more = {} if args.iterations is None else {"--iterations": ("ppo.max_iterations", args.iterations)}
    config = cli.config_of(args, more)
    if config.effects or config.calibrated:
        raise UserError("effects: the simulator as it was has none; those of the diagnosis come by --diagnosis")
    return config


def _gap_loop(argv: Sequence[str] | None) -> int:
    args = _parser().parse(argv)
    if args.list_tasks:
        return cli.list_tasks()
    _check(args)
    config = _config(args)
    from bayessim_mjx.monitor.console import Console

    with Console(headless=args.headless) as console:
        return _run(args, config, console)


def _run(args: argparse.Namespace, config: Config, console: Any) -> int:
    device = setup_jax(config)
    from bayessim_mjx.closed_loop import words
    from bayessim_mjx.closed_loop.study import make

    begun = time.perf_counter()
    study = make(args, config)
    console.start(study.opening() | {"device": str(device)})
    result = study.run(console)
    result["seconds"] = round(time.perf_counter() - begun, 1)
    path = study.write(result)
    words.show(result, console)
    console.say(f"results in {path}")
    console.command("curves", f"tensorboard --logdir {study.out}")
    return 0


main = cli.command(_gap_loop)

if __name__ == "__main__":
    sys.exit(main())
