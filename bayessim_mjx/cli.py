"""What the commands share: flags, configuration from them, checkpoints by name, clean ends. No jax before parsing."""

import argparse
import contextlib
import dataclasses
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import threading
import traceback
import types
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from bayessim_mjx import trust
from bayessim_mjx.config import Config, load, replace, unknown
from bayessim_mjx.errors import UserError, disk_is_full, out_of_memory, refused

if TYPE_CHECKING:
    from bayessim_mjx.runs import Run

DEBUG_VARIABLE = "BAYESSIM_MJX_DEBUG"  # set: errors come with a traceback
BUGS = "to the issue tracker of bayessim_mjx"


def whole(low: int, high: int) -> Callable[[str], int]:
    """The type of a flag that takes a whole number from `low` to `high`, in the digits 0 to 9."""

    def number(text: str) -> int:
        if not re.fullmatch("[+-]?[0-9]{1,25}", text):
            raise argparse.ArgumentTypeError(f"invalid int value: {text[:60]!r}")
        if not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"{text}: must be from {low} to {high}")
        return int(text)

    return number


integer = whole(-(10**25), 10**25)  # where the settings know the limits

# flag -> (dotted key, type, help); None as type: a switch
FLAGS: dict[str, tuple[str, Any, str]] = {
    "--num_envs": ("env.numEnvs", integer, "number of simulated worlds in parallel"),
    "--seed": ("seed", integer, "random seed; -1 draws one"),
    "--max_iterations": ("ppo.max_iterations", integer, "PPO iterations; in main the number per round"),
    "--video": ("monitor.video", None, "record videos"),
    "--video_length": ("monitor.video_length", integer, "length of a video in control steps"),
    "--video_interval": ("monitor.video_interval", integer, "control steps of each world from one video to the next"),
    "--logdir": ("logdir", str, "folder of all runs (default: logs)"),
    "--name": ("name", str, "word added to the name of the run folder"),
    "--device": ("device", str, "auto, cpu, gpu, gpu:1 or cuda:0 (default: auto)"),
    "--devices": ("devices", str, "number of devices that share the worlds, or all"),
    "--cache_dir": ("cache_dir", str, "folder of compiled programs, or off (default: $BAYESSIM_MJX_CACHE)"),
}
CHECKPOINTS = {
    "play": "policy to play (default: best)",
    "gap_loop": "policies to evaluate in place of training new ones on the simulator as it was",
}
METAVARS = {str: "TEXT", integer: "N"} | {
    "--devices": "N|all",
    "--logdir": "DIR",
    "--name": "NAME",
    "--device": "NAME",
    "--cache_dir": "DIR",
}
RESUMABLE = (
    "--device", "--devices", "--cache_dir", "--video", "--video_length", "--video_interval", "--headless", "--resume",
    trust.FLAG,
)  # fmt: skip


