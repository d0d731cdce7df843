"""The chain command -> effort -> motion -> measurement, each link tested alone with its measured input and output.

Command -> effort also drive by drive over all logs (`channels_of`): scale, lateness and residual.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.logcheck.drives import FLOOR, LEAST, centred, commanded, controlled, efforts, measured
from bayessim_mjx.diagnosis.logcheck.regressor import FEWEST, Mask, Regressor, motion
from bayessim_mjx.diagnosis.logcheck.rigid_body import nominal
from bayessim_mjx.diagnosis.logcheck.timing import LAGS, SURE, Timing, nearest
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.logs.velocities import velocities
from bayessim_mjx.physics import controllers
from bayessim_mjx.quantities import percent

ECHO = 10.0 * float(np.finfo(np.float32).eps)  # of the effort: no measurement comes so close to a command


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
    return [*_controllers(log, mj_model), *_drives(log, mj_model, timing), *_sensors(log, timing)]


def _link(name: str, where: str, found: tuple[float, float, float], step: float, scaled: bool) -> Link:
    """Return the verdict: sound where slope, shape and time agree within 5 %, 1 % and a sample."""
    (slope, correlation, lag), faults = found, []
    if correlation < 0.99:
        faults.append(f"the shape differs (correlation {correlation:.3f})")
    if scaled and abs(slope - 1.0) > 0.05:
        faults.append(f"the scale is off by {percent(slope - 1.0, sign=True)}")
    if abs(lag) > step:
        faults.append(f"it is {abs(lag) * 1e3:.0f} ms {'late' if lag > 0 else 'early'}")
    numbers = f"corr {correlation:.3f}, slope {slope:.3g}, lag {lag * 1e3:+.1f} ms"
    clean = "no error seen by this test" + ("" if scaled else "; the unit is not known")
    verdict = "; ".join(faults) or clean
    return Link(name, where, True, slope, correlation, lag, not faults, f"{name} at {where}: {verdict} ({numbers})")


def _untested(name: str, where: str, why: str) -> Link:
    nan = float("nan")
    return Link(name, where, False, nan, nan, nan, False, f"{name} at {where}: not tested: {why}")


@dataclass(frozen=True)
class Channel:
    """One drive: effort = scale * command's force, `late` s after it, plus a constant.

    Attributes:
        scale, deviation; late: s; left, peak: share of the effort that this does not explain, rms and at most.
        constant, doubt: and its standard deviation, in the unit of the effort; size: of the effort, rms.
        noise: share of the effort that the encoders' noise may make of what a servo is thought to exert.
        cancels: a servo's stiffness over its stiffness and damping together; at least 1.
        sound: it follows its command. Of efforts in a unit of their own: as the other drives do.
        echo: the logged effort is the command itself, no measurement.
    """

    actuator: str
    scale: float
    deviation: float
    late: float
    left: float
    peak: float
    constant: float
    doubt: float
    size: float
    noise: float
    cancels: float
    echo: bool = False
    sound: bool = False

    @property
    def apart(self) -> float:
        """Share of the effort that command and constant leave, rms or half of the most: a limit acts in few rows."""
        return max(self.left, self.peak / 2)

    @property
    def static(self) -> bool:
        """Whether nothing but a scale and a constant lies between command and effort."""
        return self.apart < LEAST and not self.echo

    @property
    def identified(self) -> bool:
        """Whether the logs tell what it does: errors take their square off the scale (Fuller 1987, eq. 1.1.6)."""
        return max(self.noise, FLOOR * self.cancels) ** 2 < FLOOR

    @property
    def off(self) -> float:
        """The scale where it is surely not 1, else 1."""
        sure = LEAST + SURE * self.deviation + self.noise**2 + FLOOR * self.cancels
        return self.scale if abs(self.scale - 1.0) > sure and self.identified and not self.echo else 1.0

    @property
    def shifted(self) -> float:
        """The constant where it is surely not 0, else 0."""
        sure = LEAST * self.size + SURE * self.doubt
        return self.constant if abs(self.constant) > sure and self.identified and not self.echo else 0.0

    def judged(self, common: float, period: float) -> Channel:
        """Return the channel in units of the `common` scale, with whether it is sound."""
        c = replace(self, scale=self.scale / common, deviation=self.deviation / abs(common))
        obeys = c.apart < LEAST + 2.0 * c.noise + FLOOR * (c.cancels - 1.0) and abs(c.late) < period
        return replace(c, sound=bool(obeys and c.off == 1.0 and c.shifted == 0.0))


def channels_of(
    logs: Sequence[Log], model: mujoco.MjModel, unit: bool, ask: Callable[[Log, mujoco.MjModel], Array] = commanded
) -> tuple[Channel, ...]:
    """Return the drives whose effort was measured in all logs.

    Args:
        unit: efforts have the unit of what is asked for; ask: what commands ask for, `[T, nu]`; default: the forces of
            the model's actuators.
    """
    own = [i for i in range(model.nu) if logs and all(measured(log, i) is not None for log in logs)]
    if not own:
        return ()
    pairs = [_pairs(log, model, own, ask) for log in logs]
    if not any(len(p[0].effort) for p in pairs):
        return ()
    period = float(np.median([log.period for log in logs]))
    found = [_better(logs[0].actuators[i], [p[k] for p in pairs], period) for k, i in enumerate(own)]
    common = 1.0 if unit else float(np.median([c.scale for c in found])) or 1.0
    return tuple(c.judged(common, period) for c in found)


@dataclass(frozen=True, eq=False)
class _Pair:
    """Of one log and drive, filtered alike.

    Attributes:
        effort: `[T]`; held, centred: `[L, T]`, commanded forces at all LAGS, each with the command as it holds and as
            it is in the middle of its row; noise: `[T]`, of the commanded force; still: `[T]`, it without speed.
        raw: `[2, T]`, commanded force and effort as logged; share: independent rows per row.
    """

    effort: Array
    held: Array
    centred: Array
    noise: Array
    still: Array
    raw: Array
    share: float


def _pairs(
    log: Log, model: mujoco.MjModel, own: Sequence[int], ask: Callable[[Log, mujoco.MjModel], Array]
) -> list[_Pair]:
    moved = motion(log, model)
    on = log.enabled[:, None]  # filters blend what a drive does with what it would do while it is off
    held, middle = on * ask(log, model), on * ask(centred(log), model)
    rng = np.random.default_rng(0)
    noisy = [x + s * rng.normal(size=x.shape) for x, s in ((log.qpos, log.sigma_qpos), (log.qvel, log.sigma_qvel))]
    noise = on * ask(replace(log, qpos=noisy[0], qvel=noisy[1]), model) - held
    slow = on * ask(replace(log, qvel=0.0 * log.qvel), model)
    out = []
    for i in own:
        effort = measured(log, i)
        assert effort is not None
        at = [moved.filtered(x[:, i], log, LAGS)[:, moved.free] for x in (held, middle)]
        rows = [moved.filtered(x, log)[moved.free] for x in (effort, noise[:, i], slow[:, i])]
        out.append(_Pair(rows[0], at[0], at[1], rows[1], rows[2], np.stack([held[:, i], effort]), moved.share))
    return out


def _better(name: str, pairs: Sequence[_Pair], period: float) -> Channel:
    """With commands as they hold, or in the middle of their rows: a servo's force follows the motion within a row."""
    held = _channel(name, pairs, [p.held for p in pairs], 0.5 * period)
    middle = _channel(name, pairs, [p.centred for p in pairs], 0.0)
    return min(held, middle, key=lambda c: c.left)


