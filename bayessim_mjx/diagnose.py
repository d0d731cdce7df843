"""Gap diagnosis of recorded motion: `bayessim-mjx diagnose --model robot.xml --data LOGS`.

From Python `bayessim_mjx.diagnose("robot.xml", "logs", out="found")`.
"""

import argparse
import sys
import time
import types
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayessim_mjx import cli
from bayessim_mjx.blind.recall import beside, recall
from bayessim_mjx.config import Config
from bayessim_mjx.config.settings import SEEDS
from bayessim_mjx.device import setup_jax
from bayessim_mjx.errors import UserError
from bayessim_mjx.outside_tasks import is_file
from bayessim_mjx.progress import Show, Wanted, Worded, shown, stages
from bayessim_mjx.quantities import duration

if TYPE_CHECKING:
    from bayessim_mjx.diagnosis.fitting.robot import Robot, Source
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
    robot.add_argument("--model", metavar="FILE", help="an MJCF or URDF model with hinge or slide joints")
    cli.of_urdf(robot)
    robot.add_argument("--data", metavar="PATH", nargs="+", help="log files, or folders of them (docs/logs.md)")
    text = "YAML file that maps the columns of the logs to the model (docs/logs.md)"
    robot.add_argument("--map", metavar="FILE", help=text)
    text = "metadata key that names the operating condition of a log; each condition is held out in turn"
    robot.add_argument("--group", metavar="KEY", help=text)
    _known(parser.group("known data"))
    _search(parser.group("search"))
    _output(parser.group("output"))
    computing = parser.group("computing")
    computing.add_argument("--device", metavar="NAME", default="auto", help="auto, cpu or gpu")
    text = "folder of compiled programs, or off (default: $BAYESSIM_MJX_CACHE, else ~/.cache/bayessim_mjx)"
    computing.add_argument("--cache_dir", metavar="DIR", help=text)
    return parser


def _known(group: Any) -> None:
    """Add the flags for known numbers of the robot, and for errors that may stay unexplained."""
    text = "YAML file with the parameters that may be recalibrated (default: damping, armature and mass)"
    group.add_argument("--parameters", metavar="FILE", help=text)
    text = (
        "how accurate known parameters are (standard deviation): 5%%, mass=2%%, elbow*=20%% (default: inferred from "
        "the logs, one for each kind of the model's own numbers; the ranges of --parameters)"
    )
    group.add_argument("--accuracy", metavar="SHARE", nargs="+", default=[], help=text)
    text = "rated payload: 12kg, or tool=12kg (default: as much as its drives hold, up to its weight)"
    group.add_argument("--payload", metavar="KG", nargs="+", default=[], help=text)
    text = (
        "what may stay unexplained at a joint: 0.5deg, 2mm, 3%% of the motion, or elbow=0.5deg for one joint "
        "(default: the larger of 3 noise standard deviations and 2%% of the motion)"
    )
    group.add_argument("--tolerance", metavar="LIMIT", nargs="+", default=[], help=text)


def _search(group: Any) -> None:
    """Add the flags for the search and its time."""
    text = (
        "effects to try, separated by commas: names, path.py:Class, or all that are on offer (default: all; "
        "--list_effects says which ones are tried only where named)"
    )
    group.add_argument("--effects", metavar="LIST", default="all", help=text)
    text = "print the effects of the library, their places and meanings, and stop"
    group.add_argument("--list_effects", action="store_true", help=text)
    text = "time limit: the search is cut down to it, and the result lists effects that were not tried"
    group.add_argument("--minutes", metavar="M", type=cli.positive("minutes"), help=f"{text} (default: no limit)")
    group.add_argument("--quick", action="store_true", help="a first answer: fewer windows and effects, no maps")
    group.add_argument("--seed", metavar="N", type=cli.whole(0, SEEDS), default=0, help="random seed")


def _output(group: Any) -> None:
    """Add the flags for the files to write."""
    group.add_argument("--out", metavar="DIR", default="diagnosis", help="folder for the results")
    text = "the whole search, but no report, maps, black boxes or next experiment: diagnosis.json and effects.yaml"
    group.add_argument("--verdict_only", action="store_true", help=text)
    text = "a finished blind check: list what a diagnosis would have missed (docs/blind.md)"
    group.add_argument("--blind", metavar="DIR", help=text)
    group.add_argument("--headless", action="store_true", help="plain lines instead of progress bars")


def _checked(args: argparse.Namespace) -> None:
    cli.one_robot(args)
    if not args.data:
        raise UserError("--data is missing: give files or folders of logs")
    cli.writable(args.out, "--out")


def _of_task(name: str, parameters: str | Path | None) -> "Robot":
    from bayessim_mjx import registry
    from bayessim_mjx.config import load
    from bayessim_mjx.diagnosis.fitting.robot import of_task

    name = cli.task_name(cli.task(name))
    env: Any = registry.make(name, config=load(name))
    return of_task(env, parameters)


def robot(source: "Source", parameters: str | Path | None = None) -> "Robot":
    """Return the simulator under diagnosis: what `diagnose` takes as its model.

    Args:
        source: an MJCF (or URDF) file, the name of a task (also `file.py:Class`), a MuJoCo specification or model, or a
            Robot, which stays as it is.
        parameters: YAML file with the parameters that may be recalibrated; None: damping, armature and mass.

    Raises:
        UserError: no such file or task, or nothing that could be diagnosed.
    """
    from bayessim_mjx.diagnosis.fitting.robot import robot_of

    return _of_task(str(source), parameters) if _is_task(source) else robot_of(source, parameters)


