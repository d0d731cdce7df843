"""Which missing effects a diagnosis would find on your robot and logs: bayessim-mjx blind --model FILE --data LOGS."""

import argparse
import shlex
import sys
from collections.abc import Sequence
from typing import Any

from bayessim_mjx import cli, pool
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
        "blind",
        description="Hide effects of known strength in a finer simulation of your robot, moved as in your logs, and "
        "see which of them a diagnosis finds.",
        usage="%(prog)s [options]\n       (--task TASK | --model FILE) [--data PATH [PATH ...]]",
    )
    robot = parser.group("robot and logs")
    robot.add_argument("--task", metavar="TASK", type=cli.task, help="name of a task, or file.py:Class")
    robot.add_argument("--model", metavar="FILE", help="an MJCF or URDF model with hinge or slide joints")
    cli.of_urdf(robot)
    text = (
        "log files, or folders of them: conditions, commands, rates and noise are taken from them (default: a menu of "
        "motions within the model's limits)"
    )
    robot.add_argument("--data", metavar="PATH", nargs="+", default=[], help=text)
    robot.add_argument("--map", metavar="FILE", default="", help="YAML file that maps the columns of the logs")
    parser.group("output").add_argument("--out", metavar="DIR", default="blind", help="folder of the check")
    _cases(parser.group("cases"))
    _diagnosis(parser.group("diagnosis"))
    parser.group("output").add_argument("--headless", action="store_true", help="plain lines instead of progress bars")
    return parser


def _cases(group: Any) -> None:
    """Which cases there are, and how many at a time."""
    text = "effects to hide, separated by commas (default: all that a diagnosis tries unasked)"
    group.add_argument("--effects", metavar="LIST", default="all", help=text)
    text = (
        "cases in all. Each takes a worker about half a minute with one or two joints, and up to ten minutes with six. "
        "The command says the whole time before it starts"
    )
    group.add_argument("--cases", metavar="N", type=cli.whole(1, MOST), default=CASES, help=text)
    text = "begin no further case after this time; the next start goes on (default: no limit)"
    group.add_argument("--minutes", metavar="M", type=cli.positive("minutes"), help=text)
    text = "standard deviation of data-sheet values (default: 5%%)"
    group.add_argument("--accuracy", metavar="SHARE", type=_share, default=0.05, help=text)
    group.add_argument("--seed", metavar="N", type=cli.whole(0, SEEDS), default=0, help="random seed")
    text = "cases at a time, which share the cores out (default: as many as cores, and as need not wait for others)"
    group.add_argument("--workers", metavar="N", type=cli.whole(1, 1024), help=text)
    group.add_argument("--cluster", **pool.CLUSTER)


def _diagnosis(group: Any) -> None:
    """Which diagnosis is tested."""
    text = "another diagnosis: a command with {data} and {out}, and {model}, that writes {out}/diagnosis.json"
    group.add_argument("--command", metavar="WORDS", default="", help=text)
    text = "let the diagnosis read the whole disk, the truths too (default: it cannot, where Linux has Landlock)"
    group.add_argument("--no_sandbox", action="store_true", help=text)
    text = "further flags of diagnose; comes last"
    group.add_argument("--more", nargs=argparse.REMAINDER, default=[], metavar="FLAG", help=text)


def _checked(args: argparse.Namespace) -> None:
    cli.one_robot(args)
    if args.command and "{out}" not in args.command:
        raise UserError(f"--command {args.command!r}: it has to hold {{out}}, and {{data}} and {{model}} where needed")
    try:
        shlex.split(args.command)
    except ValueError as error:
        raise UserError(f"--command {args.command!r}: {error}; allowed: words as a shell takes them") from None
    if args.command and args.more:
        raise UserError("--more: these are flags of our own diagnosis; put those of another one into --command")
    cli.writable(args.out, "--out")


def _blind(argv: Sequence[str] | None) -> int:
    args = _parser().parse_args(argv)
    _checked(args)
    from bayessim_mjx.blind.check import Check, effects_of
    from bayessim_mjx.blind.runner import Limits, estimate, run
    from bayessim_mjx.monitor.console import Console
    from bayessim_mjx.progress import stages

    names = effects_of(args.effects)
    check = Check(
        args.out, args.model or "", args.task or "", tuple(args.data), args.map, names, args.accuracy, args.seed,
        args.command, tuple(args.more), not args.no_sandbox, args.drive or "", tuple(args.packages),
    )  # fmt: skip
    seconds = None if args.minutes is None else 60 * args.minutes
    limits = Limits(args.cases, seconds, args.workers, args.cluster)
    from bayessim_mjx.blind import answer, show

    with stages(args.headless) as say:
        say.line(estimate(check, limits))
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
