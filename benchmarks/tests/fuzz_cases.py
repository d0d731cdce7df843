"""Malformed inputs of eight kinds, each drawn from a seed: a valid file or command line with something wrong in it.

A kind is a function `kind(rng, folder) -> (what was done, call)`. The call does what a command does with such an input
before it simulates anything; it raises, or accepts, and then says in an AssertionError if what came out is harmful.
"""

import contextlib
import copy
import functools
import importlib
import json
import re
import shutil
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import yaml

Case = tuple[str, Callable[[], Any]]
JUNK = (
    "", " ", "nan", "inf", "-inf", ".nan", ".inf", "1e400", "-1", "0", "-0.0", "1e-320", "99999999999999999999", "1e12",
    "3.7", "true", "no", "null", "~", "[]", "{}", "[1, 2", "{a: 1", "!!python/object/apply:os.abort []", "&a [*a]",
    "*b", "${oc.env:HOME}", "${task}", "../../etc/passwd", "/etc/passwd", "/", "\u0661", "\u00e9\U0001f600", "\x00",
    "\x1b[2J", "a" * 300, "0x1F", "1_000", "[" * 2000, "2020-01-01", "'", '"', "- -", "*", "path.py:Class", "Pendulum",
    "best", "1e3", "1e30", "-5e-3", "[0, 1]", "[1, 0]",
)  # fmt: skip
ARM = """<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="Euler" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.1" range="-3 3" limited="true"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1" contype="0" conaffinity="0"/>
      <body name="lower" pos="0 0 -.3"><joint name="elbow" type="hinge" axis="0 1 0" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5" contype="0" conaffinity="0"/></body>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="shoulder" gear="2" ctrlrange="-2 2" ctrllimited="true"/>
    <position name="p" joint="elbow" kp="5" kv=".1"/></actuator>
</mujoco>"""
SIDE = """condition: cold
controller: {p: {law: position, kp: 3, limit: 2.0}}
repeat_of: run.csv
sigma: {elbow: 0.01}
quantum: {"qpos:shoulder": 0.001}
"""
MAP = """files: "*.csv"
delimiter: ","
header: true
time: {column: time, scale: 1.0}
ctrl: {m: "ctrl:m", p: {column: "ctrl:p", sign: -1, offset: 0.1}}
qpos: {shoulder: {column: "qpos:shoulder", signed: 16, wrap: 6.283}, elbow: {value: 0.0}}
streams: {temperature: 5}
metadata: {operating_condition: bench}
"""
PARAMS = """task:
  randomize: true
  randomization_params:
    actor_params:
      robot:
        dof_properties:
          damping: {range: [0.5, 2.0], operation: scaling, distribution: uniform, include: shoulder}
        rigid_body_properties:
          mass: {range: [0.8, 1.2], operation: scaling, distribution: loguniform}
"""
EFFECTS = """schema: 1
effects:
- effect: coulomb_friction
  where: hinge
  parameters: {level: {range: [0.0, 0.2], nominal: 0.05}}
calibrated: []
"""


class Reached(BaseException):
    """A command accepted its input and would begin to work."""


def junk(rng: np.random.Generator) -> str:
    return JUNK[rng.integers(len(JUNK))]


def choice(rng: np.random.Generator, items: Sequence[Any]) -> Any:
    return items[int(rng.integers(len(items)))]


@functools.cache
def arm() -> Any:
    import mujoco

    return mujoco.MjModel.from_xml_string(ARM)


def table(rows: int = 60) -> np.ndarray:
    """time, two commands, two angles, a temperature."""
    t = 0.01 * np.arange(rows)
    return np.stack([t, np.sin(5 * t), 0.3 * np.cos(t), 0.5 * np.sin(3 * t), 0.2 * np.cos(2 * t), 20 + t], 1)


HEADER = "time,ctrl:m,ctrl:p,qpos:shoulder,qpos:elbow,temperature"


