"""`bayessim-mjx logs`: `check DIR` and `show DIR` look at logs; `from-mcap FILE --out DIR` and others convert."""

import argparse
import errno
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayessim_mjx import cli
from bayessim_mjx.errors import UserError
from bayessim_mjx.quantities import MOST, count, listed

if TYPE_CHECKING:
    from bayessim_mjx.logs.importers.ros import Choice
    from bayessim_mjx.logs.importers.streams import Recording
    from bayessim_mjx.logs.overview import Overview

FORMATS = {
    "from-mcap": "MCAP files with ROS 2 messages",
    "from-rosbag": "ROS 1 bags (files) and ROS 2 bags (folders)",
    "from-lerobot": "data sets of LeRobot (folders)",
    "from-hdf5": "HDF5 files",
    "from-pace": "chirps of PACE (.pt files)",
}


def _parser() -> cli.PlainParser:
    text = "Check logs, or convert recordings to a folder of CSV files and a map of their columns (docs/logs.md)."
    prog = cli.prog_of("logs")
    parser = cli.PlainParser("logs", description=text, usage="%(prog)s COMMAND PATH [PATH ...] [options]")
    formats = parser.add_subparsers(dest="format", metavar="COMMAND", required=True, prog=prog)
    of = {name: formats.add_parser(name, help=what, description=f"Convert {what}.") for name, what in FORMATS.items()}
    for name, each in of.items():
        each.usage = f"{each.prog} PATH [PATH ...] --out DIR [options]"
        each.add_argument("paths", metavar="PATH", nargs="+", help=FORMATS[name])
        each.add_argument("--out", metavar="DIR", required=True, help="folder for the logs, new")
        each.add_argument("--model", metavar="FILE", help="MJCF or URDF model; its names go into the map")
        cli.of_urdf(each)
        each.add_argument(
            "--rename", metavar="A=B", nargs="+", default=[], help="names in the recording, and those in the model"
        )
    for name in ("from-mcap", "from-rosbag"):
        _ros(of[name])
    _check(formats, prog)
    _show(formats, prog)
    of["from-lerobot"].add_argument(
        "--episodes", metavar="N", type=int, nargs="+", help="numbers of the episodes (default: all)"
    )
    _hdf5(of["from-hdf5"])
    of["from-pace"].add_argument("--joints", metavar="NAME", nargs="+", default=[], help="columns of the joints")
    for name in ("from-lerobot", "from-hdf5"):
        _units(of[name])
    return parser


