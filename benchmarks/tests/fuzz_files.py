"""Malformed files: logs, maps, models and checkpoints. See fuzz_cases.py."""

import copy
import functools
import json
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_inputs import ARM, HEADER, MAP, SIDE, Case, arm, box, bytes_changed, choice, file_changed, junk, table


def logs(rng: np.random.Generator, folder: Path) -> Case:
    """CSV, NPZ and their side YAMLs, through the reader, the gate, the noise and the windows."""
    kind = choice(rng, ("csv", "csv", "csv", "npz", "side"))
    text = "\n".join([HEADER, *(",".join(f"{x:.6g}" for x in row) for row in table())]) + "\n"
    if kind == "npz":
        return _npz(rng, folder), lambda: read(folder, None)
    (folder / "run.csv").write_text(text)
    if kind == "side":
        return file_changed(rng, folder / "run.yaml", SIDE), lambda: read(folder, None)
    how = choice(rng, ("cells", "text", "column", "rows"))
    if how == "text":
        return file_changed(rng, folder / "run.csv", text), lambda: read(folder, None)
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
    return what, lambda: read(folder, None)


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


def read(folder: Path, log_map: Any) -> None:
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
    return file_changed(rng, folder / "map.yaml", MAP), lambda: read(folder, None)


def models(rng: np.random.Generator, folder: Path) -> Case:
    """MJCFs, as `diagnose --model` takes them; what is accepted is simulated for a moment."""
    what = file_changed(rng, folder / "arm.xml", ARM)

    def call() -> None:
        import mujoco

        from bayessim_mjx.diagnosis.fitting import robot

        body = robot.of_file(folder / "arm.xml")
        fitted = robot.with_timestep(body.mj_model, 0.01)
        assert 0 < fitted.opt.timestep <= 0.01, "no timestep"
        box(body.space)
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
