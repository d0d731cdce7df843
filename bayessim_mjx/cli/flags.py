"""Flags of the commands, and `section.key=value` overrides. No jax before parsing."""

import argparse
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from bayessim_mjx import trust
from bayessim_mjx.cli import ancestors
from bayessim_mjx.config.settings import WRITERS
from bayessim_mjx.errors import UserError, unknown

SCRIPT = "bayessim-mjx"  # the console script, and the name of the package as it is installed


def whole(low: int, high: int) -> Callable[[str], int]:
    """The type of a flag that takes a whole number from `low` to `high`, in the digits 0 to 9."""

    def number(text: str) -> int:
        if not re.fullmatch("[+-]?[0-9]{1,25}", text):
            raise argparse.ArgumentTypeError(f"invalid int value: {text[:60]!r}")
        if not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"{text}: must be from {low} to {high}")
        return int(text)

    return number


def positive(unit: str) -> Callable[[str], float]:
    """The type of a flag that takes a number of `unit` (a plural), more than 0 and below 1e5."""

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


def _writers(text: str) -> tuple[str, ...]:
    """The writers beside TensorBoard that --logger names."""
    if text not in (allowed := ("tensorboard", *WRITERS)):
        raise argparse.ArgumentTypeError(f"{text[:60]!r}: allowed are {', '.join(allowed)}")
    return () if text == "tensorboard" else (text,)


# flag -> (dotted key, type, help); None as type: a switch
FLAGS: dict[str, tuple[str, Any, str]] = {
    "--num_envs": ("env.numEnvs", integer, "number of simulated worlds in parallel; 0: the settings'"),
    "--episode_length": ("env.episodeLength", integer, "control steps of an episode; 0: the task's own"),
    "--seed": ("seed", integer, "random seed; -1 draws one"),
    "--max_iterations": ("ppo.max_iterations", integer, "PPO iterations in all; in main the number per round"),
    "--video": ("monitor.video", None, "record videos"),
    "--video_length": ("monitor.video_length", integer, "length of a video in control steps"),
    "--video_interval": ("monitor.video_interval", integer, "control steps of each world from one video to the next"),
    "--logger": ("monitor.writers", _writers, "where figures go beside TensorBoard: wandb, jsonl or csv"),
    "--logdir": ("logdir", str, "folder of all runs (default: logs)"),
    "--name": ("name", str, "word added to the name of the run folder"),
    "--device": ("device", str, "auto, cpu, gpu, gpu:1 or cuda:0 (default: auto)"),
    "--devices": ("devices", str, "number of devices that share the worlds, or all"),
    "--cache_dir": ("cache_dir", str, "folder of compiled programs, or off (default: $BAYESSIM_MJX_CACHE)"),
}
ALSO_KEYS = {key for key, _, _ in FLAGS.values()} | {"agent"}  # flags that are settings of the same name, too
CHECKPOINTS = {
    "play": "policy to play (default: best)",
    "gap_loop": "policies to evaluate in place of training new ones on the simulator as it was",
}
METAVARS = {str: "TEXT", integer: "N"} | {
    "--devices": "N|all",
    "--logger": "WRITER",
    "--logdir": "DIR",
    "--name": "NAME",
    "--device": "NAME",
    "--cache_dir": "DIR",
}
ZERO_IS_NONE = ("--num_envs", "--episode_length")  # 0 is BayesSimIG's default: the number that the settings have
RESUMABLE = (
    "--device", "--devices", "--cache_dir", "--video", "--video_length", "--video_interval", "--headless", "--resume",
    trust.FLAG,
)  # fmt: skip


def prog_of(command: str) -> str:
    """How `command` was started, for its usage line: by the console script or as a module."""
    script = Path(sys.argv[0]).stem == SCRIPT
    return f"{SCRIPT} {command.replace('_', '-')}" if script else f"python -m bayessim_mjx.{command}"