def _of_folder(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", metavar="DIR", help="folder of logs, or one file")
    parser.add_argument("--model", metavar="FILE", help="MJCF or URDF model; it names joints and actuators")
    cli.of_urdf(parser)
    parser.add_argument("--map", metavar="FILE", help="map of the columns (default: map.yaml in the folder)")


def _check(formats: Any, prog: str) -> None:
    text = "how logs are read, and the channels that are missing"
    parser = formats.add_parser("check", help=text, description=f"Show {text}; write a map.yaml where there is none.")
    parser.usage = f"{prog} check DIR [--model FILE] [--map FILE]"
    _of_folder(parser)


def _show(formats: Any, prog: str) -> None:
    text = "a page of logs: channels, spectra, coverage, what excites what, rates"
    parser = formats.add_parser("show", help=text, description=f"Write {text}.")
    parser.usage = f"{prog} show DIR [--model FILE] [--map FILE] [--out FILE] [--mcap FILE]"
    _of_folder(parser)
    parser.add_argument("--out", metavar="FILE", default="show.html", help="the page (default: show.html)")
    parser.add_argument("--mcap", metavar="FILE", help="write the logs as MCAP, too, for Foxglove (extra [logs])")


def _ros(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--states", metavar="TOPIC", help="the joint states (default: the topic of that type)")
    text = "commands, for arrays with the joints in their order (default: all topics of commands)"
    parser.add_argument("--commands", metavar="TOPIC[=A,B]", nargs="+", default=[], help=text)
    text = "the commanded quantity, where messages have several: position, velocity or effort"
    parser.add_argument("--field", choices=("position", "velocity", "effort"), help=text)
    text = "which publisher of the joint states, from 1, where a refusal numbers several"
    parser.add_argument("--publisher", metavar="N", type=int, help=text)
    text = "joints in the order of the motors, of messages that number them, as Unitree's LowState"
    parser.add_argument("--joints", metavar="NAME", nargs="+", default=[], help=text)
    text = "times of headers, or when messages were received (default: header)"
    parser.add_argument("--stamps", choices=("header", "received"), default="header", help=text)


def _units(parser: argparse.ArgumentParser) -> None:
    text = "unit of positions and velocities in rad or m, as 0.017453293 of degrees (default: 1)"
    parser.add_argument("--scale", metavar="X", type=float, default=1.0, help=text)
    text = "unit of commands in that of the actuators (default: that of --scale)"
    parser.add_argument("--command_scale", metavar="X", type=float, help=text)


def _hdf5(parser: argparse.ArgumentParser) -> None:
    for what in ("positions", "commands", "velocities", "efforts", "time"):
        parser.add_argument(f"--{what}", metavar="PATH", help="array in the file; a * stands for the group of a run")
    parser.add_argument("--rate", metavar="HZ", type=float, help="rows per second, without an array of times")
    parser.add_argument("--joints", metavar="NAME", nargs="+", help="columns of positions, velocities and efforts")
    parser.add_argument(
        "--commands_of", metavar="NAME", nargs="+", help="columns of the commands (default: the joints)"
    )


def _pairs(given: Sequence[str]) -> dict[str, str]:
    for text in given:
        if "=" not in text:
            raise UserError(f"--rename {text}; allowed: NAME_IN_THE_RECORDING=NAME_IN_THE_MODEL")
    return dict(text.split("=", 1) for text in given)


def _choice(args: argparse.Namespace, model: Any) -> "Choice":
    from bayessim_mjx.logs import vendors
    from bayessim_mjx.logs.importers.ros import Choice

    topics = (text.partition("=") for text in args.commands)
    commands = {topic: [n for n in names.split(",") if n] for topic, _, names in topics}
    # the bias of a position servo pulls its joint back by the gain
    targets = model is not None and model.nu > 0 and bool((model.actuator_biasprm[:, 1] < 0).all())
    names = vendors.hinges(model) if model is not None else ()
    return Choice(args.states, commands or None, args.field, args.stamps, args.publisher, targets, args.joints, names)


def _recordings(args: argparse.Namespace, model: Any) -> Iterator["Recording"]:
    for path in map(Path, args.paths):
        if not path.exists():
            raise UserError(f"{path}: no such file or folder")
        if args.format == "from-lerobot":
            from bayessim_mjx.logs.importers import lerobot

            yield from lerobot.recordings(path, args.episodes)
        elif args.format == "from-hdf5":
            from bayessim_mjx.logs.importers import hdf5

            yield from hdf5.recordings(path, _arrays(args))
        elif args.format == "from-pace":
            from bayessim_mjx.logs.importers import pace

            yield pace.of_file(path, args.joints)
        else:
            from bayessim_mjx.logs.importers import messages, ros

            read = messages.of_mcap if args.format == "from-mcap" else messages.of_rosbag
            yield ros.recording(path.stem, read(path), _choice(args, model))


def _arrays(args: argparse.Namespace) -> Any:
    from bayessim_mjx.logs.importers.hdf5 import USUAL, WHAT, Paths

    given = {what: getattr(args, what) for what in WHAT if getattr(args, what)}
    usual = USUAL if not {"positions", "commands"} & set(given) else {}
    missing = [what for what in ("positions", "commands") if what not in given and what not in usual]
    if missing:
        raise UserError(f"--{missing[0]} is missing; allowed: the path of an array in the file")
    return Paths({**usual, **given}, args.rate, args.joints, args.commands_of)


def _logs(argv: Sequence[str] | None) -> int:
    """Convert recordings of other tools to a folder of logs, or check logs; exit code 0, or 2 (bad input)."""
    args = _parser().parse_args(argv)
    if args.format == "check":
        return _checked(args)
    if args.format == "show":
        return _shown(args)
    scale, of_commands = _scales(args)
    cli.writable(args.out, "--out")
    from bayessim_mjx.logs.importers.folder import Target

    model = _model(args)
    target = Target(Path(args.out), model, _pairs(args.rename), scale, of_commands)
    written = target.write(_recordings(args, model))
    for note in target.notes:
        print(note)
    print(f"{len(written)} log(s) and map.yaml in {target.folder}")
    model = args.model or "robot.xml"
    print(f"next: bayessim-mjx diagnose --model {model} --data {target.folder}")
    return 0


def _checked(args: argparse.Namespace) -> int:
    """Print how the logs are read; exit code 0, or 2 where something has to be mended."""
    from bayessim_mjx.logs.last_words import last_words
    from bayessim_mjx.logs.overview import overview

    path = Path(args.path)
    found = overview(path, _model(args), args.map)
    if found.logs:
        _gated(args, found)
    _table(("column", "channel", "unit", "values", "note"), found.columns)
    _table(("file", "rows", "length", "rate", "jitter", "gaps"), found.files)
    for note in found.notes:
        print(f"note: {note}")
    if found.map_text:
        _write_map(path, found.map_text)
    for fault in found.faults:
        print(fault)
    if found.end:
        print(found.end)
    if not found.faults:
        words = [args.model, *cli.urdf_words(args.drive, args.packages), "--data", str(path)]
        file = args.map or (path / "map.yaml" if path.is_dir() else "a map for --map")
        print(last_words(found, str(file), " ".join(["bayessim-mjx diagnose --model", *words])))
    return 2 if found.faults else 0


def _gated(args: argparse.Namespace, found: "Overview") -> None:
    """Add what the gate of a diagnosis says of the logs: refusals, each once with its logs, and notes."""
    from bayessim_mjx.diagnosis.fitting import cutting, robot
    from bayessim_mjx.diagnosis.logcheck import gate
    from bayessim_mjx.diagnosis.setup import control_period

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of the model, which a diagnosis says
            own = robot.of_file(args.model, None, args.drive, args.packages)
        period = control_period(own, found.logs)
        said = gate.check(found.logs, own.mj_model, period)
    except UserError as error:
        found.refused.append(str(error))
        return
    found.refused += [f"{listed(names, most=MOST)}: {reason}" for reason, names in said.reasons.items()]
    if said.refused:
        shown, of = listed([*said.refused], most=MOST), count(len(said.reports), "log")
        found.end = f"{len(said.refused)} of {of} refused: {shown}; mend the map or the log, or take the file away"
    elif lacking := cutting.too_few(said.usable, period):
        found.refused.append(lacking)
    found.doubts += said.doubts
    found.exchanged += said.exchanged
    found.notes += [text for text in (*said.doubts, *said.findings) if text not in found.notes]


def _shown(args: argparse.Namespace) -> int:
    """Write the page of the logs; exit code 0. A package that is missing is named before the logs are read."""
    for flag, path in (("--out", args.out), ("--mcap", args.mcap)):
        if path:
            cli.writable(Path(path).parent, flag)
    from bayessim_mjx.logs import exchanged, mcap_file, views
    from bayessim_mjx.report import log_page

    if args.mcap:
        mcap_file.writer()
    model = _model(args)
    shown = views.view(Path(args.path), model, args.map)
    crossed = [x.sentence for x in (exchanged.exchanges(shown.overview.logs, model) if shown.overview.logs else ())]
    shown.overview.notes += crossed
    for fault in (*shown.overview.faults, *crossed):
        print(fault)
    print(f"page: {log_page.write(shown, Path(args.out), Path(args.path).resolve().name)}")
    if args.mcap:
        print(f"mcap: {args.mcap}, {mcap_file.write(Path(args.mcap), shown.sheets)} messages")
    return 0


def _write_map(path: Path, text: str) -> None:
    """Into the folder; of a single file, or where nothing may be written, onto the terminal."""
    try:
        if path.is_dir():
            if not path.stat().st_mode & 0o222:  # also for an administrator, whom no mode would stop
                raise PermissionError(errno.EACCES, "the folder is read-only")
            with (path / "map.yaml").open("x", encoding="utf-8") as file:
                file.write(text)
            print(f"map: {path / 'map.yaml'} is written; edit it where it is wrong")
            return
        why = "a map for it, for --map"
    except OSError as error:
        why = f"{path / 'map.yaml'} cannot be written ({error.strerror}); a map for --map"
    print(f"map: {why}:")
    print("".join(f"  {line}\n" for line in text.splitlines()), end="")


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    if not rows:
        return
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    for row in (head, *rows):
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    print()


def _scales(args: argparse.Namespace) -> tuple[float, float]:
    scale = getattr(args, "scale", 1.0)
    of_commands = getattr(args, "command_scale", None)
    of_commands = scale if of_commands is None else of_commands
    for flag, value in (("--scale", scale), ("--command_scale", of_commands)):
        if not 1e-12 < abs(value) < 1e12:
            raise UserError(f"{flag} {value:g}; allowed: a number other than 0")
    if getattr(args, "rate", None) is not None and not 0 < args.rate < 1e12:
        raise UserError(f"--rate {args.rate:g}; allowed: rows per second, above 0")
    return scale, of_commands


def _model(args: argparse.Namespace) -> Any:
    if args.model is None:
        return None
    from bayessim_mjx.diagnosis.fitting import robot

    return robot.names_of(args.model, args.drive, args.packages)


main = cli.command(_logs)

if __name__ == "__main__":
    sys.exit(main())
