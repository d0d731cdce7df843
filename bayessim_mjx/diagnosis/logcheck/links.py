"""The chain command -> effort -> motion -> measurement, each link tested alone with its measured input and output."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.logcheck.drives import commanded, controlled, efforts, measured
from bayessim_mjx.diagnosis.logcheck.regressor import FEWEST, Mask, Regressor, filtered, motion
from bayessim_mjx.diagnosis.logcheck.rigid_body import nominal
from bayessim_mjx.diagnosis.logcheck.single_log import LIMITS
from bayessim_mjx.diagnosis.logcheck.timing import Late, Timing
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.logs.velocities import velocities
from bayessim_mjx.physics import controllers
from bayessim_mjx.quantities import percent

LAGS = np.linspace(-0.2, 0.2, 161)  # s, odd: none is among them


@dataclass(frozen=True)
class Link:
    """One link of the chain at one place.

    Attributes:
        name: "command -> effort", "effort -> motion" (or "command -> motion"), "motion -> measurement".
        where: the actuator, joint or velocity channel.
        tested: whether the log allows the test; otherwise the numbers are NaN and `text` says why.
        slope: output = slope * what the input predicts.
        correlation: at the lag.
        lag: s by which the output is late.
        sound: this link does what the model says; the gap is not here.
        text: the verdict in words.
    """

    name: str
    where: str
    tested: bool
    slope: float
    correlation: float
    lag: float
    sound: bool
    text: str


def links(log: Log, mj_model: mujoco.MjModel, timing: Timing) -> list[Link]:
    """All links of one log, in the order of the chain; timing: of all logs (`Gate.timing`)."""
    if log.lost:
        return []  # what a joint needs is known only with the motion of all
    return [*_controllers(log, mj_model, timing), *_drives(log, mj_model, timing), *_sensors(log, timing)]


def _link(name: str, where: str, slope: float, correlation: float, lag: float, step: float, scaled: bool) -> Link:
    """The verdict: sound where slope, shape and time agree within 5 %, 1 % and a sample."""
    faults = []
    if correlation < 0.99:
        faults.append(f"the shape differs (correlation {correlation:.3f})")
    if scaled and abs(slope - 1.0) > 0.05:
        faults.append(f"the scale is off by {percent(slope - 1.0, sign=True)}")
    if abs(lag) > step:
        faults.append(f"it is {abs(lag) * 1e3:.0f} ms {'late' if lag > 0 else 'early'}")
    numbers = f"corr {correlation:.3f}, slope {slope:.3g}, lag {lag * 1e3:+.1f} ms"
    known = "as the model says" if scaled else "shape and time as the model says, the unit is not known"
    verdict = "; ".join(faults) if faults else f"{known}: exonerated"
    return Link(name, where, True, slope, correlation, lag, not faults, f"{name} at {where}: {verdict} ({numbers})")


def _untested(name: str, where: str, why: str) -> Link:
    nan = float("nan")
    return Link(name, where, False, nan, nan, nan, False, f"{name} at {where}: not tested: {why}")


def compare(predicted: Array, measured: Array, step: float, rows: Mask, lag: float) -> tuple[float, float]:
    """Slope and correlation of measured [T] and predicted [T] `lag` s before, both every `step` s, over rows [T]."""
    time = step * np.arange(len(predicted))
    x, y = np.interp(time - lag, time, predicted)[rows], measured[rows] - measured[rows].mean()
    x = x - x.mean()
    norm = float(np.linalg.norm(x) * np.linalg.norm(y))
    return float(x @ y) / max(float(x @ x), 1e-300), float(x @ y) / norm if norm > 0 else 0.0


def offset(predicted: Array, measured: Array, step: float, rows: Mask) -> float:
    """s between the stamps of two columns: where they correlate most, if half of what is unexplained goes; else 0.

    `drive_channel` states when a drive acts on average while a command holds, which is another time by half a row.
    """
    scores = [compare(predicted, measured, step, rows, lag)[1] for lag in LAGS]
    best, now = int(np.argmax(scores)), len(LAGS) // 2
    clear = 1.0 - scores[best] <= 0.5 * (1.0 - scores[now]) and best not in (0, len(LAGS) - 1)
    return float(LAGS[best]) if clear else 0.0


# Command -> effort


def _controllers(log: Log, mj_model: mujoco.MjModel, timing: Timing) -> Iterator[Link]:
    name = "command -> effort"
    pairs = {actuator: (asked, given, rows) for actuator, asked, given, rows in _pairs(log, mj_model)}
    for i, actuator in enumerate(log.actuators):
        if measured(log, i) is None:
            yield _untested(name, actuator, "no complete effort stream was logged")
        elif actuator not in pairs:
            yield _untested(name, actuator, "command or effort never changes while the drive is on")
        else:
            lag = timing.efforts[actuator].sure
            asked, given, rows = pairs[actuator]
            slope, correlation = compare(asked, given, log.period, rows, lag)
            yield _link(name, actuator, slope, correlation, lag, log.period, controllers.declared(log.metadata))


def offsets(log: Log, mj_model: mujoco.MjModel) -> Iterator[tuple[str, Late]]:
    """(actuator, measured effort behind its command), of one log."""
    for actuator, asked, given, rows in _pairs(log, mj_model):
        yield actuator, Late(offset(asked, given, log.period, rows))


def _pairs(log: Log, mj_model: mujoco.MjModel) -> Iterator[tuple[str, Array, Array, Mask]]:
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


# Effort -> motion


def _drives(log: Log, mj_model: mujoco.MjModel, timing: Timing) -> Iterator[Link]:
    """The measured effort, or the command where it is one, against the nominal inverse dynamics of the motion."""
    found = {e.joint: e for e in reversed(list(efforts(log, mj_model)))}  # a stream comes before the command
    if not found:
        yield _untested("effort -> motion", "all joints", "no effort was logged, and the commands are targets")
        return
    moved = motion(log, mj_model)
    needed = Regressor.of(mj_model, moved, sets=np.zeros((0, *nominal(mj_model).shape))).known
    for effort in found.values():
        name = "command -> motion" if effort.source == "ctrl" else "effort -> motion"
        rows = moved.moving(effort.dof)
        signal = filtered(effort.signal, log, moved)
        if rows.sum() * moved.share < FEWEST or np.ptp(signal[rows]) == 0:
            yield _untested(name, effort.joint, "too little motion free of contacts and limits")
            continue
        lag = timing.motion[effort.joint].sure if effort.joint in timing.motion else 0.0
        slope, correlation = compare(signal, needed[:, effort.dof], moved.step, rows, lag)
        yield _link(name, effort.joint, slope, correlation, lag, log.period, effort.scaled)


# Motion -> measurement


def _sensors(log: Log, timing: Timing) -> Iterator[Link]:
    name = "motion -> measurement"
    if not log.has_qvel:
        yield _untested(name, "all joints", "no velocity was measured")
    for v in velocities(log):
        lag = timing.velocities[v.channel].sure if v.channel in timing.velocities else v.lag
        yield _link(name, v.channel, v.slope, v.correlation, lag, log.period, True)