class PlainParser(argparse.ArgumentParser):
    """Flags; what is wrong with them is a UserError. The usage line does not repeat the list of options."""

    def __init__(self, **options: Any):
        plain: dict[str, Any] = {"usage": "%(prog)s [options]", "allow_abbrev": False}
        super().__init__(**(plain | options))

    def trusting(self) -> None:
        """Add the flag that lets code run which settings name."""
        text = "allow settings to use effects from this Python file; repeat for more files (docs/trust.md)"
        self.add_argument(trust.FLAG, metavar="FILE", action=Allow, default=[], help=text)

    def error(self, message: str) -> NoReturn:
        raise UserError(message.removeprefix("argument "))


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
        super().__init__(prog=f"python -m bayessim_mjx.{prog}", description=description, usage=usage)
        self.command, self.without, self.unused, self.but = prog, without, unused, but
        self.add_argument("--task", metavar="NAME", help="name of the task; --list_tasks prints them")
        for flag, (_, kind, text) in FLAGS.items():
            if flag in without:
                continue
            shown = METAVARS.get(flag, METAVARS.get(kind))
            options: dict[str, Any] = {"action": "store_true"} if kind is None else {"type": kind, "metavar": shown}
            self.add_argument(flag, default=None, help=text, **options)
        self.trusting()
        self.add_argument("--cfg_env", metavar="FILE", help="YAML file with settings, read after cfg/<task>.yaml")
        self.add_argument("--cfg_train", metavar="FILE", help="YAML file with PPO settings")
        self.add_argument(
            "--checkpoint", metavar="PATH|latest|best", help=CHECKPOINTS.get(prog, "policy to start from")
        )
        self.add_argument("--use_last_checkpoint", action="store_true", help="same as --checkpoint latest")
        self.add_argument("--headless", action="store_true", help="plain lines instead of progress bars")
        self.add_argument("--list_tasks", action="store_true", help="print the names of the tasks and stop")
        if resume:
            self.add_argument("--resume", metavar="RUN", help="continue an interrupted run")
        self.epilog = "section.key=value changes any setting, for example bayessim.components=5 (see cfg/*.yaml)"

    def parse(self, argv: Sequence[str] | None) -> argparse.Namespace:
        """Namespace with the flags, `overrides`, and `given` (flags that were used)."""
        argv = list(sys.argv[1:] if argv is None else argv)
        args, rest = self.parse_known_args(argv)
        for text in rest:
            if text.split("=")[0] in self.without:
                raise UserError(f"{text.split('=')[0]}: {self.command} has no use for it")
            if text.startswith("-"):
                raise unknown("flag", text.split("=")[0], sorted(self._option_string_actions))
            if "=" not in text:
                raise UserError(f"{text!r} is neither a flag nor an override section.key=value")
        args.overrides = rest
        args.idle = [key for key in (text.split("=")[0] for text in rest) if self._has_no_use_for(key)]
        args.command = self.command
        args.given = [a.split("=")[0] for a in argv if a.startswith("--")]
        if args.use_last_checkpoint:
            if args.checkpoint not in (None, "latest"):
                raise UserError(f"--use_last_checkpoint and --checkpoint {args.checkpoint}: give one of them")
            args.checkpoint = "latest"
        return args

    def _has_no_use_for(self, key: str) -> bool:
        return key.split(".")[0] in self.unused and key not in self.but


def config_of(args: argparse.Namespace, more: Mapping[str, tuple[str, Any]] | None = None) -> Config:
    """The configuration that flags (and `more` like them), files and overrides ask for; the task has to exist."""
    flags = dict(more or {})
    for flag, (key, _, _) in FLAGS.items():
        value = getattr(args, flag[2:], None)  # not every command has every flag
        if value is not None:
            drawn = flag == "--seed" and value == -1
            flags[flag] = (key, random.SystemRandom().randrange(10_000) if drawn else value)
    task = args.task and task_name(args.task)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        settings = load(task, cfg_env=args.cfg_env, cfg_train=args.cfg_train, flags=flags, overrides=args.overrides)
    for warning in caught:
        print(f"note: {warning.message}", file=sys.stderr)
    task_name(settings.task)
    if args.idle:
        raise UserError(f"{args.idle[0]}: {args.command} has no use for it")
    return settings


def resumed_config(args: argparse.Namespace, config: Config) -> Config:
    """The settings of the run to resume, with what may change: devices, cache and videos. Anything else is refused."""
    fixed = [flag for flag in args.given if flag not in RESUMABLE] + list(args.overrides)
    if fixed:
        raise UserError(f"--resume goes on with the run's own settings, which {fixed[0]} would change; start a new run")
    video = {k: getattr(args, k) for k in ("video_length", "video_interval", "video") if getattr(args, k) is not None}
    top = {k: getattr(args, k) for k in ("device", "devices", "cache_dir") if getattr(args, k) is not None}
    monitor = dataclasses.replace(config.monitor, **video)
    return dataclasses.replace(config, monitor=monitor, **top)


def say_changes(run: "Run", console: Any) -> None:
    """Warn of all that is not as it was when the run to go on with was started; its manifest keeps it."""
    for text in run.resumed():
        console.warning(f"changed since the run was started: {text}")


