"""Gap diagnosis of recorded motion: python -m bayessim_mjx.diagnose --model robot.xml --data LOGS."""

import argparse
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayessim_mjx import cli
from bayessim_mjx.config import Config
from bayessim_mjx.config.settings import SEEDS
from bayessim_mjx.device import setup_jax
from bayessim_mjx.errors import UserError
from bayessim_mjx.quantities import duration

if TYPE_CHECKING:
    from bayessim_mjx.diagnosis.fitting.robot import Robot
    from bayessim_mjx.diagnosis.result import Diagnosis


PRELIMINARY = "preliminary.json"  # what is known while the race goes on


def _parser() -> cli.PlainParser:
    parser = cli.PlainParser(
        prog=cli.prog_of("diagnose"),
        description="Find where logs and simulator differ, which missing effects cause it, and how much they explain.",
        usage="%(prog)s [options]\n       (--task NAME | --model FILE) --data PATH [PATH ...]",
    )
    parser.add_argument("--task", metavar="NAME", help="a task of this library (main --list_tasks prints them)")
    parser.add_argument("--model", metavar="FILE", help="an MJCF model with actuated hinge or slide joints")
    parser.add_argument("--data", metavar="PATH", nargs="+", help="log files, or folders of them (docs/logs.md)")
    parser.add_argument(
        "--map", metavar="FILE", help="YAML file that maps the columns of the logs to the model (docs/logs.md)"
    )
    parser.add_argument("--parameters", metavar="FILE", help="YAML file with the parameters that may be recalibrated")
    parser.add_argument(
        "--effects",
        metavar="LIST",
        default="all",
        help="effects to try, separated by commas: names or path.py:Class (default: all)",
    )
    parser.add_argument(
        "--tolerance",
        metavar="LIMIT",
        nargs="+",
        default=[],
        help="what may stay unexplained at a joint: 0.5deg, 2mm, 3%% of the motion, or elbow=0.5deg for one joint "
        "(default: the larger of 3 noise standard deviations and 2%% of the motion)",
    )
    parser.add_argument("--out", metavar="DIR", default="diagnosis", help="folder for the results (default: diagnosis)")
    parser.add_argument("--seed", metavar="N", type=cli.whole(0, SEEDS), default=0, help="random seed (default: 0)")
    parser.add_argument(
        "--group",
        metavar="KEY",
        help="metadata key that names the operating condition of a log; each condition is held out in turn",
    )
    parser.add_argument("--device", metavar="NAME", default="auto", help="auto, cpu or gpu (default: auto)")
    parser.add_argument("--cache_dir", metavar="DIR", help="folder of compiled programs, or off")
    parser.add_argument("--headless", action="store_true", help="plain lines instead of progress bars")
    return parser


def _checked(args: argparse.Namespace) -> None:
    if (args.task is None) == (args.model is None):
        raise UserError("give one of --task NAME and --model FILE")
    if not args.data:
        raise UserError("--data is missing: give files or folders of logs")
    out = Path(args.out)
    if out.exists() and not out.is_dir():
        raise UserError(f"--out {out}: there is a file of that name; give a folder")


def _robot(args: argparse.Namespace) -> "Robot":
    from bayessim_mjx.diagnosis.fitting import robot

    if args.model is not None:
        return robot.of_file(args.model, args.parameters)
    from bayessim_mjx import registry
    from bayessim_mjx.config import load

    task = cli.task_name(args.task)
    env: Any = registry.make(task, config=load(task))
    return robot.of_task(env, args.parameters)


def _diagnosis(args: argparse.Namespace, robot: "Robot", notes: list[str], say: Any) -> "Diagnosis":
    """The result; too little data is a verdict, not an error."""
    from bayessim_mjx.diagnosis import run
    from bayessim_mjx.diagnosis.setup import TooLittleData
    from bayessim_mjx.diagnosis.summary import assemble, preliminary
    from bayessim_mjx.logs import read_logs

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        logs = read_logs(args.data if len(args.data) > 1 else args.data[0], robot.mj_model, args.map)
    notes += list(dict.fromkeys(str(w.message) for w in caught))
    about = _about(args, robot, [log.duration for log in logs])
    names = "all" if args.effects == "all" else [n.strip() for n in args.effects.split(",") if n.strip()]
    so_far = Path(args.out) / PRELIMINARY

    def keep(setup: Any, race: Any) -> None:
        """What is known before there is a verdict: killed there, this stays."""
        preliminary.write(so_far, about, [*notes, *setup.warnings], setup, race)

    try:
        asked = {"group": args.group, "seed": args.seed, "tolerated": args.tolerance}
        found = run.diagnose(robot, logs, names, **asked, progress=say, keep=keep)
    except TooLittleData as reason:
        return replace(assemble.insufficient(str(reason), notes), about=about)
    found.setup.warnings[:0] = notes
    conditions = len(found.setup.fitter.simulator.windows.groups)
    result = replace(assemble.diagnosis_of(found, say), about=about | {"conditions": conditions})
    result.save(Path(args.out))  # maps and the next experiment take time; killed there, the verdict stays
    so_far.unlink(missing_ok=True)
    return assemble.with_more(result, found, Path(args.out), say)


def _about(args: argparse.Namespace, robot: "Robot", seconds: Sequence[float]) -> dict[str, Any]:
    """What is diagnosed, for the report's header."""
    return {
        "robot": robot.name,
        "model": str(args.model or args.task),
        "data": [str(p) for p in args.data],
        "logs": len(seconds),
        "seconds": float(sum(seconds)),
        "date": time.strftime("%Y-%m-%d %H:%M"),
        "seed": args.seed,
    }


def _diagnose(argv: Sequence[str] | None) -> int:
    args = _parser().parse_args(argv)
    _checked(args)
    setup_jax(Config(task="", device=args.device, cache_dir=args.cache_dir))
    from bayessim_mjx import report
    from bayessim_mjx.monitor.stages import stages

    began = time.monotonic()
    notes: list[str] = []
    with warnings.catch_warnings(record=True) as caught, stages(args.headless) as say:
        warnings.simplefilter("always", UserWarning)
        robot = _robot(args)
        notes += list(dict.fromkeys(str(w.message) for w in caught))
        result = _diagnosis(args, robot, notes, say)
        say("writing the report", 0, 1)
        result = _write(result, robot, Path(args.out), report)
    report.console(result, Path(args.out))
    print(f"{duration(time.monotonic() - began)}; open {Path(args.out) / 'report.html'}")
    return 0


def _write(result: "Diagnosis", robot: "Robot", folder: Path, report: Any) -> "Diagnosis":
    from bayessim_mjx.diagnosis import correction
    from bayessim_mjx.diagnosis.result import load

    result.save(folder)  # before anything that could fail: nothing computed is lost
    result = load(folder)
    if result.verdict != "insufficient_data":
        result.warnings.extend(correction.write_outputs(result, robot, folder))
        result.save(folder)
    report.write(result, folder)
    report.tensorboard(result, folder)
    return result


main = cli.command(_diagnose)

if __name__ == "__main__":
    sys.exit(main())
