"""The clock of the logs: what is late, behind what, by how much and how surely.

Each lateness has one estimator, since each is another quantity:

- velocities behind the derivatives of their positions: `logs.velocities`, lags over all measured rows;
- motion behind the effort: `effort`, where the bounded inverse dynamics of a log explain most;
- measured efforts behind the stamps of their commands: `offset`, where the two columns correlate most;
- commands behind (or before) their rows: `fitting.command_shift`, by simulation, beside all that forces can explain;
- jitter of the stamps themselves: `logs.stamps`;
- what no estimator is sure of, up to a part of a row: nuisance numbers of every fit, `evidence.doubts`.

Three more are no clocks. `drive_channel.Channel.late` is the mean time by which a drive answers a held command: of its
own lag as well, and from where the command acts, half a row behind its stamp. The term "lateness" of
`equation_error.terms` lets all efforts be late by a common time while effects are compared; its value is not used.
`residual.frequency.delay` is the delay that the recalibrated model lacks.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.logcheck.drives import commanded, controlled, measured
from bayessim_mjx.diagnosis.logcheck.single_log import LIMITS
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.physics import controllers

LAGS = np.linspace(-0.2, 0.2, 161)  # s, odd: none is among them
# Standard errors from which on a lateness is believed. Rule of thumb: the errors are those of white residuals, and of
# logs with nothing hidden 90 % of the latenesses lie within four of them (benchmarks/records/log_checks.json).
SURE = 4.0


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
        velocities: {velocity channel: behind the derivative of its position}.
        motion: {joint: behind its effort, the measured one where there is one}; held commands alone make half a row.
        efforts: {actuator: measured effort behind the command}; empty where none was measured.
        moved: s by which the logs' commands were moved since.
    """

    velocities: Mapping[str, Late] = field(default_factory=dict)
    motion: Mapping[str, Late] = field(default_factory=dict)
    efforts: Mapping[str, Late] = field(default_factory=dict)
    moved: float = 0.0


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


def compare(predicted: Array, measured: Array, step: float, rows: NDArray[np.bool_], lag: float) -> tuple[float, float]:
    """Slope and correlation of measured [T] and predicted [T] `lag` s before, both every `step` s, over rows [T]."""
    time = step * np.arange(len(predicted))
    x, y = np.interp(time - lag, time, predicted)[rows], measured[rows] - measured[rows].mean()
    x = x - x.mean()
    norm = float(np.linalg.norm(x) * np.linalg.norm(y))
    return float(x @ y) / max(float(x @ x), 1e-300), float(x @ y) / norm if norm > 0 else 0.0


def offset(predicted: Array, measured: Array, step: float, rows: NDArray[np.bool_]) -> float:
    """s between the stamps of two columns: where they correlate most, if half of what is unexplained goes; else 0.

    `drive_channel` states when a drive acts on average while a command holds, which is another time by half a row.
    """
    scores = [compare(predicted, measured, step, rows, lag)[1] for lag in LAGS]
    best, now = int(np.argmax(scores)), len(LAGS) // 2
    clear = 1.0 - scores[best] <= 0.5 * (1.0 - scores[now]) and best not in (0, len(LAGS) - 1)
    return float(LAGS[best]) if clear else 0.0


def offsets(log: Log, mj_model: mujoco.MjModel) -> Iterator[tuple[str, Late]]:
    """(actuator, measured effort behind its command), of one log."""
    for actuator, asked, given, rows in commanded_and_measured(log, mj_model):
        yield actuator, Late(offset(asked, given, log.period, rows))


def commanded_and_measured(log: Log, mj_model: mujoco.MjModel) -> Iterator[tuple[str, Array, Array, NDArray[np.bool_]]]:
    """(actuator, effort that its command asks for, measured effort, rows), on an even grid, where both change.

    What is asked for is ctrl where a law is declared, whose unit efforts then have; else the model's own force.
    """
    streams = {i: stream for i in range(mj_model.nu) if (stream := measured(log, i)) is not None}
    if not streams:
        return
    grid = np.linspace(log.time[0], log.time[-1], len(log))
    target = controlled(log, mj_model) if controllers.declared(log.metadata) else commanded(log, mj_model)
    for i, stream in streams.items():
        if log.enabled.sum() >= LIMITS.min_rows and np.ptp(target[:, i]) > 0 and np.ptp(stream) > 0:
            asked, given = (np.interp(grid, log.time, x) for x in (target[:, i], stream))
            yield log.actuators[i], asked, given, log.enabled
