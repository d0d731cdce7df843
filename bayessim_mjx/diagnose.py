"""Gap diagnosis of recorded motion: `bayessim-mjx diagnose --model robot.xml --data LOGS`.

From Python `bayessim_mjx.diagnose("robot.xml", "logs")`.
"""

import argparse
import sys
import time
import types
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayessim_mjx import cli
from bayessim_mjx.blind.recall import beside, recall
from bayessim_mjx.config import Config
from bayessim_mjx.config.settings import SEEDS
from bayessim_mjx.device import setup_jax
from bayessim_mjx.errors import UserError
from bayessim_mjx.quantities import duration

if TYPE_CHECKING:
    from bayessim_mjx.diagnosis.fitting.robot import Robot
    from bayessim_mjx.diagnosis.result import Diagnosis


def _parser() -> cli.PlainParser:
    parser = cli.PlainParser(
        "diagnose",
        description="Find where logs and simulator differ, which missing effects cause it, and how much they explain.",
        usage="%(prog)s [options]\n       (--task TASK | --model FILE) --data PATH [PATH ...]",
    )
    robot = parser.group("robot and logs")
    text = "name of a task, or file.py:Class (bayessim-mjx main --list_tasks)"
    robot.add_argument("--task", metavar="TASK", type=cli.task, help=text)
    robot.add_argument("--model", metavar="FILE", help="an MJCF model with actuated hinge or slide joints")
    robot.add_argument("--data", metavar="PATH", nargs="+", help="log files, or folders of them (docs/logs.md)")
    text = "YAML file that maps the columns of the logs to the model (docs/logs.md)"
    robot.add_argument("--map", metavar="FILE", help=text)
    text = "metadata key that names the operating condition of a log; each condition is held out in turn"
    robot.add_argument("--group", metavar="KEY", help=text)
    _known(parser.group("what is known"))
    _search(parser.group("search"))
    _output(parser.group("output"))
    computing = parser.group("computing")
    computing.add_argument("--device", metavar="NAME", default="auto", help="auto, cpu or gpu")
    text = "folder of compiled programs, or off (default: $BAYESSIM_MJX_CACHE)"
    computing.add_argument("--cache_dir", metavar="DIR", help=text)
    return parser


def _known(group: Any) -> None:
    """What is known of the robot, and what may stay unexplained."""
    text = "YAML file with the parameters that may be recalibrated (default: damping, armature and mass)"
    group.add_argument("--parameters", metavar="FILE", help=text)
    text = (
        "how accurate known parameters are (standard deviation): 5%%, mass=2%%, elbow*=20%% (default: inferred from "
        "the logs, one for each kind of the model's own numbers; the ranges of --parameters)"
    )
    group.add_argument("--accuracy", metavar="SHARE", nargs="+", default=[], help=text)
    text = "what the robot is rated to carry: 12kg, or tool=12kg (default: what its drives hold, up to its weight)"
    group.add_argument("--payload", metavar="KG", nargs="+", default=[], help=text)
    text = (
        "what may stay unexplained at a joint: 0.5deg, 2mm, 3%% of the motion, or elbow=0.5deg for one joint "
        "(default: the larger of 3 noise standard deviations and 2%% of the motion)"
    )
    group.add_argument("--tolerance", metavar="LIMIT", nargs="+", default=[], help=text)


def _search(group: Any) -> None:
    """What is searched, and how long that may take."""
    text = (
        "effects to try, separated by commas: names, path.py:Class, or all that are on offer (default: all; "
        "docs/effects.md says which ones are tried only where named)"
    )
    group.add_argument("--effects", metavar="LIST", default="all", help=text)
    text = "time that it may take: the search is cut down to it, and the result lists what was not tried"
    group.add_argument("--minutes", metavar="M", type=cli.positive("minutes"), help=f"{text} (default: no limit)")
    group.add_argument("--quick", action="store_true", help="a first answer: fewer windows and effects, no maps")
    group.add_argument("--seed", metavar="N", type=cli.whole(0, SEEDS), default=0, help="random seed")


def _output(group: Any) -> None:
    """What is written, and how much of it."""
    group.add_argument("--out", metavar="DIR", default="diagnosis", help="folder for the results")
    text = "the whole search, but no report, maps, black boxes or next experiment: diagnosis.json and effects.yaml"
    group.add_argument("--verdict_only", action="store_true", help=text)
    text = "a finished blind check: list what a diagnosis would have missed (docs/blind.md)"
    group.add_argument("--blind", metavar="DIR", help=text)
    group.add_argument("--headless", action="store_true", help="plain lines instead of progress bars")


