"""Flags that set settings, and `section.key=value` overrides. No jax before parsing."""

import argparse
import dataclasses
import sys
from collections.abc import Iterable, Sequence
from typing import Any

from bayessim_mjx import trust
from bayessim_mjx.cli import ancestors, commands
from bayessim_mjx.cli.parsers import PlainParser, integer, task
from bayessim_mjx.config import listing
from bayessim_mjx.config.layers import SECTIONS
from bayessim_mjx.config.settings import WRITERS, Config
from bayessim_mjx.errors import UserError


def _writers(text: str) -> tuple[str, ...]:
    """Return the writers beside TensorBoard that --logger names."""
    if text not in (allowed := ("tensorboard", *WRITERS)):
        raise argparse.ArgumentTypeError(f"{text[:60]!r}: allowed are {', '.join(allowed)}")
    return () if text == "tensorboard" else (text,)


# flag -> (dotted key, type, help); None as type: a switch
FLAGS: dict[str, tuple[str, Any, str]] = {
    "--num_envs": ("env.numEnvs", integer, "number of simulated worlds in parallel; 0: the settings'"),
    "--episode_length": ("env.episodeLength", integer, "control steps of an episode; 0: the settings'"),
    "--seed": ("seed", integer, "random seed; -1 draws one"),
    "--max_iterations": ("ppo.max_iterations", integer, "PPO iterations"),
    "--video": ("monitor.video", None, "record videos"),
    "--video_length": ("monitor.video_length", integer, "length of a video in control steps"),
    "--video_interval": ("monitor.video_interval", integer, "control steps of each world from one video to the next"),
    "--logger": ("monitor.writers", _writers, "where figures go beside TensorBoard: wandb, jsonl or csv"),
    "--logdir": ("logdir", str, "folder of all runs"),
    "--name": ("name", str, "word added to the name of the run folder"),
    "--device": ("device", str, "auto, cpu, gpu, gpu:1 or cuda:0"),
    "--devices": ("devices", str, "number of devices that share the worlds, or all"),
    "--cache_dir": (
        "cache_dir",
        str,
        "folder of compiled programs, or off (default: $BAYESSIM_MJX_CACHE, else ~/.cache/bayessim_mjx)",
    ),
}
TASK, TRAINING, OUTPUT, COMPUTING = "task and settings", "training", "output", "computing"
PLAYED = "policy"  # heading of the checkpoint in `play`
ORDER = (TASK, "diagnosis", "real system", "physics", PLAYED, TRAINING, "evaluation", OUTPUT, COMPUTING)  # of headings
HEADINGS = {
    TASK: ("--num_envs", "--episode_length", "--seed"),
    TRAINING: ("--max_iterations",),
    OUTPUT: ("--logdir", "--name", "--logger", "--video", "--video_length", "--video_interval"),
    COMPUTING: ("--device", "--devices", "--cache_dir"),
}
SAID = {  # what a flag means in one command, where that differs
    ("main", "--max_iterations"): "PPO iterations of each round",
    ("train", "--max_iterations"): "PPO iterations in all",
    ("play", "--checkpoint"): "policy to play; best: the highest return of the newest run that trained (default: best)",
    ("gap-loop", "--checkpoint"): "policies to evaluate in place of training new ones on the simulator as it was",
    ("train", "--resume"): "continue an interrupted run; with --max_iterations also a finished one",
}
ALSO_KEYS = {key for key, _, _ in FLAGS.values()} | {"agent"}  # flags that are settings of the same name, too
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


def default_of(key: str) -> str:
    """Return the default of a setting as a help shows it; empty where there is none to show."""
    section, _, name = key.rpartition(".")
    if section in ("env", "ppo"):
        return " (default: the task's)"
    kind: Any = SECTIONS[section] if section else Config
    value = next(f.default for f in dataclasses.fields(kind) if f.name == name)
    return "" if value is None or value is False or value in ("", ()) else f" (default: {value})"