def task_name(name: str) -> str:
    """The task's proper name; UserError with the close ones where there is none."""
    from bayessim_mjx import registry

    if ":" in name:
        return name
    known = {title.lower(): title for title in registry.names()}
    if name.lower().replace("_", "") not in known:
        raise unknown("--task", name, [*known.values(), *(f"{prefix}:<env>" for prefix in registry.EXTERNAL)])
    return known[name.lower().replace("_", "")]


def list_tasks() -> int:
    """Print the names of our own tasks."""
    from bayessim_mjx import registry

    print("\n".join(registry.names()))
    return 0


def find_checkpoint(which: str, task: str | None, logdir: str) -> tuple[Path, "Run | None"]:
    """(checkpoint folder, its run) for "latest", "best" (of the task's newest run) or a run's or checkpoint's path."""
    from bayessim_mjx.runs import MANIFEST, Run, checkpoints, latest_run

    if which in ("latest", "best"):
        if not task:
            raise UserError(f"--checkpoint {which}: give --task NAME, or the path of a run")
        run = latest_run(logdir, task)
        return run.checkpoint(which), run
    path = Path(which)
    if (path / MANIFEST).is_file():
        run = Run.open(path)
        return run.checkpoint("latest" if run.manifest["best"] is None else "best"), run
    if not path.is_dir():
        raise UserError(f"--checkpoint {which}: no such folder; give a run, one of its checkpoints, latest or best")
    checkpoints.read_index(path)
    parents = path.absolute().parents
    return path, Run.open(parents[1]) if (parents[1] / MANIFEST).is_file() else None


def pin_policy(config: Config) -> Config:
    """`bayessim.policyCheckpt` as the path of one checkpoint folder, which has to be there."""
    if config.bayessim.policyCheckpt is None:
        return config
    path, _ = find_checkpoint(config.bayessim.policyCheckpt, config.task, config.logdir)
    return replace(config, bayessim={"policyCheckpt": str(path.absolute())})


def load_policy(path: Path, env: Any, config: Config) -> Any:
    """The policy in a checkpoint folder; its networks have to be those of `config`."""
    import jax

    from bayessim_mjx import rl
    from bayessim_mjx.runs import checkpoints

    make = lambda key: rl.policy_of(rl.init(env, config.ppo, key))  # noqa: E731
    return checkpoints.restore(path, {"policy": jax.eval_shape(make, jax.random.PRNGKey(0))})[0]["policy"]


def privileged(config: Config, env: Any) -> tuple[Any, Any]:
    """(`env` as the policy of `config` is trained in it, the teacher of ppo.teacher or None)."""
    from bayessim_mjx.rl import privileged as shown
    from bayessim_mjx.rl import recurrent

    if config.ppo.memory:
        env = recurrent.remembering(env, config.ppo.memory_size)
    if config.ppo.policy_theta:
        env = shown.for_policy(env)
    if config.ppo.teacher is None:
        return env, None
    path, run = find_checkpoint(config.ppo.teacher, None, "")
    settings = config if run is None else run.config
    seen = shown.for_policy(env) if settings.ppo.policy_theta else env
    teacher = load_policy(path, seen, settings)
    return (shown.for_teacher(env) if settings.ppo.policy_theta else env), teacher


def warm_start(train: Any, config: Config, env: Any) -> Any:
    """The training state with actor and normaliser of `bayessim.policyCheckpt`, if that is set; the critic is new.

    `main` and `train` call it for the state that a run begins with, not when they resume one. `loop.init` does not read
    files: a program of your own that is to start from a policy calls this on `loop.init(parts).train`. With
    `bayessim.ftuneRL=False` only round 0 starts from the policy, as later rounds train new ones.
    """
    if config.bayessim.policyCheckpt is None:
        return train
    policy = load_policy(Path(config.bayessim.policyCheckpt), env, config)
    normalizer = {**train.normalizer, "policy": policy.normalizer}
    return train.replace(params={**train.params, "actor": policy.actor}, normalizer=normalizer)


