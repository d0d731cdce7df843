"""Scripts by which a shell completes commands, flags, files and the names of tasks, made by shtab from the parsers."""

import argparse
from collections.abc import Mapping

from bayessim_mjx.cli.commands import SCRIPT
from bayessim_mjx.errors import UserError
from bayessim_mjx.task_names import names

SHELLS = ("bash", "zsh", "fish")
FILES, FOLDERS = ("FILE", "PATH", "LOGS"), ("DIR", "RUN", "PATH|latest|best")  # by the word that --help has


def script(shell: str, commands: Mapping[str, tuple[str, argparse.ArgumentParser]]) -> str:
    """Return the script for `shell`; `commands` are (what each is for, its parser) by the name that is typed.

    Raises:
        UserError: shtab is not installed.
    """
    try:
        import shtab
    except ImportError:
        raise UserError("completion needs the package shtab: pip install 'bayessim-mjx[completion]'") from None
    whole = argparse.ArgumentParser(prog=SCRIPT)
    under = whole.add_subparsers()
    for name, (text, parser) in commands.items():
        _hint(parser, {"FILE": shtab.FILE, "DIR": shtab.DIRECTORY})
        # a help text is a format
        under.add_parser(name, parents=[parser], add_help=False, help=text.replace("%", "%%"))
    return shtab.complete(whole, shell)


def _hint(parser: argparse.ArgumentParser, files: Mapping[str, dict]) -> None:
    """Say of each flag what follows it."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for inner in action.choices.values():
                _hint(inner, files)
        elif "--task" in action.option_strings:
            action.choices = names()
        elif action.metavar in FILES:
            action.complete = files["FILE"]  # type: ignore[attr-defined]
        elif action.metavar in FOLDERS:
            action.complete = files["DIR"]  # type: ignore[attr-defined]