def _checked(args: argparse.Namespace) -> None:
    if (args.task is None) == (args.model is None):
        raise UserError("give one of --task NAME and --model FILE")
    if not args.data:
        raise UserError("--data is missing: give files or folders of logs")
    out = Path(args.out)
    if out.exists() and not out.is_dir():
        raise UserError(f"--out {out}: there is a file of that name; give a folder")


def _robot(task: str, model: str | None, parameters: str | None) -> "Robot":
    from bayessim_mjx.diagnosis.fitting import robot

    if model is not None:
        return robot.of_file(model, parameters)
    from bayessim_mjx import registry
    from bayessim_mjx.config import load

    name = cli.task_name(task)
    env: Any = registry.make(name, config=load(name))
    return robot.of_task(env, parameters)


def _diagnosis(args: argparse.Namespace, say: Any, early: Callable[[Sequence[str]], None]) -> "Diagnosis":
    from bayessim_mjx.diagnosis import run

    names = "all" if args.effects == "all" else [n.strip() for n in args.effects.split(",") if n.strip()]
    with run.noting() as notes:
        robot = _robot(args.task, args.model, args.parameters)
    return run.diagnose(
        robot,
        args.data,
        effects=names,
        map=args.map,
        group=args.group,
        tolerance=args.tolerance,
        accuracy=args.accuracy,
        payload=args.payload,
        minutes=args.minutes,
        quick=args.quick,
        verdict_only=args.verdict_only,
        seed=args.seed,
        out=args.out,
        progress=say,
        notes=notes,
        about={"model": str(args.model or args.task)},
        early=early,
    )


def _diagnose(argv: Sequence[str] | None) -> int:
    args = _parser().parse_args(argv)
    _checked(args)
    missed = recall(args.blind) if args.blind else beside(args.data)
    setup_jax(Config(task="", device=args.device, cache_dir=args.cache_dir))
    from bayessim_mjx import report
    from bayessim_mjx.monitor.stages import stages

    began = time.monotonic()

    def early(lines: Sequence[str]) -> None:
        _told(f"Before any simulation ({time.monotonic() - began:.1f} s):", lines, args.headless)

    with warnings.catch_warnings(record=True), stages(args.headless) as say:  # what matters is told with the result
        result = _diagnosis(args, say, early)
        if args.verdict_only:
            (Path(args.out) / "report.html").unlink(missing_ok=True)  # of an earlier answer
        else:
            say("writing the report", 0, 1)
            report.write(result, Path(args.out), missed)
            report.tensorboard(result, Path(args.out))
    report.console(result, Path(args.out))
    if missed:
        _told(f"On this robot and these logs ({missed.page}):", missed.sentences, args.headless)
    best = Path(args.out) / ("diagnosis.json" if args.verdict_only else "report.html")
    print(f"{duration(time.monotonic() - began)}; open {best}")
    return 0


def _told(title: str, lines: Sequence[str], headless: bool) -> None:
    """A list that is told as soon as it is known: what the logs say before anything is simulated, for one."""
    from bayessim_mjx.monitor.output import Output

    out = Output(headless, sys.stdout)
    print(title, *(part for line in lines for part in out.broken(f"  {line}", 4)), sep="\n", flush=True)


main = cli.command(_diagnose)


class _Command(types.ModuleType):
    """This module, which is also the function of its name: `bayessim_mjx.diagnose(model, logs)`."""

    def __call__(self, model: Any, logs: Any, **options: Any) -> "Diagnosis":
        """One diagnosis; arguments as of `bayessim_mjx.diagnosis.diagnose`, and `model` may be the name of a task."""
        from bayessim_mjx.diagnosis import run

        if not isinstance(model, str) or Path(model).suffix or Path(model).exists():
            return run.diagnose(model, logs, **options)
        with run.noting() as notes:
            robot = _robot(model, None, options.pop("parameters", None))
        return run.diagnose(robot, logs, **{"notes": notes, "about": {"model": model}, **options})


sys.modules[__name__].__class__ = _Command  # whichever is asked for first, module or function, both are there

if __name__ == "__main__":
    sys.exit(main())