class Stop:
    """Ctrl-C (or SIGTERM) asked for: `requested` is looked at where the state is whole."""

    requested = False

    def check(self) -> None:
        """End here if a stop was asked for."""
        if self.requested:
            raise KeyboardInterrupt

    def save(self, save: Callable[[], Any]) -> None:
        """If a stop was asked for: save a checkpoint, then end."""
        if self.requested:
            save()
            raise KeyboardInterrupt


@contextlib.contextmanager
def graceful() -> Iterator[Stop]:
    """While inside, the first Ctrl-C asks for a stop at the next whole state, and the second one stops at once."""
    stop, before = Stop(), {}

    def ask(number: int, frame: types.FrameType | None) -> None:
        if stop.requested:
            raise KeyboardInterrupt
        stop.requested = True
        print("\nstopping after this step, with a checkpoint (again: at once)", file=sys.stderr)

    if threading.current_thread() is threading.main_thread():
        before = {n: signal.signal(n, ask) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def first_writes(config: Config, run: "Run | None") -> Iterator[tuple[Config, "Run | None"]]:
    """Of several processes the first one alone writes: the others work silently in folders that are then removed."""
    import jax

    if jax.process_count() == 1:
        yield config, run
        return
    from jax.experimental.multihost_utils import sync_global_devices

    from bayessim_mjx.runs import Run

    with contextlib.ExitStack() as stack:
        if jax.process_index() > 0:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bayessim_mjx_")))
            config = dataclasses.replace(config, logdir=str(folder))
            run = run and Run.open(shutil.copytree(run.path, folder / "run"))
            stack.enter_context(contextlib.redirect_stdout(stack.enter_context(open(os.devnull, "w"))))
        sync_global_devices("the run to go on with is read")
        yield config, run
        sync_global_devices("the run is finished")


@contextlib.contextmanager
def running(run: "Run", say: Callable[[str], Any]) -> Iterator[None]:
    """The run's status: running while inside; then finished, interrupted (Ctrl-C) or failed (any error; `error`)."""
    try:
        run.set_status("running")
        yield
        run.set_status("finished")
    except KeyboardInterrupt:
        run.set_status("interrupted")
        say(f"interrupted; go on with --resume {run.path}")
        raise
    except Exception as error:
        full = disk_is_full(error)
        with contextlib.suppress(OSError):  # what cannot be written must not hide the first error
            run.set_status("failed", "the disk is full" if full else f"{type(error).__name__}: {error}")
        if full:
            why = _one_line(error)
            advice = f"make room and go on with --resume {run.path}"
            raise UserError(f"{run.path}: the disk is full ({why}); {advice}") from error
        raise


def command(run: Callable[[Sequence[str] | None], int]) -> Callable[..., int]:
    """A `main(argv=None)` that returns an exit code.

    0; 2 and one line on stderr for what the user can mend; 1 and a traceback for a bug; 130 after Ctrl-C.
    """

    def main(argv: Sequence[str] | None = None) -> int:
        try:
            return run(argv)
        except KeyboardInterrupt:
            return 130
        except BrokenPipeError:  # `... | head`: nobody reads on
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except SystemExit as end:  # --help
            if end.code in (None, 0):
                return 0
            return _bug()
        except Exception as error:
            if os.environ.get(DEBUG_VARIABLE):
                raise
            if not isinstance(error, UserError) and not refused(error):
                return _bug()
            print(f"error: {_one_line(error)}", file=sys.stderr)
            return 2

    main.__doc__ = run.__doc__
    return main


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split("\n"))
    if not out_of_memory(error):
        return text
    return f"{text.rstrip('. ') or 'out of memory'}; lower env.numEnvs, ppo.num_steps or bayessim.trainTrajs"


def _bug() -> int:
    """The traceback of the present error, and what to do with it."""
    traceback.print_exc()
    print(f"\nThis is a bug: please report it with the lines above and your command, {BUGS}", file=sys.stderr)
    return 1
