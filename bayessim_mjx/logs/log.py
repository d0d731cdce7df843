"""One run of recorded motion: the Log and the names of its channels in a MuJoCo model."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.errors import UserError

Array = NDArray[np.float64]
HOLDS = ("previous", "linear")  # how a command goes on from its row to the next
TIMING = ("hold", "commands_late")  # metadata that say when commands act; what is resampled has done with them

# width in qpos and in qvel of every joint type
_WIDTHS = {
    int(mujoco.mjtJoint.mjJNT_FREE): (7, 6),
    int(mujoco.mjtJoint.mjJNT_BALL): (4, 3),
    int(mujoco.mjtJoint.mjJNT_SLIDE): (1, 1),
    int(mujoco.mjtJoint.mjJNT_HINGE): (1, 1),
}


@dataclass(frozen=True)
class Channels:
    """Names of a model's channels, in the model's order; without a name: joint<i>, actuator<i>.

    A hinge or slide joint is one channel (`elbow`), a ball joint `hip[0]`..`hip[3]` in qpos and `hip[0]`..`hip[2]` in
    qvel, a free joint `root[0]`..`root[6]` and `root[0]`..`root[5]`.
    """

    joints: tuple[str, ...]
    actuators: tuple[str, ...]
    qpos: tuple[str, ...]
    qvel: tuple[str, ...]
    kinds: tuple[str, ...]  # per joint: free, ball, slide or hinge

    @classmethod
    def of(cls, mj_model: mujoco.MjModel) -> Channels:
        joints = tuple(mj_model.joint(i).name or f"joint{i}" for i in range(mj_model.njnt))
        widths = [_WIDTHS[int(t)] for t in mj_model.jnt_type]
        return cls(
            joints=joints,
            actuators=tuple(mj_model.actuator(i).name or f"actuator{i}" for i in range(mj_model.nu)),
            qpos=tuple(n for j, w in zip(joints, widths, strict=True) for n in _indexed(j, w[0])),
            qvel=tuple(n for j, w in zip(joints, widths, strict=True) for n in _indexed(j, w[1])),
            kinds=tuple(
                {7: "free", 4: "ball"}.get(w[0], "") or _single(t)
                for w, t in zip(widths, mj_model.jnt_type, strict=True)
            ),
        )

    def of_joint(self, joint: str, stream: str = "qpos") -> tuple[str, ...]:
        """Channels of one joint in `qpos` or `qvel`."""
        return tuple(c for c in getattr(self, stream) if c == joint or c.startswith(f"{joint}["))

    def columns(self, joint: str, stream: str = "qpos") -> slice:
        """Where the joint lies in qpos [.., nq] or qvel [.., nv]."""
        own = self.of_joint(joint, stream)
        start = getattr(self, stream).index(own[0])
        return slice(start, start + len(own))


def _indexed(name: str, width: int) -> list[str]:
    return [name] if width == 1 else [f"{name}[{i}]" for i in range(width)]


def _single(joint_type: int) -> str:
    return "slide" if int(joint_type) == int(mujoco.mjtJoint.mjJNT_SLIDE) else "hinge"


@dataclass(frozen=True, eq=False)
class Log:
    """One run, in SI units, arrays read-only. The command of row k is in force until time[k+1], unless `linear`.

    Attributes:
        name: file name, with `#k` for the k-th piece of a file cut at its gaps.
        time: [T] s, strictly increasing.
        ctrl: [T, nu] commands in the units of the model's actuators.
        qpos: [T, nq] measured positions, in the model's order (unwrapped hinges).
        qvel: [T, nv] velocities; estimated from qpos (zero phase) where has_qvel is False.
        has_qvel: whether the velocities were measured.
        channels: names of the columns of ctrl, qpos and qvel, in the model's order.
        sigma_qpos, sigma_qvel: [nq], [nv] standard deviation of the measurement noise.
        streams: whatever else was recorded, [T] each: `effort:<actuator>`, `enabled:<actuator>` (0 = drive off, the
            command did not act), witnesses such as `voltage`; NaN where not sampled.
        metadata: the file's side YAML (condition, controller, payload, repeat_of, hold ...) and `source`, its path.
        absent: channels (`qpos:elbow`) that were not measured; their values are guesses, with the standard deviations
            that sigma_qpos and sigma_qvel have there. Velocities only where others were measured (has_qvel).
    """

    name: str
    time: Array
    ctrl: Array
    qpos: Array
    qvel: Array
    has_qvel: bool
    channels: Channels
    sigma_qpos: Array
    sigma_qvel: Array
    streams: Mapping[str, Array] = field(default_factory=dict)
    metadata: Mapping[str, Any] = field(default_factory=dict)
    absent: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        rows = len(self.time)
        for key in ("time", "ctrl", "qpos", "qvel", "sigma_qpos", "sigma_qvel"):
            value = np.array(getattr(self, key), dtype=np.float64)
            if not key.startswith("sigma") and len(value) != rows:
                raise UserError(
                    f"log {self.name!r}: {key} has {len(value)} rows, time has {rows}; allowed: the same number"
                )
            value.setflags(write=False)
            object.__setattr__(self, key, value)

    @property
    def joints(self) -> tuple[str, ...]:
        return self.channels.joints

    @property
    def actuators(self) -> tuple[str, ...]:
        return self.channels.actuators

    def __len__(self) -> int:
        return len(self.time)

    def __repr__(self) -> str:
        seen = "measured" if self.has_qvel else "estimated"
        return f"Log({self.name!r}, {len(self)} rows, {self.duration:.2f} s, {self.period * 1e3:.3g} ms, qvel {seen})"

    @property
    def duration(self) -> float:
        """Seconds from first to last sample."""
        return float(self.time[-1] - self.time[0])

    @property
    def period(self) -> float:
        """Median sample period [s]."""
        return float(np.median(np.diff(self.time)))

    @property
    def sigma_dofs(self) -> Array:
        """[nv]: noise of the positions per degree of freedom; of an orientation about each axis, rad.

        A turn by w moves a quaternion by |w| / 2, so three equal variances of turns are four times the sum of its four.
        """
        out: list[float] = []
        for joint, kind in zip(self.joints, self.channels.kinds, strict=True):
            own = self.sigma_qpos[self.channels.columns(joint)]
            moved = own[: {"free": 3, "ball": 0}.get(kind, 1)]
            turned = [2.0 * float(np.sqrt(np.sum(own[-4:] ** 2) / 3))] * 3 if kind in ("free", "ball") else []
            out += [*map(float, moved), *turned]
        return np.array(out)

    @property
    def seen_dofs(self) -> NDArray[np.bool_]:
        """[nv]: whether the position was measured."""
        out: list[bool] = []
        for joint in self.joints:
            seen = not any(f"qpos:{n}" in self.absent for n in self.channels.of_joint(joint))
            out += [seen] * len(self.channels.of_joint(joint, "qvel"))
        return np.array(out, bool)

    @property
    def lost(self) -> tuple[str, ...]:
        """Positions that were not measured, and with them the motion; a velocity alone follows from its position."""
        return tuple(name for name in self.absent if name.startswith("qpos:"))

    @property
    def seen_speeds(self) -> NDArray[np.bool_]:
        """[nv]: whether the velocity was measured."""
        return np.array([self.has_qvel and f"qvel:{n}" not in self.absent for n in self.channels.qvel], bool)

    @property
    def aliases(self) -> set[str]:
        """Names that another log's `repeat_of` may call it by."""
        return {self.name, Path(self.name).stem, str(self.metadata.get("source", self.name))}

    @property
    def linear(self) -> bool:
        """Whether commands run linearly from row to row (`hold: linear`), in place of being held until the next."""
        return self.metadata.get("hold") == "linear"

    @property
    def late(self) -> float:
        """s by which commands act later than their rows say (`commands_late`); negative: earlier."""
        return float(self.metadata.get("commands_late", 0.0))

    def shifted(self, late: float) -> Log:
        """Return the log with commands that act `late` s later than they did, without a change of its rows."""
        return replace(self, metadata={**self.metadata, "commands_late": self.late + late})

    @property
    def condition(self) -> str | None:
        """Label of the operating condition it was recorded under, where its metadata has one."""
        label = self.metadata.get("operating_condition", self.metadata.get("condition"))
        return None if label is None else str(label)

    @property
    def enabled(self) -> NDArray[np.bool_]:
        """[T]: every logged drive was switched on (True throughout where no `enabled:` stream was recorded)."""
        on = [np.nan_to_num(s, nan=1.0) > 0.5 for k, s in self.streams.items() if k.startswith("enabled")]
        return np.logical_and.reduce(on) if on else np.ones(len(self), bool)

    def cut(self, start: int, stop: int, name: str | None = None) -> Log:
        """Rows start..stop-1 as a log of their own."""
        rows = slice(start, stop)
        arrays = {k: getattr(self, k)[rows] for k in ("time", "ctrl", "qpos", "qvel")}
        return replace(self, name=name or self.name, streams={k: s[rows] for k, s in self.streams.items()}, **arrays)


def suggest(name: str, allowed: Iterable[str]) -> str:
    """Return the tail of an error message: the close matches first, then everything that is allowed."""
    names = list(allowed)
    close = difflib.get_close_matches(name, names, n=2, cutoff=0.5)
    hint = f"did you mean {' or '.join(map(repr, close))}? " if close else ""
    return f"{hint}allowed: {', '.join(names) if names else 'none'}"
