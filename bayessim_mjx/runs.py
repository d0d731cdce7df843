"""Run folders: `<logdir>/<Task>/<timestamp>[_<name>]/` with params/, command.txt, checkpoints/ and run.json.

The manifest is the only source of "latest" and "best". It is replaced atomically after a checkpoint is complete, so a
kill at any moment leaves a run that can be opened; folders that it does not list are leftovers and are ignored.
"""

import datetime
import json
import math
import platform
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from bayessim_mjx import checkpoints, config
from bayessim_mjx.errors import UserError

MANIFEST = "run.json"
SCHEMA = 1
DAMAGED = ".damaged"
KEEP = 3  # newest checkpoints kept beside the best
PACKAGES = ("bayessim-mjx", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "optax", "flax", "orbax-checkpoint")


class Run:
    """An open run folder. `manifest` is what run.json holds."""

    def __init__(self, path: Path, manifest: dict[str, Any], keep: int = KEEP):
        self.path, self.manifest, self.keep = path, manifest, keep

    @classmethod
    def create(
        cls,
        logdir: str | Path,
        task: str,
        name: str,
        settings: config.Config,
        command: Sequence[str] | str | None = None,
    ) -> "Run":
        """Make a new folder (never an existing one) with the resolved settings, the command and a manifest."""
        path = _new_folder(Path(logdir) / _folder_name(task), name)
        plain = settings.to_dict()
        train = {"ppo": plain.pop("ppo")}
        (path / "params").mkdir()
        (path / "params" / "env.yaml").write_text(config.to_yaml(plain), encoding="utf-8")
        (path / "params" / "train.yaml").write_text(config.to_yaml(train), encoding="utf-8")
        command = sys.argv if command is None else command
        text = command if isinstance(command, str) else shlex.join(command)
        (path / "command.txt").write_text(text + "\n", encoding="utf-8")
        run = cls(path, {
            "schema": SCHEMA, "task": task, "name": name, "created": _now(), "status": "running", "command": text,
            "versions": versions(), "git": git_state(), "checkpoints": [], "best": None, "latest": None,
        })  # fmt: skip
        run._write()
        return run

    @classmethod
    def open(cls, path: str | Path) -> "Run":
        """An existing run folder; UserError where it is none or its manifest is damaged."""
        path = Path(path)
        file = path / MANIFEST
        if not file.is_file():
            raise UserError(f"{path}: not a run folder (no {MANIFEST} in it)")
        try:
            manifest = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise UserError(f"{file}: damaged manifest: {type(error).__name__}: {error}") from None
        schema = manifest.get("schema") if isinstance(manifest, dict) else None
        if type(schema) is int and schema != SCHEMA:
            raise UserError(f"{file}: written by another version (schema {schema}, this one reads {SCHEMA})")
        if fault := _fault(manifest):
            raise UserError(f"{file}: damaged manifest: {fault}")
        return cls(path, manifest)

    @property
    def config(self) -> config.Config:
        """The settings that the run was started with."""
        params = self.path / "params"
        return config.load(cfg_env=params / "env.yaml", cfg_train=params / "train.yaml")

    @property
    def checkpoints(self) -> list[dict[str, Any]]:
        """Entries {step, path, evaluation, kind}, oldest first."""
        return self.manifest["checkpoints"]

    def set_status(self, status: str) -> None:
        """running, finished, interrupted (Ctrl-C) or failed (an error)."""
        self.manifest["status"] = status
        self._write()

    def save(
        self,
        step: int,
        tree: Any,
        *,
        evaluation: float | None = None,
        meta: Mapping[str, Any] | None = None,
        supersede: bool = False,
    ) -> Path:
        """Checkpoint a pytree of arrays; with an `evaluation` (mean return, higher is better) it may become "best".

        `supersede`: earlier evaluations were of something else and no longer compete.
        """
        score = None if evaluation is None or not math.isfinite(evaluation) else float(evaluation)
        folder = self.path / "checkpoints"
        folder.mkdir(exist_ok=True)
        self._sweep(folder)
        path = _free(folder / f"{int(step):09d}")
        checkpoints.save(path, tree, step, meta or {})
        kind = "periodic" if evaluation is None else "evaluated"
        entry = {"step": int(step), "path": str(path.relative_to(self.path)), "evaluation": score, "kind": kind}
        older = [c for c in self.checkpoints if c["step"] != int(step)]
        listed = [{**c, "evaluation": None} if supersede else c for c in older] + [entry]
        best = _best(listed)
        kept = [c for i, c in enumerate(listed) if i >= len(listed) - self.keep or c["step"] == best]
        self.manifest.update(checkpoints=kept, latest=int(step), best=best)
        self._write()
        self._sweep(folder)
        return path

    def checkpoint(self, which: str | int) -> Path:
        """Folder of "latest", "best" or the checkpoint of a step, by the manifest."""
        if not self.checkpoints:
            raise UserError(f"{self.path}: the run has no checkpoint yet")
        step = self.manifest[which] if which in ("latest", "best") else which
        if step is None:
            raise UserError(f"{self.path}: no checkpoint was evaluated, so there is no best; use latest")
        entry = next((c for c in self.checkpoints if str(c["step"]) == str(step)), None)
        if entry is None:
            steps = ", ".join(str(c["step"]) for c in self.checkpoints)
            raise UserError(f"{self.path}: no checkpoint {which!r}; use latest, best or one of the steps {steps}")
        return self.path / entry["path"]

    def restore(self, which: str | int | Path, template: Any, *, fall_back: bool = False) -> tuple[Any, dict[str, Any]]:
        """(tree like `template`, meta) of a checkpoint: latest, best, a step, or a folder's path.

        With `fall_back` a damaged checkpoint is set aside with a note on stderr, and the one before it is tried.
        """
        path = which if isinstance(which, Path) else self.checkpoint(which)
        try:
            return checkpoints.restore(path, template)
        except checkpoints.CorruptedError as error:
            older = [c for c in self.checkpoints if self.path / c["path"] != path]
            if not fall_back or not older:
                raise UserError(f"{error}. {_advice(older)}") from None
            print(f"note: {error}; going on from the checkpoint of step {older[-1]['step']}", file=sys.stderr)
            self.manifest.update(checkpoints=older, latest=older[-1]["step"], best=_best(older))
            self._write()
            if path.exists():
                path.rename(_free(path.with_name(path.name + DAMAGED)))
            return self.restore("latest", template, fall_back=True)

    def _write(self) -> None:
        checkpoints.write_json(self.path / MANIFEST, self.manifest)

    def _sweep(self, folder: Path) -> None:
        """Remove what the manifest does not list: dropped checkpoints and halves left by a kill. Damaged ones stay."""
        listed = {Path(c["path"]).name for c in self.checkpoints}
        for path in folder.iterdir():
            if path.name not in listed and DAMAGED not in path.name:
                shutil.rmtree(path, ignore_errors=True)