def bytes_changed(rng: np.random.Generator, data: bytes) -> tuple[str, bytes]:
    """Flipped, cut, doubled or foreign bytes."""
    at, much = int(rng.integers(max(len(data), 1))), bytearray(data)
    how = choice(rng, ("flip", "cut", "double", "insert", "utf-16", "empty", "bom"))
    if how == "flip":
        for i in rng.integers(max(len(data), 1), size=5):
            if len(much):
                much[i] ^= int(rng.integers(1, 256))
    elif how == "insert":
        much[at:at] = rng.bytes(8)
    changed = {
        "flip": bytes(much), "cut": data[:at], "double": data[:at] + data, "insert": bytes(much), "empty": b"",
        "utf-16": data.decode("latin-1").encode("utf-16"), "bom": b"\xef\xbb\xbf" + data,
    }[how]  # fmt: skip
    return f"bytes: {how}", changed


def text_changed(rng: np.random.Generator, text: str) -> tuple[str, str]:
    """One token of a text replaced by junk, or a line lost, doubled, indented or moved."""
    tokens = [m.span() for m in re.finditer(r"[\w.:+-]+", text)]
    lines = text.splitlines()
    numbers = [(a, b) for a, b in tokens if re.fullmatch(r"[-+]?[\d.]+(e-?\d+)?", text[a:b])] or tokens
    i, value = int(rng.integers(len(lines))), junk(rng)
    a, b = choice(rng, numbers if rng.random() < 0.5 else tokens)
    how = choice(rng, ("token", "token", "token", "key", "lost", "doubled", "indented", "moved"))
    if how == "token":
        return f"{text[a:b]!r} -> {value[:40]!r}", text[:a] + value + text[b:]
    if how == "key":
        return f"{text[a:b]!r} misspelt", text[: b - 1] + "q" + text[b - 1 :]
    changed = {
        "lost": lines[:i] + lines[i + 1 :],
        "doubled": lines[: i + 1] + lines[i:],
        "indented": [*lines[:i], " " + lines[i], *lines[i + 1 :]],
        "moved": lines[i:] + lines[:i],
    }[how]
    return f"line {i + 1} {how}", "\n".join(changed) + "\n"


def file_changed(rng: np.random.Generator, path: Path, text: str) -> str:
    """Write `text` with something wrong in it; what."""
    if rng.random() < 0.15:
        what, data = bytes_changed(rng, text.encode())
    else:
        what, changed = text_changed(rng, text)
        data = changed.encode("utf-8", "surrogateescape")
    path.write_bytes(data)
    return what


# ---- logs and maps


def logs(rng: np.random.Generator, folder: Path) -> Case:
    """CSV, NPZ and their side YAMLs, through the reader, the gate, the noise and the windows."""
    kind = choice(rng, ("csv", "csv", "csv", "npz", "side"))
    text = "\n".join([HEADER, *(",".join(f"{x:.6g}" for x in row) for row in table())]) + "\n"
    if kind == "npz":
        return _npz(rng, folder), lambda: _read(folder, None)
    (folder / "run.csv").write_text(text)
    if kind == "side":
        return file_changed(rng, folder / "run.yaml", SIDE), lambda: _read(folder, None)
    how = choice(rng, ("cells", "text", "column", "rows"))
    if how == "text":
        return file_changed(rng, folder / "run.csv", text), lambda: _read(folder, None)
    cells, names = table().astype(object), HEADER.split(",")
    if how == "cells":
        column, value = int(rng.integers(6)), junk(rng)
        rows = slice(None) if rng.random() < 0.3 else int(rng.integers(60))
        cells[rows, column], what = value, f"{names[column]}[{rows}] = {value[:40]!r}"
    elif how == "rows":
        order = [rng.permutation(60), np.repeat(np.arange(60), 2), np.arange(3), np.arange(60)[::-1], []][
            int(rng.integers(5))
        ]
        cells, what = cells[np.asarray(order, int)], f"{len(order)} rows in another order"
    else:
        column, what = int(rng.integers(6)), "column "
        name = choice(
            rng, ("", junk(rng), "enabled:m", "effort:m", "qvel:elbow", "qpos:elbow", "ctrl:q", names[column] + " ")
        )
        names[column], what = name, f"column {names[column]!r} called {name[:40]!r}"
    lines = [",".join(map(str, row)) for row in cells]
    (folder / "run.csv").write_text("\n".join([",".join(names), *lines]), encoding="utf-8", errors="surrogateescape")
    return what, lambda: _read(folder, None)


