"""Recordings as a folder of CSV files with the map that names their columns as the model's channels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.importers.streams import Recording
from bayessim_mjx.logs.log import Array, Channels, suggest
from bayessim_mjx.logs.units import TURN
from bayessim_mjx.logs.vendors import is_servo

HEAD = """# How the columns of the files beside it become channels of the model (docs/logs.md).
# Measured signals were interpolated linearly onto the times of the positions, commands averaged over each row.
"""
AT_ONCE = 10_000  # rows whose texts are made together; any number serves


@dataclass
class Target:
    """Where recordings go, and what they are called there.

    Attributes:
        folder: new, or without logs. model: None: joints and actuators keep the recording's names.
        rename: {name in the recording: name in the model}.
        scale: of positions and velocities; command_scale: of commands.
        notes: what the user should know, as it becomes known.
    """

    folder: Path
    model: mujoco.MjModel | None = None
    rename: Mapping[str, str] = field(default_factory=dict)
    scale: float = 1.0
    command_scale: float = 1.0
    notes: list[str] = field(default_factory=list)

    def write(self, recordings: Iterable[Recording]) -> list[Path]:
        """Write them and the map; the CSV files.

        Raises:
            UserError: the folder holds logs, nothing was recorded, nothing in it is in the model.
        """
        taken = sorted(p.name for p in self.folder.glob("*")) if self.folder.is_dir() else []
        if taken or self.folder.is_file():
            raise UserError(f"--out {self.folder}: it holds {taken[0] if taken else 'a file'}; allowed: a new folder")
        written: list[Path] = []
        every: dict[str, None] = {}
        for recording in recordings:
            columns, left_out = recording.columns()
            if left_out:
                self.notes.append(f"{recording.name}: {left_out} row(s) left out, where something was not sampled")
            every |= dict.fromkeys(columns)
            self.notes += [note for note in recording.notes if note not in self.notes]
            self._check(recording.name, columns)
            self._doubt(recording.name, columns)
            written.append(_csv(self.folder / f"{recording.name}.csv", columns))
            laws = {d: law for j, law in recording.laws.items() if (d := self._actuator(f"law:{j}")) and self._open(d)}
            if laws:
                side = written[-1].with_suffix(".yaml")
                side.write_text(yaml.safe_dump({"controller": laws}, sort_keys=False, width=110))
                self.notes.append(f"{recording.name}: {side.name} declares the position law of {', '.join(laws)}")
        if not written:
            raise UserError("nothing was recorded; allowed: files with at least one run")
        (self.folder / "map.yaml").write_text(HEAD + yaml.safe_dump(self._map(list(every)), sort_keys=False, width=110))
        return written

    def _check(self, name: str, columns: Mapping[str, Array]) -> None:
        """Refuse a recording of which no joint, or no command, is in the model, before anything is written."""
        if self.model is None:
            return
        channels = Channels.of(self.model)
        kinds = (("position", "joint", self._joint, channels.qpos, "--rename NAME=JOINT"),
                 ("command", "command", self._actuator, channels.actuators,
                  "--rename NAME=ACTUATOR, or --commands TOPIC=A,B for arrays"))  # fmt: skip
        for prefix, what, of, allowed, way in kinds:
            own = [c for c in columns if c.startswith(f"{prefix}:")]
            if allowed and not any(of(c) for c in own):
                has = ", ".join(self._name(c) for c in own) or "none"
                raise UserError(
                    f"{name}: no recorded {what} is in the model; it has {has}; {suggest('', allowed)}; {way}"
                )

    def _doubt(self, name: str, columns: Mapping[str, Array]) -> None:
        positions = [c for k, c in columns.items() if k.startswith("position:")]
        largest = max((float(np.nanmax(np.abs(c))) for c in positions if np.isfinite(c).any()), default=0.0)
        if largest * self.scale > 2.0 * TURN and not any("--scale" in note for note in self.notes):
            self.notes.append(f"{name}: positions reach {largest:.3g}: degrees would need --scale 0.017453293")

    def _map(self, columns: Sequence[str]) -> dict[str, Any]:
        blocks = {
            p: [c for c in columns if c.startswith(f"{p}:")] for p in ("position", "velocity", "effort", "command")
        }
        others = {c: c for c in columns if c != "time" and not any(c in block for block in blocks.values())}
        switches = [c for c in others if c.startswith("enabled:")]
        others |= {f"enabled:{drive}": others.pop(c) for c in switches if (drive := self._actuator(c))}
        joints = {self._joint(c): c for c in blocks["position"]}
        speeds = {self._joint(c): c for c in blocks["velocity"]}
        drives = {self._actuator(c): c for c in blocks["command"]}
        efforts = {f"effort:{self._actuator(c)}": c for c in blocks["effort"] if self._actuator(c)}
        joints, speeds, drives = ({k: c for k, c in x.items() if k} for x in (joints, speeds, drives))
        whole = all(joint in speeds for joint in joints) and bool(joints)
        qpos, ctrl = self._completed(joints, drives)
        return {
            "files": "*.csv",
            "time": "time",
            "ctrl": ctrl,
            "qpos": qpos,
            "qvel": {joint: self._scaled(speeds[joint]) for joint in joints}
            if whole and len(qpos) == len(joints)
            else {},
            "streams": efforts | others,
        }

    def _scaled(self, column: str) -> Any:
        scale = self.command_scale if column.startswith("command:") else self.scale
        return column if scale == 1.0 else {"column": column, "scale": scale}

    def _name(self, column: str) -> str:
        name = column.partition(":")[2]
        return self.rename.get(name, name)

    def _joint(self, column: str) -> str:
        """Return the joint's name in the model, "" if it has none."""
        name = self._name(column)
        return name if self.model is None or name in Channels.of(self.model).qpos else ""

    def _actuator(self, column: str) -> str:
        """Return the actuator of this name, or the only one on the joint of this name; "" if there is none."""
        name = self._name(column)
        if self.model is None:
            return name
        channels = Channels.of(self.model)
        if name in channels.actuators or name not in channels.joints:
            return name if name in channels.actuators else ""
        on_joint = np.isin(self.model.actuator_trntype, (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT))
        own = np.flatnonzero(on_joint & (self.model.actuator_trnid[:, 0] == channels.joints.index(name)))
        if len(own) > 1:
            names = ", ".join(channels.actuators[i] for i in own)
            raise UserError(f"joint {name!r} has actuators {names}; allowed: --rename {name}=ACTUATOR")
        return channels.actuators[own[0]] if len(own) else ""

    def _open(self, drive: str) -> bool:
        """Whether the model's actuator has no loop of its own, so that a logged law closes one."""
        return self.model is None or not is_servo(self.model, Channels.of(self.model).actuators.index(drive))

    def _completed(self, joints: Mapping[str, str], drives: Mapping[str, str]) -> tuple[dict[str, Any], dict[str, Any]]:
        """(qpos, ctrl) of the map; what the model has and the recording lacks is held at its start, or 0."""
        qpos = {joint: self._scaled(column) for joint, column in joints.items()}
        ctrl = {actuator: self._scaled(column) for actuator, column in drives.items()}
        if self.model is None:
            return qpos, ctrl
        channels = Channels.of(self.model)
        rest = {n: {"value": float(self.model.qpos0[i])} for i, n in enumerate(channels.qpos) if n not in joints}
        idle = {n: {"value": 0.0} for n in channels.actuators if n not in drives}
        for what, absent in (("joint", rest), ("command of", idle)):
            if absent:
                self.notes.append(f"map.yaml holds constant, as they were not recorded: {what} {', '.join(absent)}")
        return qpos | rest, ctrl | idle


def _csv(path: Path, columns: Mapping[str, Array]) -> Path:
    """Write columns [T], a part of the rows at a time: texts of numbers take ten times the numbers' memory."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        file.write(",".join(columns) + "\n")
        for start in range(0, len(columns["time"]), AT_ONCE):
            part = [np.char.mod("%.12g", c[start : start + AT_ONCE]).tolist() for c in columns.values()]
            file.writelines(",".join(row).replace("nan", "") + "\n" for row in zip(*part, strict=True))
    return path
