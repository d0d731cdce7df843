"""The clock of the logs: what is late, behind what, by how much and how surely.

Each lateness has one estimator, since each is another quantity:

- velocities behind the derivatives of their positions: `logs.velocities`, lags over all measured rows;
- motion behind the effort: `effort`, where the bounded inverse dynamics of a log explain most;
- measured efforts behind the stamps of their commands: `links.offset`, where the two columns correlate most;
- commands behind (or before) their rows: `fitting.command_shift`, by simulation, beside all that forces can explain.

Three more are no clocks. `drive_channel.Channel.late` is the mean time by which a drive answers a held command: of its
own lag as well, and from where the command acts, half a row behind its stamp. The term "lateness" of
`equation_error.terms` lets all efforts be late by a common time while effects are compared; its value is not used.
`residual.frequency.delay` is the delay that the recalibrated model lacks.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

SURE = 4.0  # standard errors from which on a lateness is believed; rule of thumb, not counted


@dataclass(frozen=True)
class Late:
    """A lateness: seconds (negative: early), and its standard error in s (NaN: not known)."""

    seconds: float
    error: float = float("nan")

    @property
    def sure(self) -> float:
        """s; 0 where it lies within SURE standard errors of 0."""
        return 0.0 if abs(self.seconds) < SURE * self.error else self.seconds


@dataclass(frozen=True)
class Timing:
    """When what the logs say happened.

    Attributes:
        period: s between rows, the median of the logs; control: s, the control period.
        velocities: {velocity channel: behind the derivative of its position}.
        motion: {joint: behind its effort, the measured one where there is one}; held commands alone make half a row.
        efforts: {actuator: measured effort behind the command}; empty where none was measured.
        commands: behind their rows; None: not estimated. moved: s by which the logs' commands were moved since.
    """

    period: float
    control: float
    velocities: Mapping[str, Late] = field(default_factory=dict)
    motion: Mapping[str, Late] = field(default_factory=dict)
    efforts: Mapping[str, Late] = field(default_factory=dict)
    commands: Late | None = None
    moved: float = 0.0

    def with_commands(self, commands: Late, moved: float) -> Timing:
        return replace(self, commands=commands, moved=self.moved + moved)


def pooled(each: Iterable[tuple[str, Late]]) -> dict[str, Late]:
    """{name: median over logs}; its error is the median of those that are known over the root of their number."""
    of: dict[str, list[Late]] = {}
    for name, late in each:
        of.setdefault(name, []).append(late)
    out = {}
    for name, own in of.items():
        known = [x.error for x in own if np.isfinite(x.error)]
        error = float(np.median(known)) / len(known) ** 0.5 if known else float("nan")
        out[name] = Late(float(np.median([x.seconds for x in own])), error)
    return out