def _npz(rng: np.random.Generator, folder: Path) -> str:
    t = table()
    arrays: dict[str, Any] = {"time": t[:, 0], "ctrl": t[:, 1:3], "qpos": t[:, 3:5], "joints": ["shoulder", "elbow"]}
    arrays["actuators"] = ["m", "p"]
    key = choice(rng, list(arrays))
    odd = (
        np.zeros(0), np.float64(3), np.zeros((2, 3, 4)), np.array([{"a": 1}], object), t[:, 0] * 1j,
        t[:, :1].astype(str), np.array(["x", "y"]), np.array(["elbow", "elbow"]), t[:, 0].astype("datetime64[s]"),
        t[:, 3:5].astype("f2"), t[::-1, 0], np.full(60, np.nan), t[:30, 0], np.zeros(60, [("a", "f8")]), t[:, 0] > 0.3,
    )  # fmt: skip
    i = int(rng.integers(len(odd) + 2))
    arrays = {k: v for k, v in arrays.items() if k != key or i < len(odd)} | ({key: odd[i]} if i < len(odd) else {})
    np.savez(folder / "run.npz", **arrays, allow_pickle=True)
    if i == len(odd) + 1:
        what, data = bytes_changed(rng, (folder / "run.npz").read_bytes())
        (folder / "run.npz").write_bytes(data)
        return what
    with zipfile.ZipFile(folder / "run.npz") as archive:
        return f"{key} = {odd[i].dtype} {odd[i].shape} of {len(archive.namelist())}" if i < len(odd) else f"no {key}"


def _read(folder: Path, log_map: Any) -> None:
    from bayessim_mjx.diagnosis.logcheck import gate
    from bayessim_mjx.logs import noise, read_logs, segments

    found = read_logs(folder, arm(), log_map)
    for log in found:
        for name in ("time", "ctrl", "qpos", "qvel", "sigma_qpos", "sigma_qvel"):
            assert np.isfinite(getattr(log, name)).all(), f"{name} is not finite"
        assert (np.diff(log.time) > 0).all() and len(log) >= 10, "time runs back"
        assert all(len(s) == len(log) for s in log.streams.values()), "a stream of another length"
    assert all(np.isfinite(x).all() for x in noise(found).values()), "noise is not finite"
    gate.check(found, arm(), found[0].period)
    segments(found, 5, dt=found[0].period)


def maps(rng: np.random.Generator, folder: Path) -> Case:
    """map.yaml on a sound log."""
    text = "\n".join([HEADER, *(",".join(f"{x:.6g}" for x in row) for row in table())]) + "\n"
    (folder / "run.csv").write_text(text)
    return file_changed(rng, folder / "map.yaml", MAP), lambda: _read(folder, None)


# ---- settings


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

        return f"params: {what}", lambda: _box(robot.read_params(folder / "x.yaml", arm()))
    return f"effects: {what}", lambda: _effects(folder / "x.yaml")


def _settings(settings: Any) -> None:
    """What is accepted is written and read again unchanged, and the task can be made of it."""
    from bayessim_mjx import config, registry

    text = config.to_yaml(settings.to_dict())
    again = config.from_dict(yaml.safe_load(text)) if "nan" not in text else settings
    assert again == settings or "${" in text, "what was accepted reads back as something else"
    env = registry.make(settings.task, config=settings)
    if hasattr(env, "space"):
        _box(env.space)


def _box(space: Any) -> None:
    assert np.isfinite(space.low).all() and np.isfinite(space.high).all() and (space.low < space.high).all(), "no box"


def _effects(path: Path) -> None:
    from bayessim_mjx import registry
    from bayessim_mjx.effects.support import storage

    found = storage.read(path)
    _box(registry.make("Pendulum", effects=found.effects).space)


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


# ---- models and run folders


def models(rng: np.random.Generator, folder: Path) -> Case:
    """MJCFs, as `diagnose --model` takes them; what is accepted is simulated for a moment."""
    what = file_changed(rng, folder / "arm.xml", ARM)

    def call() -> None:
        import mujoco

        from bayessim_mjx.diagnosis.fitting import robot

        body = robot.of_file(folder / "arm.xml")
        fitted = robot.with_timestep(body.mj_model, 0.01)
        assert 0 < fitted.opt.timestep <= 0.01, "no timestep"
        _box(body.space)
        data = mujoco.MjData(fitted)
        mujoco.mj_step(fitted, data, 5)

    return what, call