def _channel(name: str, pairs: Sequence[_Pair], commands: Sequence[Array], behind: float) -> Channel:
    """Least squares of the effort on the command at the lag that explains most, and a constant.

    Args:
        behind: s that a command acts later on average than it stands in the log, which is no lateness.
    """
    one, echo = np.concatenate([np.full(len(p.effort), np.sqrt(p.share)) for p in pairs]), _echo(pairs)
    rows = max(float(one @ one), 1e-9)
    y = one * np.concatenate([p.effort for p in pairs])
    each = one * np.concatenate(list(commands), axis=1)
    spread = max(float(y @ y - (one @ y) ** 2 / rows), 1e-300)
    varying = each - np.outer(each @ one / rows, one)
    explained = (varying @ y) ** 2 / np.maximum(np.sum(varying**2, 1), 1e-300) / spread
    gap = 1.0 - explained[len(LAGS) // 2] > LEAST**2  # else nothing is left that a lag could explain
    lag = nearest(LAGS, explained, np.ones(len(LAGS), bool), rows).seconds if gap else 0.0
    x = np.array([np.interp(lag, LAGS, column) for column in each.T])
    X = np.stack([x, one], 1)
    c, *_ = np.linalg.lstsq(X, y, rcond=None)
    (scale, constant), rest = c.tolist(), y - X @ c
    errors = np.sqrt(rest @ rest / max(rows - X.shape[1], 1.0) * np.diag(np.linalg.pinv(X.T @ X))).tolist()
    size = max(float(np.sqrt(y @ y / rows)), 1e-300)
    noise = float(np.sqrt(np.mean(np.concatenate([p.noise for p in pairs]) ** 2) * rows / spread)) * abs(scale)
    left, peak = float(np.sqrt(rest @ rest / spread)), float(np.max(np.abs(rest) / one, initial=0.0)) / size
    late = lag - behind
    net = np.std(np.concatenate([p.centred[len(LAGS) // 2] for p in pairs]))
    cancels = max(1.0, float(np.std(np.concatenate([p.still for p in pairs])) / max(net, 1e-300)))
    return Channel(name, scale, errors[0], late, left, peak, constant, errors[1], size, noise, cancels, echo)


def _echo(pairs: Sequence[_Pair]) -> bool:
    """Whether every effort is its own row's command up to a scale, or that of the row before."""
    for late in (0, 1):
        x = np.concatenate([p.raw[0, : p.raw.shape[1] - late] for p in pairs])
        y = np.concatenate([p.raw[1, late:] for p in pairs])
        scale = float(x @ y) / max(float(x @ x), 1e-300)
        if np.abs(y - scale * x).max() < ECHO * (float(np.sqrt(np.mean(y**2))) + 1e-300):
            return True
    return False


def _controllers(log: Log, mj_model: mujoco.MjModel) -> Iterator[Link]:
    """Efforts have the unit of ctrl where a law is declared, else that of the model's force."""
    name, declared = "command -> effort", controllers.declared(log.metadata)
    found = {c.actuator: c for c in channels_of([log], mj_model, True, controlled if declared else commanded)}
    for i, actuator in enumerate(log.actuators):
        c = found.get(actuator)
        if measured(log, i) is None:
            yield _untested(name, actuator, "no complete effort stream was logged")
        elif c is None:
            yield _untested(name, actuator, "too little motion free of contacts and limits")
        elif 1.0 - c.left < ECHO:
            yield _untested(name, actuator, "command or effort never changes while the drive is on")
        else:
            late = c.late + 0.5 * log.period  # as the stamps say it
            late = late if abs(late) > log.period else 0.0
            yield _link(name, actuator, (c.scale, (1.0 - c.left**2) ** 0.5, late), log.period, declared)


def _drives(log: Log, mj_model: mujoco.MjModel, timing: Timing) -> Iterator[Link]:
    """Return the measured effort, or the command where it is one, against the motion's nominal inverse dynamics."""
    found = {e.joint: e for e in reversed(list(efforts(log, mj_model)))}  # a stream comes before the command
    if not found:
        yield _untested("effort -> motion", "all joints", "no effort was logged, and the commands are targets")
        return
    moved = motion(log, mj_model)
    needed = Regressor.of(mj_model, moved, sets=np.zeros((0, *nominal(mj_model).shape))).known
    for effort in found.values():
        name = "command -> motion" if effort.source == "ctrl" else "effort -> motion"
        rows = moved.moving(effort.dof)
        signal = moved.filtered(effort.signal, log)
        if rows.sum() * moved.share < FEWEST or np.ptp(signal[rows]) == 0:
            yield _untested(name, effort.joint, "too little motion free of contacts and limits")
            continue
        lag = timing.motion[effort.joint].sure if effort.joint in timing.motion else 0.0
        late = lag - effort.hold if lag else 0.0  # a held command acts half a row later by itself
        link = (*_compare(signal, needed[:, effort.dof], moved.step, rows, lag), late)
        yield _link(name, effort.joint, link, log.period, effort.scaled)


def _compare(predicted: Array, measured: Array, step: float, rows: Mask, lag: float) -> tuple[float, float]:
    """Slope and correlation of measured [T] and predicted [T] `lag` s before, both every `step` s, over rows [T]."""
    time = step * np.arange(len(predicted))
    x, y = np.interp(time - lag, time, predicted)[rows], measured[rows] - measured[rows].mean()
    x = x - x.mean()
    norm = float(np.linalg.norm(x) * np.linalg.norm(y))
    return float(x @ y) / max(float(x @ x), 1e-300), float(x @ y) / norm if norm > 0 else 0.0


def _sensors(log: Log, timing: Timing) -> Iterator[Link]:
    name = "motion -> measurement"
    if not log.has_qvel:
        yield _untested(name, "all joints", "no velocity was measured")
    for v in velocities(log):
        lag = timing.velocities[v.channel].sure if v.channel in timing.velocities else v.lag
        yield _link(name, v.channel, (v.slope, v.correlation, lag), log.period, True)