def _is_task(source: Any) -> bool:
    if not isinstance(source, str):
        return False
    return is_file(source) or not (Path(source).suffix or Path(source).exists())


def _names(effects: str) -> str | list[str]:
    """Return the effects of --effects, each of which has to exist."""
    from bayessim_mjx.effects import load

    names = [n.strip() for n in effects.split(",") if n.strip()]
    if not names:
        raise UserError(f"--effects {effects!r}: give names separated by commas, path.py:Class, or all")
    try:
        for name in names:
            if name != "all":
                load(name)
    except UserError as error:
        raise UserError(f"--effects {effects}: {error}") from None
    return "all" if names == ["all"] else names


def _listed() -> int:
    """Print name, kind of place and meaning of every effect."""
    from bayessim_mjx.effects.support.words import listing

    rows = [("effect", "place", "meaning"), *listing()]
    wide, kind = (max(len(row[k]) for row in rows) for k in (0, 1))
    print("\n".join(f"{name:{wide}}  {place:{kind}}  {text}" for name, place, text in rows))
    return 0


def _reported(result: "Diagnosis", out: str | Path, verdict_only: bool, missed: Any, say: Show) -> None:
    """Write what is for people: the report and TensorBoard; after `verdict_only` an earlier report goes."""
    from bayessim_mjx import report

    if verdict_only:
        (Path(out) / "report.html").unlink(missing_ok=True)
        return
    say("writing the report", 0, 1)
    report.write(result, Path(out), missed)
    report.tensorboard(result, Path(out))


def _diagnose(argv: Sequence[str] | None) -> int:
    args = _parser().parse_args(argv)
    if args.list_effects:
        return _listed()
    _checked(args)
    missed = recall(args.blind) if args.blind else beside(args.data)
    setup_jax(Config(task="", device=args.device, cache_dir=args.cache_dir))
    from bayessim_mjx import report
    from bayessim_mjx.diagnosis import run
    from bayessim_mjx.diagnosis.fitting.robot import of_file
    from bayessim_mjx.diagnosis.phrases.advice import verdict_of
    from bayessim_mjx.diagnosis.phrases.stages import doing

    began, effects = time.monotonic(), _names(args.effects)

    given = ("map", "group", "tolerance", "accuracy", "payload", "minutes", "quick", "verdict_only", "seed", "out")
    with warnings.catch_warnings(record=True), stages(args.headless) as say:  # what matters is told with the result

        def early(lines: Sequence[str]) -> None:
            _told(f"Before any simulation ({time.monotonic() - began:.1f} s):", lines, args.headless)
            say("choosing the simulator's time step", 0, 1)

        with run.noting() as notes:
            own = () if args.task else (args.drive, args.packages)
            nominal = (_of_task if args.task else of_file)(args.task or args.model, args.parameters, *own)
        result = run.diagnose(
            nominal, args.data, effects=effects, progress=Worded(say, doing), notes=notes, early=early,
            about={"model": str(args.model or args.task)}, **{key: getattr(args, key) for key in given},
        )  # fmt: skip
        _reported(result, args.out, args.verdict_only, missed, say)
    report.console(result, Path(args.out))
    if missed:
        _told(f"On this robot and these logs ({missed.page}):", missed.sentences, args.headless)
    best = Path(args.out) / ("diagnosis.json" if args.verdict_only else "report.html")
    words = verdict_of(result).badge
    code = "" if words.lower() == result.verdict else f" ({result.verdict})"
    print(f"{words}{code}, after {duration(time.monotonic() - began)}; open {best}")
    return 0


def _told(title: str, lines: Sequence[str], headless: bool) -> None:
    """Print a list as soon as it is known, such as what the logs show before anything is simulated."""
    from bayessim_mjx.monitor.output import Output
    from bayessim_mjx.report.words import signs

    out = Output(headless, sys.stdout)
    print(title, *(part for line in lines for part in out.broken(f"  {signs(line)}", 4)), sep="\n", flush=True)


main = cli.command(_diagnose)


class _Command(types.ModuleType):
    """This module, which is also the function of its name: `bayessim_mjx.diagnose(model, logs)`."""

    def __call__(
        self, model: Any, logs: Any, *, out: str | Path | None = None, progress: Wanted = None, **options: Any
    ) -> "Diagnosis":
        """One diagnosis, as the command makes it.

        Args:
            model: what `robot` takes. logs: a folder, files, or `Log`s.
            out: folder for all that the command writes, the report too; None: nothing is written.
            progress: whether to show it on stderr; None: on a terminal or in a notebook; or a function (stage, done,
                total).
            options: further arguments of `bayessim_mjx.diagnosis.run.diagnose`, named as the command's flags.

        Raises:
            UserError: model, logs, effects or tolerance are not usable.
        """
        from bayessim_mjx.diagnosis import run
        from bayessim_mjx.diagnosis.phrases.stages import doing

        about = {"model": str(model)} if isinstance(model, str | Path) else {}
        paths = [logs] if isinstance(logs, str | Path) else list(logs)
        known = all(isinstance(path, str | Path) for path in paths)
        with shown(progress) as say:
            with run.noting() as notes:
                nominal = robot(model, options.pop("parameters", None))
            given = {"notes": notes, "about": about, "progress": Worded(say, doing), "out": out, **options}
            result = run.diagnose(nominal, logs, **given)
            if out is not None:
                missed = beside([str(path) for path in paths]) if known else None
                _reported(result, out, bool(options.get("verdict_only")), missed, say)
        return result


sys.modules[__name__].__class__ = _Command  # whichever is asked for first, module or function, both are there

if __name__ == "__main__":
    sys.exit(main())
