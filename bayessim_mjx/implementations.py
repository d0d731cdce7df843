"""`bayessim-mjx implementations --task T --num_envs N`: which implementation of MuJoCo is faster here, for auto."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayessim_mjx import cli
from bayessim_mjx.config.settings import COUNT
from bayessim_mjx.device import setup_jax
from bayessim_mjx.errors import UserError, out_of_memory
from bayessim_mjx.quantities import compact, count, duration

if TYPE_CHECKING:
    from bayessim_mjx.config import Config
    from bayessim_mjx.monitor.console import Console
    from bayessim_mjx.physics.measured import Measurement
    from bayessim_mjx.rl.speed import Speed

SECONDS = 60.0
NAMES = {"jax": "JAX", "warp": "Warp"}
NO_ROOM = "out of memory"
ACTUAL = (UserError, NotImplementedError)  # how a model is refused, by us or by MJX


def _parser() -> cli.PlainParser:
    parser = cli.PlainParser(
        "implementations",
        description="Measure whether MJX's JAX implementation or MuJoCo Warp simulates a task faster on this device. "
        "env.impl=auto goes by it from then on.",
        usage="%(prog)s --task TASK [options]",
    )
    measured, computing = parser.group("measurement"), parser.group("computing")
    text = "name of a task, or file.py:Class (bayessim-mjx main --list_tasks)"
    measured.add_argument("--task", metavar="TASK", type=cli.task, required=True, help=text)
    text = "numbers of worlds to measure with (default: the task's)"
    measured.add_argument("--num_envs", metavar="N", nargs="+", type=cli.whole(1, COUNT), help=text)
    text = f"for all rollouts together, without compiling (default: {SECONDS:.0f})"
    measured.add_argument("--seconds", metavar="S", type=cli.positive("seconds"), default=SECONDS, help=text)
    text = "remove the task's measurements, and stop"
    measured.add_argument("--forget", action="store_true", help=text)
    computing.add_argument("--device", metavar="NAME", help="auto, cpu, gpu, gpu:1 or cuda:0 (default: auto)")
    text = "folder of compiled programs, or off (default: $BAYESSIM_MJX_CACHE, else ~/.cache/bayessim_mjx)"
    computing.add_argument("--cache_dir", metavar="DIR", help=text)
    parser.group("output").add_argument("--headless", action="store_true", help="plain lines, without colours")
    return parser


def _task(given: str) -> str:
    name = cli.task_name(given)
    if ":" in name:
        raise UserError(
            f"--task {name}: it is not simulated here and chooses its implementation itself; give one of our tasks"
        )
    return name


def _settings(args: argparse.Namespace) -> "Config":
    from bayessim_mjx.config import load

    top = {key: getattr(args, key) for key in ("device", "cache_dir") if getattr(args, key) is not None}
    return load(_task(args.task), flags={f"--{key}": (key, value) for key, value in top.items()})


def _forget(task: str, console: "Console") -> int:
    from bayessim_mjx.physics import measured

    file = measured.path()
    kept = measured.read(file)
    others = [m for m in kept if m.task != task]
    if file is not None and len(others) < len(kept):
        _write(file, others)
    console.say(f"{count(len(kept) - len(others), 'measurement')} of {task} removed from {file or 'no file'}")
    return 0


def _write(file: Path, kept: Sequence["Measurement"]) -> None:
    from bayessim_mjx import atomic
    from bayessim_mjx.physics import measured

    file.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_json(file, measured.content(kept))


def _refused(config: "Config") -> str | None:
    """Why Warp cannot simulate the task; None: it can, judging by its model."""
    from bayessim_mjx import registry

    try:
        registry.make(config.task, config=config, impl="warp")
    except ACTUAL as error:
        return _reason(error)
    return None


def _reason(error: Exception) -> str:
    return str(error).removeprefix("env.impl = 'warp': ").removeprefix("env.impl = 'warp' ")


def _speed(config: "Config", impl: str, worlds: int, seconds: float) -> "Speed | str":
    """Measure the speed of one implementation, or say why there is none."""
    from bayessim_mjx import registry
    from bayessim_mjx.rl import speed

    try:
        env = registry.make(config.task, config=config, impl=impl, numEnvs=worlds)
        return speed.measure(env, worlds, config.ppo.num_steps, seconds)
    except Exception as error:
        if out_of_memory(error):
            return NO_ROOM
        if impl == "warp" and isinstance(error, ACTUAL):
            return _reason(error)
        raise


def _told(impl: str, found: "Speed | str") -> str:
    if isinstance(found, str):
        return f"{NAMES[impl]}: {found}"
    return f"{NAMES[impl]} {_rates(found)} steps/s, compiled or loaded in {duration(found.compiling)}"


def _rates(found: "Speed | str") -> str:
    """`4.8M (4.7M to 4.9M)`: median and range."""
    if isinstance(found, str):
        return found if found == NO_ROOM else "-"
    from bayessim_mjx.physics.measured import rate

    low, high = rate(min(found.rates)), rate(max(found.rates))
    return rate(found.median) + (f" ({low} to {high})" if len(found.rates) > 1 else "")


def _measure(
    config: "Config", numbers: Sequence[int], impls: Sequence[str], seconds: float, console: "Console"
) -> list[dict[str, Any]]:
    """{"worlds", implementation: its speed or why there is none, "kept"} for each number; written as soon as known."""
    rows: list[dict[str, Any]] = []
    share = seconds / len(numbers) / len(impls)
    for worlds in numbers:
        row: dict[str, Any] = {"worlds": worlds}
        for impl in impls:
            console.phase(f"{count(worlds, 'world')}, {NAMES[impl]}")
            row[impl] = _speed(config, impl, worlds, share)
            console.say(f"{count(worlds, 'world')}: {_told(impl, row[impl])}")
        rows.append({**row, "kept": _keep(config.task, row)})
    return rows


def _keep(task: str, row: dict[str, Any]) -> bool:
    """Whether there was anything that auto can go by: two speeds, or one where the other had not the memory."""
    from bayessim_mjx.physics import implementation, measured
    from bayessim_mjx.versions import of

    file, found = measured.path(), [row.get(impl, "") for impl in NAMES]
    rates = [None if isinstance(f, str) else f.median for f in found]
    if file is None or any(isinstance(f, str) and f != NO_ROOM for f in found) or not any(rates):
        return False
    new = measured.Measurement(task, implementation.kind(), row["worlds"], rates[0], rates[1], of(measured.VERSIONS))
    _write(file, measured.with_new(measured.read(file), new))
    return True


def _table(rows: Sequence[dict[str, Any]], impls: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    header = ["worlds", *(f"{NAMES[impl]} [steps/s]" for impl in impls)]
    header += ["Warp / JAX"] if len(impls) > 1 else []
    cells = []
    for row in rows:
        found = [row[impl] for impl in impls]
        line = [str(row["worlds"]), *map(_rates, found)]
        if len(impls) > 1:
            both = not any(isinstance(f, str) for f in found)
            line.append(compact(found[1].median / found[0].median, 3) if both else "-")
        cells.append([*line, ", ".join("-" if isinstance(f, str) else duration(f.compiling) for f in found)])
    return [*header, "compiled in" + (" (JAX, Warp)" if len(impls) > 1 else "")], cells


def _quiet() -> None:
    """Warp reports every kernel that it compiles, by the dozen."""
    import warp

    settings: Any = warp.config
    if hasattr(settings, "log_level"):
        settings.log_level = warp.LOG_WARNING
    else:  # as older ones call it
        settings.quiet = True


def _conclusion(config: "Config", console: "Console", kept: bool) -> None:
    """Print what auto takes from now on, where that is stored, and what else changes with it."""
    from bayessim_mjx import registry
    from bayessim_mjx.physics import implementation, measured
    from bayessim_mjx.physics.warp import LEAST_ITERATIONS

    env: Any = registry.make(config.task, config=config, impl="jax")
    file, device = measured.path(), implementation.kind()
    steps = implementation.steps(config.task, env.physics.effects)
    (_, first), *later = steps
    taken = ", ".join([first.impl, *(f"{choice.impl} from {count(worlds, 'world')} on" for worlds, choice in later)])
    console.say(f"env.impl=auto takes for {config.task} on {device}: {taken}")
    allowed = min(env.mj_model.opt.iterations, env.mj_model.opt.ls_iterations)
    if allowed < LEAST_ITERATIONS and any(choice.impl == "warp" for _, choice in steps):
        console.say(
            f"The model allows fewer solver iterations ({allowed}) than Warp makes (up to {LEAST_ITERATIONS}), so the "
            "motion may differ after contacts: name one implementation where runs are compared."
        )
    if file is None:
        console.warning("nothing is kept, as $BAYESSIM_MJX_CACHE is off: env.impl=auto does not know of it")
    elif kept:
        console.say(f"kept in {file}; --forget removes it")


def _implementations(argv: Sequence[str] | None) -> int:
    """Both implementations' speeds, kept for auto; exit code 0, or 2 (bad input)."""
    args = _parser().parse_args(argv)
    config = _settings(args)
    from bayessim_mjx.monitor.console import Console

    with Console(headless=args.headless) as console:
        if args.forget:
            return _forget(config.task, console)
        device = setup_jax(config)
        from bayessim_mjx.physics import implementation, measured

        measured.read(measured.path())  # refuse a damaged file before, not after a minute
        numbers = sorted(set(args.num_envs or [config.env.numEnvs]))
        if implementation.installed():
            _quiet()
        refused = _refused(config)
        impls = ["jax"] if refused else list(NAMES)
        console.start({"task": config.task, "device": f"{device} ({device.device_kind})"})
        if refused:
            console.warning(f"Warp is left out, so nothing is kept for env.impl=auto: {refused}")
        rows = _measure(config, numbers, impls, args.seconds, console)
        console.close()
        console.grid(*_table(rows, impls))
        _conclusion(config, console, any(row["kept"] for row in rows))
    return 0


main = cli.command(_implementations)

if __name__ == "__main__":
    sys.exit(main())
