"""What the parsers of all commands share: one prefix, groups of flags, defaults, examples, errors as UserError."""

import argparse
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from bayessim_mjx import trust
from bayessim_mjx.cli import commands
from bayessim_mjx.cli.commands import SCRIPT
from bayessim_mjx.errors import UserError, nearest, unknown
from bayessim_mjx.outside_tasks import is_file

GENERAL = "options"  # argparse's own heading of --help
# argparse's words for a value that is none of the choices; its quotes differ between versions of Python
CHOICE = re.compile(r"(?P<what>.+): invalid choice: '(?P<given>.*)' \(choose from (?P<allowed>.*)\)")


def whole(low: int, high: int) -> Callable[[str], int]:
    """Return the type of a flag that takes a whole number from `low` to `high`, in the digits 0 to 9."""

    def number(text: str) -> int:
        if not re.fullmatch("[+-]?[0-9]{1,25}", text):
            raise argparse.ArgumentTypeError(f"invalid int value: {text[:60]!r}; allowed: a whole number")
        if not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"{text}: must be from {low} to {high}")
        return int(text)

    return number


def positive(unit: str) -> Callable[[str], float]:
    """Return the type of a flag that takes a number of `unit` (a plural), more than 0 and below 1e5."""

    def number(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = 0.0
        if not 0 < value < 1e5:
            raise argparse.ArgumentTypeError(f"{text!r}: allowed: {unit}, more than 0")
        return value

    return number


integer = whole(-(10**25), 10**25)  # where the settings know the limits


def task(text: str) -> str:
    """Return the type of --task: the file of `slider.py:Slider` may run from now on, and is named by its full path."""
    if not is_file(text):
        return text
    path, _, title = text.rpartition(":")
    trust.allow([path])
    return f"{Path(path).expanduser().resolve()}:{title}"


class Help(argparse.HelpFormatter):
    """Texts of several lines, as tables, keep them; a default is shown where there is one and no text names it."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if "\n" in text:
            return "\n".join(indent + line for line in text.splitlines())
        return super()._fill_text(text, width, indent)

    def _get_help_string(self, action: argparse.Action) -> str | None:
        value = action.default
        hidden = value is None or value is False or value in ("", []) or value is argparse.SUPPRESS
        if not action.help or hidden or "(default" in action.help:
            return action.help
        return f"{action.help} (default: %(default)s)"


class PlainParser(argparse.ArgumentParser):
    """Flags of one command; what is wrong with them is a UserError that names the command's help.

    Args:
        command: its name in `commands.COMMANDS`; empty: a part of a command, whose `prog` argparse gives.
        options: of argparse.ArgumentParser.
    """

    def __init__(self, command: str = "", **options: Any):
        plain: dict[str, Any] = {"usage": "%(prog)s [options]", "allow_abbrev": False, "formatter_class": Help}
        if command:
            plain |= {"prog": commands.prog_of(command), "epilog": commands.examples_of(command)}
        super().__init__(**(plain | options))
        self.add_argument("--version", action=Version, nargs=0, help="print the version and stop")

    def group(self, heading: str) -> Any:
        """Return the group of flags under a heading of the help, made when it is first asked for."""
        known = {group.title: group for group in self._action_groups}
        return known.get(heading) or self.add_argument_group(heading)

    def trusting(self, heading: str = GENERAL) -> None:
        """Add the flag that lets code run which settings name."""
        text = "allow settings to use code from this Python file; repeat for more files (docs/trust.md)"
        self.group(heading).add_argument(trust.FLAG, metavar="FILE", action=Allow, default=[], help=text)

    def parse_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """As argparse's; an unknown flag comes with the nearest known one."""
        found, rest = self.parse_known_args(args, namespace)
        if rest and rest[0].startswith("-"):
            flags = {flag for parser in [self, *self._below()] for flag in parser._option_string_actions}
            raise self.unknown_flag(rest[0].split("=")[0], flags)
        if rest:
            self.error(f"{rest[0]!r} is neither a flag nor a flag's value")
        return found

    def _below(self) -> list[argparse.ArgumentParser]:
        """Return the parsers of the parts of this command."""
        parts = (a for a in self._actions if isinstance(a, argparse._SubParsersAction))
        return [parser for action in parts for parser in action.choices.values()]

    def unknown_flag(self, flag: str, known: Iterable[str]) -> UserError:
        """Return the error for a flag that does not exist, with the close ones."""
        close = nearest(flag, known, 2)
        hint = f" Did you mean {' or '.join(close)}?" if close else ""
        return UserError(f"flag {flag!r} is unknown.{hint} Allowed: the flags that {self.prog} --help lists")

    def refusal(self, error: UserError) -> UserError:
        """Return the error with the command that lists what is allowed."""
        return UserError(f"{error} ({self.prog} --help lists all)")

    def error(self, message: str) -> NoReturn:
        text = message.removeprefix("argument ")
        if choice := CHOICE.fullmatch(text):
            names = [name.strip(" '") for name in choice["allowed"].split(",")]
            raise self.refusal(unknown(choice["what"], choice["given"], names))
        raise self.refusal(UserError(text))


class Version(argparse.Action):
    """Prints the version of this package, and those of what decides its results, and stops."""

    def __call__(self, parser: Any, *_: Any, **__: Any) -> None:
        from bayessim_mjx.versions import versions

        found = versions()
        others = ", ".join(f"{name} {found[name]}" for name in ("python", "jax", "mujoco") if name in found)
        print(f"{SCRIPT} {found.get(SCRIPT, 'not installed')} ({others})")
        parser.exit()


class Allow(argparse.Action):
    """Takes a file of code and allows it."""

    def __call__(self, parser: Any, namespace: Any, value: Any, option: str | None = None) -> None:
        if not Path(value).is_file():
            raise UserError(f"{option} {value}: no such file; give the Python file that is to run")
        trust.allow([value])
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), value])


def of_urdf(group: Any) -> None:
    """Add the flags that a URDF needs to a parser, or to a group of its flags."""
    text = "actuators of a model that has none (URDF): torque, position:KP,KV, velocity:KV, or a YAML file by joint"
    group.add_argument("--drive", metavar="KIND", help=text)
    text = "where package://NAME/ of a URDF is: NAME=FOLDER, or a folder of packages (default: above the file)"
    group.add_argument("--packages", metavar="DIR", nargs="+", default=[], help=text)


def urdf_words(drive: str | None, packages: Sequence[str]) -> list[str]:
    """Return the flags of `of_urdf` with these values, for another command."""
    return [*(["--drive", drive] if drive else []), *(["--packages", *packages] if packages else [])]


def one_robot(args: argparse.Namespace) -> None:
    """Refuse flags that name no robot or two, and those of a URDF with a task."""
    if (args.task is None) == (args.model is None):
        raise UserError("give one of --task NAME and --model FILE")
    if args.task and (args.drive or args.packages):
        raise UserError("--drive and --packages are for --model FILE; a task has its own actuators")