@functools.cache
def _run_folder(root: Path) -> Path:
    """A run with two checkpoints, made once per process."""
    from bayessim_mjx import config
    from bayessim_mjx.runs import Run

    run = Run.create(root, "Pendulum", "", config.load("Pendulum"), "main --task Pendulum")
    for step in (1, 2):
        run.save(step, _tree(step), evaluation=float(step), meta={"round": step})
    return run.path


def _tree(step: int) -> dict[str, Any]:
    return {
        "policy": {"w": np.arange(12, dtype=np.float32).reshape(3, 4) * step, "n": np.int32(step)},
        "key": np.uint32([step, 7]),
    }


def _json_changed(rng: np.random.Generator, path: Path) -> str:
    """One value of a JSON file replaced, removed or nested."""
    root = json.loads(path.read_text())
    node, way = root, []
    while isinstance(node, dict | list) and node and (not way or rng.random() < 0.8):
        key = choice(rng, list(node)) if isinstance(node, dict) else int(rng.integers(len(node)))
        parent, node = node, node[key]
        way.append(key)
    values = [
        None,
        True,
        -1,
        0,
        10**30,
        1e308,
        float("nan"),
        "",
        "../../..",
        "/etc",
        "x" * 300,
        [],
        {},
        [[]],
        {"a": 1},
        "\x00",
    ]
    value = choice(rng, values)
    if rng.random() < 0.2:
        del parent[key]
        value = "removed"
    else:
        parent[key] = copy.deepcopy(value)
    path.write_text(json.dumps(root))
    return f"{path.name}: {'.'.join(map(str, way))[:60]} = {str(value)[:30]!r}"


def checkpoints(rng: np.random.Generator, folder: Path) -> Case:
    """Run folders: manifest, index, arrays and settings, as `--resume` and `--checkpoint` take them."""
    own = _run_folder(folder.parent / "made")
    path = folder / "run"
    shutil.copytree(own, path)
    files = [f for f in sorted(path.rglob("*")) if f.is_file() and f.name != ".reserve"]
    texts = {f: f.suffix == ".json" and f.parent.name != "_" for f in files}
    file = choice(rng, files)
    if rng.random() < 0.5:
        file = choice(rng, [f for f in files if f.name in ("run.json", "index.json")])
    how = rng.random()
    if how < 0.1:
        file.unlink()
        what = f"{file.relative_to(path)} removed"
    elif texts[file] and how < 0.7:
        what = _json_changed(rng, file)
    elif file.suffix == ".yaml":
        what = f"{file.name}: {file_changed(rng, file, file.read_text())}"
    else:
        what, data = bytes_changed(rng, file.read_bytes())
        file.write_bytes(data)
        what = f"{file.relative_to(path)}: {what}"
    return what, lambda: _resumed(path)


def _resumed(path: Path) -> None:
    from bayessim_mjx import cli
    from bayessim_mjx.runs import Run

    outside = path.parent / "outside"
    outside.mkdir()
    (outside / "kept").write_text("x")
    run = Run.open(path)
    run.resumed()
    tree, meta = run.restore("latest", _tree(0), fall_back=True)
    step = int(tree["policy"]["n"])
    assert step in (1, 2) and meta == {"round": step}, "not what was saved"
    for key, value in _tree(step)["policy"].items():
        assert np.array_equal(tree["policy"][key], value), f"{key} is not what was saved"
    run.set_status("running")
    run.save(3, _tree(3))
    assert (outside / "kept").is_file() and list(path.parent.iterdir()), "something outside of the run is gone"
    cli.find_checkpoint(str(path), None, "")


KINDS: dict[str, tuple[Callable[[np.random.Generator, Path], Case], int]] = {  # and how many of 1000
    "logs": (logs, 260),
    "maps": (maps, 90),
    "yamls": (yamls, 180),
    "overrides": (overrides, 150),
    "flags": (flags, 120),
    "models": (models, 100),
    "checkpoints": (checkpoints, 100),
}