def _fault(manifest: Any) -> str | None:
    """What is wrong with the contents of run.json; None: nothing."""
    if not isinstance(manifest, dict):
        return "not an object"
    for key, kind in (("schema", int), ("task", str), ("created", str), ("status", str), ("checkpoints", list)):
        if type(manifest.get(key)) is not kind:
            return f"{key} = {manifest.get(key)!r}"
    for entry in manifest["checkpoints"]:
        ok = isinstance(entry, dict) and type(entry.get("step")) is int and isinstance(entry.get("path"), str)
        score = entry.get("evaluation", "") if ok else ""
        if not ok or isinstance(score, bool) or not isinstance(score, int | float | None):
            return f"checkpoints: {entry!r}"
    steps = [entry["step"] for entry in manifest["checkpoints"]]
    for key in ("latest", "best"):
        step = manifest.get(key, "absent")
        if step is not None and (type(step) is not int or step not in steps):
            return f"{key} = {step!r} is none of the checkpoints {steps}"
    return None


def _best(listed: Sequence[Mapping[str, Any]]) -> int | None:
    """Step of the highest evaluation (the first of equals)."""
    evaluated = [c for c in listed if c["evaluation"] is not None]
    return max(evaluated, key=lambda c: c["evaluation"])["step"] if evaluated else None


def _advice(others: Sequence[Mapping[str, Any]]) -> str:
    if not others:
        return "There is no other checkpoint: start the run again"
    return f"Use another checkpoint of the run: {', '.join(str(c['step']) for c in others)}"


def find_runs(logdir: str | Path, task: str) -> list[Run]:
    """Runs of a task, oldest first by the time in their manifests; folders without a readable one are passed over."""
    runs = []
    for file in (Path(logdir) / _folder_name(task)).glob(f"*/{MANIFEST}"):
        try:
            runs.append(Run.open(file.parent))
        except UserError:
            continue
    return sorted(runs, key=lambda run: run.manifest.get("created", ""))


def latest_run(logdir: str | Path, task: str, with_checkpoint: bool = True) -> Run:
    """The newest run of a task (that has a checkpoint)."""
    runs = [run for run in find_runs(logdir, task) if run.checkpoints or not with_checkpoint]
    if not runs:
        raise UserError(f"no run of {task!r} with a checkpoint under {Path(logdir) / _folder_name(task)}")
    return runs[-1]


def _folder_name(task: str) -> str:
    return task.replace(":", "_").replace("/", "_")


def _new_folder(parent: Path, name: str) -> Path:
    stamp = datetime.datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    for i in range(1, 1000):
        path = parent / (stamp + (f"-{i}" if i > 1 else "") + (f"_{name}" if name else ""))
        try:
            path.mkdir(parents=True)
            return path
        except FileExistsError:
            continue
        except OSError as error:
            raise UserError(f"logdir: cannot make {path}: {error.strerror}") from None
    raise UserError(f"{parent}: too many runs in one second")


def _free(path: Path) -> Path:
    """`path`, or with a number at its end where that is taken."""
    taken = (path.with_name(f"{path.name}-{i}") for i in range(2, 1000000))
    return path if not path.exists() else next(p for p in taken if not p.exists())


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="microseconds")


def versions() -> dict[str, str]:
    """Python and the packages that decide results."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def git_state() -> dict[str, Any] | None:
    """Commit and whether anything is changed, of the checkout that this package runs from; None outside of one."""
    root = Path(__file__).resolve().parents[1]
    if not (root / ".git").exists():
        return None
    options: dict[str, Any] = {"capture_output": True, "text": True, "check": True, "timeout": 20}
    try:
        commit = subprocess.run(["git", "-C", str(root), "rev-parse", "HEAD"], **options).stdout
        status = subprocess.run(["git", "-C", str(root), "status", "--porcelain"], **options).stdout
    except (OSError, subprocess.SubprocessError):
        return None
    return {"commit": commit.strip(), "dirty": bool(status.strip())}
