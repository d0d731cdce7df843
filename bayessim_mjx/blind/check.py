"""The settings of a blind check, the rig that follows from it, and where its files lie."""

import dataclasses
import json
import os
import shlex
from functools import lru_cache
from pathlib import Path
from typing import Any

import mujoco

from bayessim_mjx import atomic
from bayessim_mjx import effects as library
from bayessim_mjx.blind import seal
from bayessim_mjx.blind.reality.cause import Scales
from bayessim_mjx.blind.reality.menu import CAUSES, KNOWN, UNKNOWN, places
from bayessim_mjx.blind.reality.plant import Rig, base_names, scales_of
from bayessim_mjx.blind.reality.strength import Ruler
from bayessim_mjx.blind.robot import Load, load_model, load_task, rig_of_logs, rig_of_menu, short
from bayessim_mjx.errors import UserError, unknown

WIDEST = 3.0  # standard deviations by which a data-sheet value is off at most: a normal one is in 99.7 %
SETTINGS = "check.json"
OURS = "bayessim-mjx diagnose"  # the entry that is checked where none is named


def unasked() -> tuple[str, ...]:
    """List what `diagnose` tries by default: other effects are never found, so hiding them teaches nothing."""
    return tuple(e for e in KNOWN if library.load(e).offered)


def effects_of(text: str) -> tuple[str, ...]:
    """`all,lugre_friction` -> names; () where it is `all` alone."""
    names = [n.strip() for n in text.split(",") if n.strip()]
    every = (own for n in names for own in (unasked() if n == "all" else (n,)))
    return () if names == ["all"] else tuple(dict.fromkeys(every))


@dataclasses.dataclass(frozen=True)
class Check:
    """The settings of a blind check.

    Attributes:
        model: path of an MJCF or URDF file, or task: name of a task; data: files or folders of logs, () for a menu of
            motions.
        effects: names of the effects that are hidden, () for all that `diagnose` tries unasked.
        accuracy: of data-sheet values (standard deviation).
        seed: of everything; command: an entry (see `worker.command`), "" for `diagnose`; more: further arguments of it.
        sandbox: whether an entry is kept from reading the truths, where the system can do that.
        drive, packages: of a URDF, see `urdf`.
    """

    out: str
    model: str = ""
    task: str = ""
    data: tuple[str, ...] = ()
    map: str = ""
    effects: tuple[str, ...] = ()
    accuracy: float = 0.05
    seed: int = 0
    command: str = ""
    more: tuple[str, ...] = ()
    sandbox: bool = True
    drive: str = ""
    packages: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in self.effects:
            if name not in KNOWN:
                raise unknown("--effects:", name, sorted(KNOWN), "`bayessim-mjx diagnose --list_effects`")

    def anywhere(self) -> "Check":
        """Name every file by its full path, for processes in other folders and on machines that share the disk."""

        def full(path: str) -> str:
            return os.path.abspath(path) if path else ""  # links stay: that of a venv's python finds its packages

        def there(word: str) -> str:
            return full(word) if Path(word).is_file() else word

        parts = [part.rpartition("=") for part in self.packages]
        return dataclasses.replace(
            self, out=full(self.out), model=full(self.model), data=tuple(map(full, self.data)), map=full(self.map),
            drive=there(self.drive), packages=tuple(f"{name}{sign}{full(folder)}" for name, sign, folder in parts),
            command=shlex.join(map(there, shlex.split(self.command))),
        )  # fmt: skip

    @property
    def asked(self) -> tuple[str, ...]:
        """Those of its effects that `diagnose` only tries where they are named."""
        return tuple(e for e in self.effects if not library.load(e).offered)

    @property
    def folder(self) -> Path:
        return Path(self.out)

    @property
    def name(self) -> str:
        return self.task or Path(self.model).stem

    def given(self, index: int) -> Path:
        """Name the folder of the logs that a diagnosis of a case gets."""
        return self.folder / "cases" / f"{index:04d}" / "given"

    def answer(self, index: int) -> Path:
        return self.folder / "cases" / f"{index:04d}" / "answer"

    @property
    def sealed(self) -> Path:
        """The folder of the truths."""
        return self.folder / "sealed"

    def secret(self, index: int) -> Path:
        return self.sealed / f"{index:04d}.json"

    def seal(self, index: int) -> Path:
        return self.folder / "cases" / f"{index:04d}" / seal.SEAL

    def begin(self) -> None:
        """Write the settings, or go on with a check of the same ones; one without a case is written anew.

        Raises:
            UserError: another check lies in the folder.
        """
        path = self.folder / SETTINGS
        own = {k: v for k, v in json.loads(json.dumps(dataclasses.asdict(self))).items() if k != "out"}
        if not (path.exists() and (self.folder / "cases").exists()):
            self.folder.mkdir(parents=True, exist_ok=True)
            atomic.write_text(path, json.dumps(own, indent=1))
            return
        before = json.loads(path.read_text())
        differing = [k for k in own if own[k] != before.get(k, own[k])]  # an earlier version had fewer
        if differing:
            other = ", ".join(f"{_flag(k, before.get(k))} (now {_flag(k, own[k])})" for k in differing)
            raise UserError(f"--out {self.out} has a check with {other}; give another folder, or the same flags")


