"""The chain command -> effort -> motion -> measurement, each link tested alone with its measured input and output."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.logcheck.drives import efforts, measured
from bayessim_mjx.diagnosis.logcheck.regressor import FEWEST, Regressor, filtered, motion
from bayessim_mjx.diagnosis.logcheck.rigid_body import nominal
from bayessim_mjx.diagnosis.logcheck.timing import Timing, commanded_and_measured, compare
from bayessim_mjx.logs.log import Log
from bayessim_mjx.logs.velocities import velocities
from bayessim_mjx.physics import controllers
from bayessim_mjx.quantities import percent


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


def _link(name: str, where: str, found: tuple[float, float, float], step: float, scaled: bool) -> Link:
    """The verdict: sound where slope, shape and time agree within 5 %, 1 % and a sample."""
    (slope, correlation, lag), faults = found, []
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


# Command -> effort


def _controllers(log: Log, mj_model: mujoco.MjModel, timing: Timing) -> Iterator[Link]:
    name = "command -> effort"
    pairs = {where: (asked, given, on) for where, asked, given, on in commanded_and_measured(log, mj_model)}
    for i, actuator in enumerate(log.actuators):
        if measured(log, i) is None:
            yield _untested(name, actuator, "no complete effort stream was logged")
        elif actuator not in pairs:
            yield _untested(name, actuator, "command or effort never changes while the drive is on")
        else:
            lag = timing.efforts[actuator].sure
            asked, given, on = pairs[actuator]
            link = (*compare(asked, given, log.period, on, lag), lag)
            yield _link(name, actuator, link, log.period, controllers.declared(log.metadata))


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
        link = (*compare(signal, needed[:, effort.dof], moved.step, rows, lag), lag)
        yield _link(name, effort.joint, link, log.period, effort.scaled)


# Motion -> measurement


def _sensors(log: Log, timing: Timing) -> Iterator[Link]:
    name = "motion -> measurement"
    if not log.has_qvel:
        yield _untested(name, "all joints", "no velocity was measured")
    for v in velocities(log):
        lag = timing.velocities[v.channel].sure if v.channel in timing.velocities else v.lag
        yield _link(name, v.channel, (v.slope, v.correlation, lag), log.period, True)