class Parser(PlainParser):
    """Flags of one command and `section.key=value` overrides; all that is wrong is a UserError."""

    def __init__(
        self,
        command: str,
        description: str,
        resume: bool = False,
        without: Sequence[str] = (),
        unused: Sequence[str] = (),
        but: Sequence[str] = (),
    ):
        """`without`: flags, and `unused`: sections of settings (`but` these keys), that the command does not take."""
        super().__init__(command, description=description, usage="%(prog)s [options] [section.key=value ...]")
        self.command, self.without, self.unused, self.but = commands.name_of(command), without, unused, but
        for heading in ORDER:  # one without flags is not shown
            self.group(heading)
        group = self.group(TASK)
        text = "name of a task, or file.py:Class; --list_tasks prints names"
        group.add_argument("--task", metavar="TASK", type=task, help=text)
        group.add_argument("--cfg_env", metavar="FILE", help="YAML file with settings, read after cfg/<task>.yaml")
        group.add_argument("--cfg_train", metavar="FILE", help="YAML file with PPO settings, ours or rl-pytorch's")
        for heading, flags in HEADINGS.items():
            for flag in flags:
                self._setting(heading, flag)
        for flag, ours in ancestors.SAME.items():
            if ours not in without:
                self.add_argument(flag, help=argparse.SUPPRESS)
        self.trusting(TASK)
        self._start(resume)
        self.group(OUTPUT).add_argument("--headless", action="store_true", help="plain lines instead of progress bars")
        group.add_argument("--list_tasks", action="store_true", help="print the names of the tasks and stop")
        example = "ppo.gamma=0.95" if "bayessim" in unused else "bayessim.components=5"
        self.epilog = f"{self.epilog or ''}\n\nsection.key=value changes any setting: {example} (docs/commands.md)"

    def _setting(self, heading: str, flag: str) -> None:
        """Add a flag that sets a setting."""
        if flag in self.without:
            return
        key, kind, text = FLAGS[flag]
        shown = METAVARS.get(flag, METAVARS.get(kind))
        options: dict[str, Any] = {"action": "store_true"} if kind is None else {"type": kind, "metavar": shown}
        text = SAID.get((self.command, flag), text)
        text += "" if "(default" in text else default_of(key)
        self.group(heading).add_argument(flag, default=None, help=text, **options)

    def _start(self, resume: bool) -> None:
        """Add the flags that say which policy or run a command begins with."""
        group = self.group(PLAYED if self.command == "play" else TRAINING)
        text = SAID.get((self.command, "--checkpoint"), "policy to start from")
        group.add_argument("--checkpoint", metavar="PATH|latest|best", help=text)
        group.add_argument("--use_last_checkpoint", action="store_true", help="same as --checkpoint latest")
        if resume:
            text = SAID.get((self.command, "--resume"), "continue an interrupted run")
            group.add_argument("--resume", metavar="RUN", help=text)

    def parse(self, argv: Sequence[str] | None) -> argparse.Namespace:
        """Namespace with the flags, `overrides`, and `given` (flags that were used)."""
        argv = list(sys.argv[1:] if argv is None else argv)
        if argv and commands.name_of(argv[0]) in commands.COMMANDS:
            self._refuse(argv[0])  # before --help shows this command's
        args, rest = self.parse_known_args(argv)
        for text in rest:
            self._refuse(text)
        for ours in dict.fromkeys(ancestors.SAME.values()):
            if ours not in self.without:
                names = [ours, *(flag for flag, same in ancestors.SAME.items() if same == ours)]
                setattr(args, ours[2:], ancestors.one_value({name: getattr(args, name[2:]) for name in names}))
        args.overrides = rest
        args.idle = [key for key in (text.split("=")[0] for text in rest) if self._idle(key)]
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
            raise UserError(f"{flag}: {self.command} has no use for it; leave it out ({self.prog} --help lists all)")
        if flag.startswith("--") and (said := ancestors.word(flag)):
            raise UserError(f"{flag}: {said}")
        if text.startswith("-"):
            raise self.unknown_flag(flag, self._option_string_actions)
        if commands.name_of(text) in commands.COMMANDS:
            raise UserError(f"{text!r} is a command of its own: {commands.prog_of(text)}")
        if "=" not in text:
            raise self.refusal(UserError(f"{text!r} is neither a flag nor an override section.key=value"))
        self._refuse_flag_as_key(text)

    def unknown_flag(self, flag: str, known: Iterable[str]) -> UserError:
        """Return the error for a flag that does not exist, with the settings of that name, else with close flags."""
        name = flag.strip("-").replace("-", "_").rpartition(".")[2]
        same = [f"{key}=VALUE" for key in listing.paths() if key.rpartition(".")[2] == name and not self._idle(key)]
        if not same:
            return super().unknown_flag(flag, known)
        return UserError(f"flag {flag!r} is unknown. Did you mean the setting {' or '.join(same)}, without dashes?")

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

    def _idle(self, key: str) -> bool:
        return key.split(".")[0] in self.unused and key not in self.but
