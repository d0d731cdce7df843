"""Which missing effects a diagnosis would find on your robot and logs: bayessim-mjx blind --model FILE --data LOGS."""

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from bayessim_mjx import cli
from bayessim_mjx.config.settings import SEEDS
from bayessim_mjx.errors import UserError

CASES = 100
MOST = 100_000


def _share(text: str) -> float:
    """`5%` -> 0.05."""
    try:
        value = float(text.removesuffix("%")) / 100
    except ValueError:
        value = 0.0
    if not (text.endswith("%") and 0 < value <= 0.3):
        raise argparse.ArgumentTypeError(f"{text!r}: allowed: per cent from 0.1% to 30%")
    return value


def _parser() -> cli.PlainParser:
    parser = cli.PlainParser(
        prog=cli.prog_of("blind").replace("bayessim_mjx.blind", "bayessim_mjx.blind_check"),
        description="Hide effects of known strength in a finer simulation of your robot, moved as in your logs, and "
        "see which of them a diagnosis finds.",
        usage="%(prog)s [options]\n       (--task NAME | --model FILE) [--data PATH [PATH ...]]",
    )
    parser.add_argument("--task", metavar="NAME", help="a task of this library (main --list_tasks prints them)")
    parser.add_argument("--model", metavar="FILE", help="an MJCF model with actuated hinge or slide joints")
    parser.add_argument(
        "--data", metavar="PATH", nargs="+", default=[],
        help="log files, or folders of them: conditions, commands, rates and noise are taken from them (default: a "
        "menu of motions within the model's limits)",
    )  # fmt: skip
    parser.add_argument("--map", metavar="FILE", default="", help="YAML file that maps the columns of the logs")
    parser.add_argument(
        "--effects", metavar="LIST", default="all",
        help="effects to hide, separated by commas (default: all that a diagnosis tries unasked)",
    )  # fmt: skip
    parser.add_argument(
        "--cases", metavar="N", type=cli.whole(1, MOST), default=CASES, help=f"cases in all (default: {CASES})"
    )
    parser.add_argument(
        "--minutes",
        metavar="M",
        type=cli.positive("minutes"),
        help="begin no further case after this time; the next start goes on",
    )
    parser.add_argument(
        "--accuracy", metavar="SHARE", type=_share, default=0.05,
        help="how accurate data-sheet values are (standard deviation; default: 5%%)",
    )  # fmt: skip
    parser.add_argument("--seed", metavar="N", type=cli.whole(0, SEEDS), default=0, help="random seed (default: 0)")
    parser.add_argument(
        "--workers",
        metavar="N",
        type=cli.whole(1, 1024),
        help="cases at a time, which share the cores out (default: as many as cores, and as need not wait for others)",
    )
    parser.add_argument("--out", metavar="DIR", default="blind", help="folder of the check (default: blind)")
    parser.add_argument(
        "--command", metavar="WORDS", default="",
        help="another diagnosis: a command with {data} and {out}, and {model}, that writes {out}/diagnosis.json",
    )  # fmt: skip
    parser.add_argument(
        "--no_sandbox", action="store_true",
        help="let the diagnosis read the whole disk, the truths too (default: it cannot, where Linux has Landlock)",
    )  # fmt: skip
    parser.add_argument("--headless", action="store_true", help="plain lines instead of progress bars")
    parser.add_argument(
        "--more", nargs=argparse.REMAINDER, default=[], metavar="FLAG", help="further flags of diagnose; comes last"
    )
    return parser


def _checked(args: argparse.Namespace) -> None:
    if (args.task is None) == (args.model is None):
        raise UserError("give one of --task NAME and --model FILE")
    if args.command and "{out}" not in args.command:
        raise UserError(f"--command {args.command!r}: it has to hold {{out}}, and {{data}} and {{model}} where needed")
    try:
        shlex.split(args.command)
    except ValueError as error:
        raise UserError(f"--command {args.command!r}: {error}; allowed: words as a shell takes them") from None
    if args.command and args.more:
        raise UserError("--more: these are flags of our own diagnosis; put those of another one into --command")
    if Path(args.out).exists() and not Path(args.out).is_dir():
        raise UserError(f"--out {args.out}: there is a file of that name; give a folder")


def _blind(argv: Sequence[str] | None) -> int:
    args = _parser().parse_args(argv)
    _checked(args)
    from bayessim_mjx.blind.check import Check, effects_of
    from bayessim_mjx.blind.runner import Limits, run
    from bayessim_mjx.monitor.console import Console
    from bayessim_mjx.monitor.stages import stages

    names = effects_of(args.effects)
    check = Check(
        args.out, args.model or "", args.task or "", tuple(args.data), args.map, names, args.accuracy, args.seed,
        args.command, tuple(args.more), not args.no_sandbox,
    )  # fmt: skip
    seconds = None if args.minutes is None else 60 * args.minutes
    limits = Limits(args.cases, seconds, args.workers)
    from bayessim_mjx.blind import answer, show

    with stages(args.headless) as say:
        outcomes = run(check, limits, say, lambda so_far: answer.write(check, answer.answer(check, so_far)))
        found = answer.answer(check, outcomes, say)
    with Console(headless=args.headless) as console:
        answer.write(check, found)
        show.tensorboard(found, check.folder)
        show.console(found, check.folder, console)
    return 0


main = cli.command(_blind)

if __name__ == "__main__":
    sys.exit(main())
