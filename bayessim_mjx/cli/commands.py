"""The commands: the group, one line and two examples of each. Help, completion and messages read this table."""

import argparse
import re
from collections.abc import Mapping
from dataclasses import dataclass

from bayessim_mjx.errors import UserError
from bayessim_mjx.task_names import names

SCRIPT = "bayessim-mjx"  # the console script, and the name of the package as it is installed
SITE = "https://bayessim-mjx.github.io/bayessim_mjx/"


@dataclass(frozen=True)
class Command:
    """One command.

    Attributes:
        group: heading of the list of commands. about: one line. examples: its arguments; capitals stand for what
            exists on the user's disk. module: its file in the package; empty: its name with an underscore.
    """

    group: str
    about: str
    examples: tuple[str, ...]
    module: str = ""


ADAPT, DIAGNOSE, POLICIES = "adapt to a real system", "diagnose a simulator", "policies"
LOGS, CHECKS, SHELL = "logs", "checks", "shell"

COMMANDS = {
    "main": Command(
        ADAPT,
        "adaptive domain randomisation: train, observe, infer, repeat",
        ("--task Pendulum", "--task ServoPendulum real.logs=LOGS bayessim.realIters=2"),
    ),
    "diagnose": Command(
        DIAGNOSE,
        "find the effects that a simulator lacks, from recorded motion",
        ("--model robot.xml --data LOGS", "--task Pendulum --data LOGS --effects payload,backlash"),
    ),
    "gap-loop": Command(
        DIAGNOSE,
        "measure the return that a diagnosed correction recovers",
        (
            "--task Pendulum --diagnosis found --real LOGS",
            "--task Pendulum --diagnosis found --surrogate truth.yaml",
        ),
    ),
    "logs": Command(
        LOGS,
        "check and show logs; convert MCAP, ROS bags, LeRobot, HDF5",
        ("check LOGS --model robot.xml", "from-mcap run.mcap --model robot.xml --out logs"),
        "import_logs",
    ),
    "train": Command(
        POLICIES,
        "train a policy with PPO alone",
        ("--task Ant --randomize", "--domain RUN --max_iterations 1500"),
    ),
    "play": Command(
        POLICIES,
        "evaluate, film or export a saved policy",
        ("--task Pendulum --checkpoint best --video", "--task Pendulum --use_pretrained_checkpoint --video"),
    ),
    "policy": Command(
        POLICIES,
        "compare a deployed policy with the file that was exported",
        ("check policy.onnx --logs LOGS", "check policy.onnx --logs LOGS --golden robot.json"),
        "policy_check",
    ),
    "calibrate": Command(
        CHECKS,
        "test whether the posterior of a finished run can be trusted",
        ("--run RUN", "--run RUN --checkpoint best --pairs 2000"),
    ),
    "blind": Command(
        CHECKS,
        "test which missing effects a diagnosis finds on your robot",
        ("--model robot.xml --data LOGS", "--task Pendulum --cases 20 --minutes 30"),
        "blind_check",
    ),
    "implementations": Command(
        CHECKS,
        "measure whether JAX or MuJoCo Warp is faster here",
        ("--task Ant", "--task Ant --num_envs 1024 4096"),
    ),
    "help": Command(SHELL, "show the help of a command, or the settings", ("diagnose", "settings ppo"), "main"),
    "completion": Command(
        SHELL,
        "print a script that completes commands in bash, zsh or fish",
        ("bash", "fish"),
        "main",
    ),
}


def name_of(written: str) -> str:
    """Return the command's name as it is typed: `gap_loop`, a module's name and `gap-loop` are one."""
    modules = {command.module: name for name, command in COMMANDS.items() if command.module not in ("", "main")}
    return modules.get(written, written.replace("_", "-"))


def module_of(name: str) -> str:
    """Return the file of a command."""
    return COMMANDS[name].module or name.replace("-", "_")


def prog_of(name: str) -> str:
    """How a command is called in every help and message."""
    return f"{SCRIPT} {name_of(name)}"


def examples_of(name: str) -> str:
    """Return the examples of a command as a part of its help."""
    name = name_of(name)
    if name not in COMMANDS:  # a script's own parser
        return ""
    lines = [f"  {prog_of(name)} {arguments}" for arguments in COMMANDS[name].examples]
    words = sorted(set(re.findall(r"\b(?:LOGS|RUN)\b", " ".join(lines))))
    stands = {"LOGS": "LOGS is a folder of logs", "RUN": "RUN is the folder of a run, such as logs/Ant/<date>"}
    note = f"  ({'; '.join(stands[word] for word in words)})" if words else ""
    return "\n".join(["examples:", *lines, *filter(None, [note])])


def overview() -> str:
    """All commands in their groups, a line for each."""
    headings = dict.fromkeys(command.group for command in COMMANDS.values())
    parts = []
    for heading in headings:
        lines = [f"  {name:16}{c.about}" for name, c in COMMANDS.items() if c.group == heading]
        parts.append("\n".join([f"{heading}:", *lines]))
    return "\n\n".join(parts)


# Scripts by which a shell completes commands, flags, files and the names of tasks, made by shtab from the parsers


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