class Lines(argparse.HelpFormatter):
    """Texts of several lines, as tables, keep them."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if "\n" in text:
            return "\n".join(indent + line for line in text.splitlines())
        return super()._fill_text(text, width, indent)


class PlainParser(argparse.ArgumentParser):
    """Flags; what is wrong with them is a UserError. The usage line does not repeat the list of options."""

    def __init__(self, **options: Any):
        plain: dict[str, Any] = {"usage": "%(prog)s [options]", "allow_abbrev": False, "formatter_class": Lines}
        super().__init__(**(plain | options))
        self.add_argument("--version", action=Version, nargs=0, help="print the version and stop")

    def trusting(self) -> None:
        """Add the flag that lets code run which settings name."""
        text = "allow settings to use effects from this Python file; repeat for more files (docs/trust.md)"
        self.add_argument(trust.FLAG, metavar="FILE", action=Allow, default=[], help=text)

    def error(self, message: str) -> NoReturn:
        raise UserError(message.removeprefix("argument "))


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


class Parser(PlainParser):
    """Flags of one command and `section.key=value` overrides; all that is wrong is a UserError."""

    def __init__(
        self,
        prog: str,
        description: str,
        resume: bool = False,
        without: Sequence[str] = (),
        unused: Sequence[str] = (),
        but: Sequence[str] = (),
    ):
        """`without`: flags, and `unused`: sections of settings (`but` these keys), that the command does not take."""
        usage = "%(prog)s [options] [section.key=value ...]"
        super().__init__(prog=prog_of(prog), description=description, usage=usage)
        self.command, self.without, self.unused, self.but = prog, without, unused, but
        self.add_argument("--task", metavar="NAME", help="name of the task; --list_tasks prints them")
        for flag, (_, kind, text) in FLAGS.items():
            if flag in without:
                continue
            shown = METAVARS.get(flag, METAVARS.get(kind))
            options: dict[str, Any] = {"action": "store_true"} if kind is None else {"type": kind, "metavar": shown}
            self.add_argument(flag, default=None, help=text, **options)
        for flag, ours in ancestors.SAME.items():
            if ours not in without:
                self.add_argument(flag, help=argparse.SUPPRESS)
        self.trusting()
        self.add_argument("--cfg_env", metavar="FILE", help="YAML file with settings, read after cfg/<task>.yaml")
        self.add_argument("--cfg_train", metavar="FILE", help="YAML file with PPO settings, ours or rl-pytorch's")
        self.add_argument(
            "--checkpoint", metavar="PATH|latest|best", help=CHECKPOINTS.get(prog, "policy to start from")
        )
        self.add_argument("--use_last_checkpoint", action="store_true", help="same as --checkpoint latest")
        self.add_argument("--headless", action="store_true", help="plain lines instead of progress bars")
        self.add_argument("--list_tasks", action="store_true", help="print the names of the tasks and stop")
        if resume:
            more = "; with --max_iterations also a finished one" if prog == "train" else ""
            self.add_argument("--resume", metavar="RUN", help=f"continue an interrupted run{more}")
        example = "ppo.gamma=0.95" if "bayessim" in unused else "bayessim.components=5"
        self.epilog = f"section.key=value changes any setting, for example {example} (see cfg/*.yaml)"

    def parse(self, argv: Sequence[str] | None) -> argparse.Namespace:
        """Namespace with the flags, `overrides`, and `given` (flags that were used)."""
        argv = list(sys.argv[1:] if argv is None else argv)
        args, rest = self.parse_known_args(argv)
        for text in rest:
            self._refuse(text)
        for ours in dict.fromkeys(ancestors.SAME.values()):
            if ours not in self.without:
                names = [ours, *(flag for flag, same in ancestors.SAME.items() if same == ours)]
                setattr(args, ours[2:], ancestors.one_value({name: getattr(args, name[2:]) for name in names}))
        args.overrides = rest
        args.idle = [key for key in (text.split("=")[0] for text in rest) if self._has_no_use_for(key)]
        args.command = self.command
        given = [a.split("=")[0] for a in argv if a.startswith("--")]
        args.given = [ancestors.SAME.get(flag, flag) for flag in given]
        if args.use_last_checkpoint:
            if args.checkpoint not in (None, "latest"):
                raise UserError(f"--use_last_checkpoint and --checkpoint {args.checkpoint}: give one of them")
            args.checkpoint = "latest"
        return args

    def _refuse(self, text: str) -> None:
        """UserError for what is neither one of this command's flags nor an override."""
        flag = text.split("=")[0]
        if ancestors.SAME.get(flag, flag) in self.without:
            raise UserError(f"{flag}: {self.command} has no use for it")
        if flag.startswith("--") and (said := ancestors.word(flag)):
            raise UserError(f"{flag}: {said}")
        if text.startswith("-"):
            raise unknown("flag", flag, sorted(self._option_string_actions))
        if "=" not in text:
            raise UserError(f"{text!r} is neither a flag nor an override section.key=value")
        self._refuse_flag_as_key(text)

    def _refuse_flag_as_key(self, text: str) -> None:
        """UserError for a flag in Hydra's form, as IsaacGymEnvs has it: task=Ant, headless=True, test=True."""
        key, _, value = text.partition("=")
        if key in ALSO_KEYS:
            return
        said = ancestors.word(f"--{key}")
        if said is None and f"--{key}" in self._option_string_actions:
            switch = self._option_string_actions[f"--{key}"].nargs == 0
            said = f"this is a flag: --{key}" + ("" if switch else f" {value}")
        if said is not None and not value.startswith("{"):
            raise UserError(f"override {text!r}: {said}")

    def _has_no_use_for(self, key: str) -> bool:
        return key.split(".")[0] in self.unused and key not in self.but
