"""Run folders: `<logdir>/<Task>/<timestamp>[_<name>]/` with params/, command.txt, checkpoints/ and run.json.

The manifest is the only source of "latest" and "best". It is replaced atomically after a checkpoint is complete, so a
kill at any moment leaves a run that can be opened; folders that it does not list are leftovers and are ignored. Its
paths lie in `checkpoints/`: a manifest from elsewhere cannot reach beyond its run.
"""

import datetime
import json
import math
import os
import re
import shlex
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bayessim_mjx import atomic, config
from bayessim_mjx.errors import UserError
from bayessim_mjx.outside_tasks import short
from bayessim_mjx.runs import checkpoints
from bayessim_mjx.runs.manifest import FOLDER, MANIFEST, SCHEMA, advice, best_of, differences, read
from bayessim_mjx.versions import git_state, versions

DAMAGED = ".damaged"
OURS = re.compile(r"\d+(-\d+)?(\.\d+\.tmp)?")  # folders that `save` makes
RESERVE, RESERVED = ".reserve", 1 << 16  # bytes given up on a full disk, so that the manifest can say so
KEEP = 3  # newest checkpoints kept beside the best


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
        try:
            return cls._filled(path, task, name, settings, sys.argv if command is None else command)
        except OSError as error:
            shutil.rmtree(path, ignore_errors=True)
            raise UserError(f"logdir: cannot write {path}: {error.strerror}") from None

    @classmethod
    def _filled(cls, path: Path, task: str, name: str, settings: config.Config, command: Sequence[str] | str) -> "Run":
        plain = settings.to_dict()
        train = {"ppo": plain.pop("ppo")}
        (path / "params").mkdir()
        (path / "params" / "env.yaml").write_text(config.to_yaml(plain), encoding="utf-8")
        (path / "params" / "train.yaml").write_text(config.to_yaml(train), encoding="utf-8")
        text = command if isinstance(command, str) else shlex.join(command)
        (path / "command.txt").write_text(text + "\n", encoding="utf-8")
        run = cls(path, {
            "schema": SCHEMA, "task": task, "name": name, "created": _now(), "status": "running", "command": text,
            "versions": versions(), "git": git_state(), "settings": settings.to_dict(),
            "checkpoints": [], "best": None, "latest": None,
        })  # fmt: skip
        run._write()
        run._reserve()
        return run

    @classmethod
    def open(cls, path: str | Path) -> "Run":
        """Open an existing run folder; UserError where it is none or its manifest is damaged."""
        return cls(Path(path), read(Path(path)))

    @property
    def config(self) -> config.Config:
        """The settings that the run was started with; what came later is off."""
        params = self.path / "params"
        found = config.load(cfg_env=params / "env.yaml", cfg_train=params / "train.yaml")
        text = (params / "env.yaml").read_text()
        return (
            found if re.search(r"^ *refine:", text, re.MULTILINE) else config.replace(found, bayessim={"refine": "off"})
        )

    @property
    def checkpoints(self) -> list[dict[str, Any]]:
        """Entries {step, path, evaluation, kind}, oldest first."""
        return self.manifest["checkpoints"]

    def set_status(self, status: str, error: str | None = None) -> None:
        """Set running, finished, interrupted (Ctrl-C) or failed (an `error`), also where the disk is full."""
        self.manifest.pop("error", None)
        self.manifest.update({"status": status} if error is None else {"status": status, "error": error})
        if status == "failed":
            (self.path / RESERVE).unlink(missing_ok=True)
            self._sweep()  # half a checkpoint may be what filled the disk
        self._write()
        if status == "running":
            self._reserve()

    def changes(self) -> list[str]:
        """List what has changed since the run was started: settings that were edited, versions, the code's commit."""
        now, found = {"settings": self.config.to_dict(), "versions": versions(), "git": git_state()}, []
        for key, title in (("settings", ""), ("versions", "version of "), ("git", "git ")):
            then = self.manifest.get(key)
            if isinstance(then, Mapping):  # earlier versions did not write them
                found += [title + text for text in differences(then, json.loads(json.dumps(now[key] or {})))]
        return found

    def resumed(self) -> list[str]:
        """Note in the manifest that the run goes on, and on what; returns `changes`."""
        found = self.changes()
        entry = {"at": _now(), "from": self.manifest["latest"], "versions": versions(), "changed": found}
        self.manifest["resumed"] = [*self.manifest.get("resumed", ()), entry]
        self._write()
        return found

    def prolong(self, iterations: int) -> None:
        """Make `iterations` the run's ppo.max_iterations, if it is another; the manifest's `prolonged` keeps each."""
        file = self.path / "params" / "train.yaml"
        train = config.read_yaml(file)
        ppo = train.get("ppo", train)
        before = ppo.get("max_iterations")
        if before == iterations:
            return
        ppo["max_iterations"] = iterations
        atomic.write_text(file, config.to_yaml(train))
        if "settings" in self.manifest:  # earlier versions did not write them
            self.manifest["settings"]["ppo"]["max_iterations"] = iterations
        entry = {"at": _now(), "step": self.manifest["latest"], "from": before, "to": iterations}
        self.manifest["prolonged"] = [*self.manifest.get("prolonged", ()), entry]
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
        folder = self.path / FOLDER
        folder.mkdir(exist_ok=True)
        self._sweep()
        path = _free(folder / f"{int(step):09d}")
        checkpoints.save(path, tree, step, meta or {})
        kind = "periodic" if evaluation is None else "evaluated"
        entry = {"step": int(step), "path": str(path.relative_to(self.path)), "evaluation": score, "kind": kind}
        older = [c for c in self.checkpoints if c["step"] != int(step)]
        listed = [{**c, "evaluation": None} if supersede else c for c in older] + [entry]
        best = best_of(listed)
        kept = [c for i, c in enumerate(listed) if i >= len(listed) - self.keep or c["step"] == best]
        self.manifest.update(checkpoints=kept, latest=int(step), best=best)
        self._write()
        self._sweep()
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
                raise UserError(f"{error}. {advice(older)}") from None
            print(f"note: {error}; going on from the checkpoint of step {older[-1]['step']}", file=sys.stderr)
            self.manifest.update(checkpoints=older, latest=older[-1]["step"], best=best_of(older))
            self._write()
            if path.exists() and not (path.is_symlink() or path.parent.is_symlink()):
                path.rename(_free(path.with_name(path.name + DAMAGED)))
            return self.restore("latest", template, fall_back=True)

    def _write(self) -> None:
        atomic.write_json(self.path / MANIFEST, self.manifest)

    def _reserve(self) -> None:
        path = self.path / RESERVE
        if not path.exists():
            path.write_bytes(os.urandom(RESERVED))  # not zeros: a file system may keep them as nothing

    def _sweep(self) -> None:
        """Remove what the manifest does not list: dropped checkpoints and halves left by a kill. Damaged ones stay.

        Only folders that `save` made, and nothing behind a link: what lies there belongs to somebody else.
        """
        folder, listed = self.path / FOLDER, {Path(c["path"]).name for c in self.checkpoints}
        if folder.is_symlink() or not folder.is_dir():
            return
        for path in folder.iterdir():
            if OURS.fullmatch(path.name) and path.name not in listed and not path.is_symlink():
                shutil.rmtree(path, ignore_errors=True)


def find_runs(logdir: str | Path, task: str) -> list[Run]:
    """Find the runs of a task, oldest first by the time in their manifests; unreadable folders are passed over."""
    runs = []
    for file in (Path(logdir) / _folder_name(task)).glob(f"*/{MANIFEST}"):
        try:
            runs.append(Run.open(file.parent))
        except UserError:
            continue
    return sorted(runs, key=lambda run: run.manifest.get("created", ""))


def latest_run(logdir: str | Path, task: str, with_checkpoint: bool = True, trained: bool = False) -> Run:
    """Find the newest run of a task (that has a checkpoint).

    Args:
        trained: pass over runs of no iteration, as of `--max_iterations 0`, where another run is there.
    """
    runs = [run for run in find_runs(logdir, task) if run.checkpoints or not with_checkpoint]
    if trained:
        runs = [run for run in runs if run.manifest["latest"]] or runs
    if not runs:
        raise UserError(
            f"no run of {task!r} with a checkpoint under {Path(logdir) / _folder_name(task)}: give its folder by "
            f"--checkpoint RUN, or train first, `bayessim-mjx train --task {task}`"
        )
    return runs[-1]


def _folder_name(task: str) -> str:
    return short(task).replace(":", "_").replace("/", "_")


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