def _flag(key: str, value: Any) -> str:
    """Write a setting as it is given: `--effects backlash,spring`, or `no --effects`."""
    if isinstance(value, list):
        value = (" " if key in ("data", "packages", "more") else ",").join(map(str, value))
    return f"--{key} {value}" if value not in ("", None) else f"no --{key}"


@dataclasses.dataclass(frozen=True, eq=False)
class Bench:
    """What cases are made with.

    Attributes:
        rig: the robot and its runs; ruler: measures strengths; scales: what the robot does without causes.
        load: the nominal model; velocity, effort: whether logs show them; slides: joints that are no hinges.
    """

    rig: Rig
    ruler: Ruler
    scales: Scales
    load: Load
    velocity: bool
    effort: bool
    slides: frozenset[str]

    def groups(self, effects: tuple[str, ...]) -> list[tuple[str, str]]:
        """(effect, place) of all that can be hidden here."""
        return [(e, w) for e in (effects or unasked()) for w in places(self.rig, e, self.scales)]

    def unknown(self) -> list[tuple[str, str]]:
        return [(e, w) for e in UNKNOWN for w in places(self.rig, e, self.scales)]

    def joint(self, where: str) -> str:
        """Find the joint of a place; a place without one is returned itself."""
        return self.scales.drives.get(where, where)

    def slide(self, effect: str, where: str) -> bool:
        """Whether the units of an effect at a place are those of a slide."""
        return CAUSES[effect].kind in ("joint", "actuator") and self.joint(where) in self.slides


def loader(check: Check) -> Load:
    if check.task:
        return load_task(check.task)

    def load() -> mujoco.MjSpec:
        return load_model(Path(check.model), check.drive or None, check.packages)

    load()
    return load


@lru_cache(maxsize=1)
def bench(check: Check) -> Bench:
    """Make the bench of a check; once in every process.

    Raises:
        UserError: what is wrong with model, logs or effects.
    """
    load = loader(check)
    logs: list[Any] = []
    rig: Rig
    if check.data:
        rig, logs = rig_of_logs(load, check.data, check.name, check.map or None)
    else:
        rig = rig_of_menu(load, check.name)
    model = load().compile()
    base = dict.fromkeys(base_names(model), 1.0)
    ruler = Ruler(short(rig), base, WIDEST * check.accuracy, check.seed)
    scales = scales_of(ruler.plain, ruler.runs)
    slides = frozenset(model.joint(i).name for i in range(model.njnt) if int(model.jnt_type[i]) == 2)
    effort = bool(logs) and all(any(s.startswith("effort:") for s in log.streams) for log in logs)
    found = Bench(rig, ruler, scales, load, any(log.has_qvel for log in logs), effort, slides)
    if not found.groups(check.effects):
        raise UserError(f"--effects {','.join(check.effects)}: none of them makes sense on {check.name}")
    return found
