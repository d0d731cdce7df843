"""Malformed inputs of eight kinds, each drawn from a seed: a valid file or command line with something wrong in it.

A kind is a function `kind(rng, folder) -> (what was done, call)`. The call does what a command does with such an input
before it simulates anything; it raises, or accepts, and then says in an AssertionError if what came out is harmful.
"""

import contextlib
import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import yaml
from fuzz_files import checkpoints, logs, maps, models
from fuzz_inputs import ARM, EFFECTS, HEADER, PARAMS, Case, arm, box, choice, file_changed, junk, table


class Reached(BaseException):
    """A command accepted its input and would begin to work."""


def yamls(rng: np.random.Generator, folder: Path) -> Case:
    """Settings of a task, parameters of a diagnosis, effects."""
    from bayessim_mjx import config

    kind = choice(rng, ("env", "env", "train", "params", "effects"))
    if kind == "env":
        own = choice(rng, ("Pendulum", "Cartpole", "Ant", "ServoPendulum"))
        what = file_changed(rng, folder / "x.yaml", config.task_file(own).read_text())
        return f"{own}: {what}", lambda: _settings(config.load(own, cfg_env=folder / "x.yaml"))
    if kind == "train":
        plain = config.load("Pendulum").to_dict()["ppo"]
        what = file_changed(rng, folder / "x.yaml", config.to_yaml({"ppo": plain}))
        return what, lambda: _settings(config.load("Pendulum", cfg_train=folder / "x.yaml"))
    what = file_changed(rng, folder / "x.yaml", PARAMS if kind == "params" else EFFECTS)
    if kind == "params":
        from bayessim_mjx.diagnosis.fitting import robot

        return f"params: {what}", lambda: box(robot.read_params(folder / "x.yaml", arm()))
    return f"effects: {what}", lambda: _effects(folder / "x.yaml")


def _settings(settings: Any) -> None:
    """What is accepted is written and read again unchanged, and the task can be made of it."""
    from bayessim_mjx import config, registry

    text = config.to_yaml(settings.to_dict())
    again = config.from_dict(yaml.safe_load(text)) if "nan" not in text else settings
    assert again == settings or "${" in text, "what was accepted reads back as something else"
    env = registry.make(settings.task, config=settings)
    if hasattr(env, "space"):
        box(env.space)


def _effects(path: Path) -> None:
    from bayessim_mjx import registry
    from bayessim_mjx.effects.support import storage

    found = storage.read(path)
    box(registry.make("Pendulum", effects=found.effects).space)


def _keys() -> list[str]:
    from bayessim_mjx import config

    def leaves(node: Any, path: str) -> list[str]:
        if not isinstance(node, dict) or not node:
            return [path]
        return [k for key, value in node.items() for k in leaves(value, f"{path}.{key}".lstrip("."))]

    return leaves(config.load("Pendulum").to_dict(), "")


def overrides(rng: np.random.Generator, folder: Path) -> Case:
    """`section.key=value` with keys that exist, or nearly, and values that should not."""
    from bayessim_mjx import cli

    given = []
    for _ in range(int(rng.integers(1, 3))):
        key = (
            choice(rng, _keys())
            if rng.random() < 0.9
            else choice(rng, ("ppo", "x.y", "=", ".", "env.", "ppo.gama", "a" * 999))
        )
        given.append(f"{key}={junk(rng)}")
    argv = ["--task", "Pendulum", *given]
    return " ".join(g[:60] for g in given), lambda: _settings(cli.config_of(cli.Parser("main", "").parse(argv)))


COMMANDS = ("main", "train", "play", "diagnose", "calibrate", "gap_loop")


def flags(rng: np.random.Generator, folder: Path) -> Case:
    """Whole command lines, up to where the command would begin to work."""

    (folder / "arm.xml").write_text(ARM)
    (folder / "logs").mkdir()
    np.savetxt(folder / "logs" / "run.csv", table(), "%.6g", ",", header=HEADER, comments="")
    command = choice(rng, COMMANDS)
    module = importlib.import_module(f"bayessim_mjx.{command}")
    parser = (
        module._parser()
        if hasattr(module, "_parser")
        else __import__("bayessim_mjx.cli").cli.Parser(command, "", resume=True)
    )
    known = [o for o in parser._option_string_actions if o.startswith("--") and o not in ("--help", "--list_tasks")]
    base = {
        "diagnose": ["--model", "arm.xml", "--data", "logs"], "calibrate": ["--run", "logs"],
        "gap_loop": ["--task", "Pendulum", "--diagnosis", "logs", "--real", "logs"],
    }  # fmt: skip
    argv = list(base.get(command, ["--task", "Pendulum"]))
    for _ in range(int(rng.integers(1, 4))):
        flag = (
            choice(rng, known) if rng.random() < 0.9 else choice(rng, ("--x", "-", "--", "--task=", "-h1", junk(rng)))
        )
        argv += [flag, *([] if rng.random() < 0.3 else [junk(rng)])]
    argv = [a for a in argv if "\x00" not in a]  # no system passes such a one on
    return f"{command} " + " ".join(a[:40] for a in argv), lambda: begins(module, argv)


def begins(module: Any, argv: Sequence[str]) -> None:
    """Run the command up to where it would begin; what it prints as its own error is raised as it is."""
    from bayessim_mjx import cli
    from bayessim_mjx.diagnosis import run

    def reached(*_: Any, **__: Any) -> None:
        raise Reached

    with contextlib.ExitStack() as stack:
        for target, name in (
            (__import__("bayessim_mjx.registry").registry, "make"),
            (run, "investigate"),
            (cli, "list_tasks"),
        ):
            stack.enter_context(mock.patch.object(target, name, reached))
        stack.enter_context(mock.patch.dict("os.environ", {cli.DEBUG_VARIABLE: "1"}))
        with contextlib.suppress(Reached):
            module.main(list(argv))


KINDS: dict[str, tuple[Callable[[np.random.Generator, Path], Case], int]] = {  # and how many of 1000
    "logs": (logs, 260),
    "maps": (maps, 90),
    "yamls": (yamls, 180),
    "overrides": (overrides, 150),
    "flags": (flags, 120),
    "models": (models, 100),
    "checkpoints": (checkpoints, 100),
}
