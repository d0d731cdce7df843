"""Signals with time stamps of their own, or arrays of one sampling, brought onto one clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array
from bayessim_mjx.logs.pieces import MAX_GAP
from bayessim_mjx.logs.resample import integrals


@dataclass(frozen=True)
class Stream:
    """One recorded signal.

    Attributes:
        time: [N] s, as stamped; values: [N].
        kind: measured at its times; held, a command until the next; linear, a command that runs from one to the next.
    """

    time: Array
    values: Array
    kind: Literal["measured", "held", "linear"] = "measured"

    def sorted(self) -> Stream:
        """In the order of time; of samples with the same stamp the first."""
        time, first = np.unique(np.asarray(self.time, float), return_index=True)
        return Stream(time, np.asarray(self.values, float)[first], self.kind)

    def on(self, clock: Array) -> Array:
        """[len(clock)]: measured signals are interpolated linearly, commands averaged until the next time.

        NaN before the first sample, for measured signals also after the last and in gaps of more than five periods.
        """
        own = self.sorted()
        if own.kind == "measured":
            return own._interpolated(clock)
        ends = np.append(clock, 2 * clock[-1] - clock[-2])
        area = integrals(own.time, own.values[:, None], ends, (0.0, 1.0), own.kind == "linear")[:, 0]
        return np.where(clock < own.time[0], np.nan, np.diff(area) / np.diff(ends))

    def _interpolated(self, clock: Array) -> Array:
        out = np.interp(clock, self.time, self.values, np.nan, np.nan)
        if len(self.time) < 3:
            return out
        after = np.clip(np.searchsorted(self.time, clock), 1, len(self.time) - 1)
        gap = self.time[after] - self.time[after - 1]
        exact = np.isin(clock, self.time)
        return np.where(exact | (gap <= MAX_GAP * np.median(np.diff(self.time))), out, np.nan)


@dataclass(frozen=True)
class Recording:
    """One run, its signals by what they are.

    Attributes:
        name: of the file that is written, without its ending.
        positions, velocities, efforts: by joint. commands: by joint or actuator. others: by column.
        notes: what the user should know. laws: of the controllers in the drives, by joint (`metadata.controller`).
    """

    name: str
    positions: Mapping[str, Stream]
    commands: Mapping[str, Stream]
    velocities: Mapping[str, Stream] = field(default_factory=dict)
    efforts: Mapping[str, Stream] = field(default_factory=dict)
    others: Mapping[str, Stream] = field(default_factory=dict)
    notes: Sequence[str] = ()
    laws: Mapping[str, Any] = field(default_factory=dict)

    def columns(self) -> tuple[dict[str, Array], int]:
        """All signals on one clock, that of the first joint's positions: ({column: [T]}, rows that were left out).

        Rows without a position, a velocity or a command of some joint are left out, as those before the first command.

        Raises:
            UserError: no positions, or none after the first command.
        """
        if not self.positions:
            raise UserError(f"{self.name}: no positions of joints; allowed: recordings with at least one joint")
        clock = next(iter(self.positions.values())).sorted().time
        if len(clock) < 2:
            raise UserError(f"{self.name}: {len(clock)} position(s) of the first joint; allowed: at least 2")
        needed = {"position": self.positions, "velocity": self.velocities, "command": self.commands}
        out: dict[str, Array] = {"time": clock}
        for prefix, block in needed.items():
            out |= {f"{prefix}:{name}": stream.on(clock) for name, stream in block.items()}
        whole = np.all(np.isfinite(list(out.values())), axis=0)
        if not whole.any():
            raise UserError(f"{self.name}: no time at which all joints and commands are known; {self._spans()}")
        out |= {f"effort:{name}": stream.on(clock) for name, stream in self.efforts.items()}
        out |= {name: stream.on(clock) for name, stream in self.others.items()}
        out = {name: column[whole] for name, column in out.items()}
        return {**out, "time": out["time"] - out["time"][0]}, int(np.sum(~whole))

    def _spans(self) -> str:
        """From when to when each signal was recorded."""
        spans = {**self.positions, **{f"command {name}": stream for name, stream in self.commands.items()}}
        return ", ".join(f"{name} {s.time.min():.3f} to {s.time.max():.3f} s" for name, s in spans.items())


def recording(
    name: str,
    time: Array,
    arrays: Mapping[str, Array],
    names: Mapping[str, Sequence[str]],
    notes: Sequence[str] = (),
    laws: Mapping[str, Any] | None = None,
) -> Recording:
    """Join arrays `positions`, `commands` [T, n] and, where there are some, `velocities` and `efforts`.

    Args:
        name: of the run.
        time: [T], s.
        arrays: by what they are.
        names: of the columns of each.
        notes: what the user should know. laws: of the drives, by joint.

    Raises:
        UserError: another number of rows or columns than times or names.
    """
    streams: dict[str, dict[str, Stream]] = {}
    for what, values in arrays.items():
        table = np.asarray(values, float).reshape(len(values), -1)
        if table.shape != (len(time), len(names[what])):
            allowed = f"allowed: {len(time)} rows, as many as times, of {', '.join(names[what])}"
            raise UserError(f"{name}: {what} of shape {np.shape(values)}; {allowed}")
        kind = "held" if what == "commands" else "measured"
        streams[what] = {j: Stream(time, c, kind) for j, c in zip(names[what], table.T, strict=True)}  # type: ignore[arg-type]
    return Recording(name, **streams, notes=notes, laws=laws or {})  # type: ignore[arg-type]


def numbered(given: Sequence[str] | None, count: int) -> list[str]:
    """Names of `count` columns: those given where they are as many, else `joint0`, `joint1` ..."""
    return list(given) if given is not None and len(given) == count else [f"joint{i}" for i in range(count)]
