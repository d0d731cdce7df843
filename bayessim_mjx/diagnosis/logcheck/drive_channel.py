"""Command -> effort, drive by drive over all logs: scale, lateness and what is left, where the effort was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.logcheck.drives import centred, commanded, measured
from bayessim_mjx.diagnosis.logcheck.regressor import filtered, motion
from bayessim_mjx.logs.log import Array, Log


@dataclass(frozen=True)
class Limits:
    """When a drive follows its command. Error rates: benchmarks/records/log_checks.json."""

    same: float = 0.03  # share by which a scale may be off, and a constant of the effort, rms
    left: float = 0.02  # of the effort, rms; in each row three times as much: a limit acts in few rows
    # of the encoders' noise, taken for white: steps of an encoder are slower, and come through filters
    steps: float = 5.0
    # of each of a servo's two terms, stiffness and damping: so well they are known from the positions
    terms: float = 0.01
    hidden: float = 0.1  # uncertainty of the scale above which a servo's effort is not told from its command
    late: float = 1.5  # periods of the log


LIMITS = Limits()
ECHO = 10.0 * float(np.finfo(np.float32).eps)  # of the effort: no measurement comes so close to a command
ROWS = 4  # of commands that an effort may come from: this one and those before; a rule of thumb, not measured


@dataclass(frozen=True)
class Channel:
    """One drive: effort = scale * command's force, `late` s after it, plus a constant.

    Attributes:
        scale, deviation; late: s; left, peak: share of the effort that this does not explain, rms and at most.
        constant: in the unit of the effort; size: of the effort, rms.
        noise: share of the effort that the encoders' noise may make of what a servo is thought to exert.
        cancels: the terms of a servo's force over their sum.
        sound: it does what it is told. Of efforts in a unit of their own: as the other drives do.
        echo: the logged effort is the command itself, no measurement.
    """

    actuator: str
    scale: float
    deviation: float
    late: float
    left: float
    peak: float
    constant: float
    size: float
    noise: float
    cancels: float
    echo: bool = False
    sound: bool = False

    @property
    def static(self) -> bool:
        """Whether nothing but a scale and a constant lies between command and effort."""
        return self.left < LIMITS.left and self.peak < 3.0 * LIMITS.left and not self.echo

    @property
    def identified(self) -> bool:
        """Whether the log tells what the drive does."""
        return max(self.noise, LIMITS.terms * self.cancels) < LIMITS.hidden

    @property
    def off(self) -> float:
        """The scale where it is surely not 1, else 1."""
        sure = LIMITS.same + 3.0 * self.deviation + 2.0 * self.noise**2 + LIMITS.terms * self.cancels
        return self.scale if abs(self.scale - 1.0) > sure and self.identified and not self.echo else 1.0

    @property
    def shifted(self) -> float:
        """The constant where it is surely not 0, else 0."""
        sure = (LIMITS.same + self.left / 5.0) * self.size
        return self.constant if abs(self.constant) > sure and self.identified and not self.echo else 0.0


def channels_of(logs: Sequence[Log], model: mujoco.MjModel, unit: bool) -> tuple[Channel, ...]:
    """The drives whose effort was measured in all logs; `unit`: it is the unit of the model's actuators."""
    own = [i for i in range(model.nu) if logs and all(measured(log, i) is not None for log in logs)]
    if not own:
        return ()
    pairs = [_pairs(log, model, own) for log in logs]
    period = float(np.median([log.period for log in logs]))
    found = [_better(logs[0].actuators[i], [p[k] for p in pairs], period) for k, i in enumerate(own)]
    common = 1.0 if unit else float(np.median([c.scale for c in found])) or 1.0
    return tuple(_judged(c, common, period) for c in found)


def _judged(c: Channel, common: float, period: float) -> Channel:
    scale, deviation = c.scale / common, c.deviation / abs(common)
    c = replace(c, scale=scale, deviation=deviation)
    obeys = c.left < LIMITS.left + 2.0 * c.noise and abs(c.late) < LIMITS.late * period * (1.0 + 10.0 * c.noise)
    return replace(c, sound=bool(obeys and c.off == 1.0 and c.shifted == 0.0))


@dataclass(frozen=True, eq=False)
class _Pair:
    """Of one log and drive.

    Attributes:
        effort: `[T]`; held, centred: `[ROWS, T]`, commanded forces of this row and the rows before, each with the
            command as it holds and as it is in the middle of its row.
        raw: `[2, T]`, commanded force and effort as logged; noise: `[T]`, of the commanded force; terms: it
            without speed, `[T]`.
        share: independent rows per row.
    """

    effort: Array
    held: Array
    centred: Array
    raw: Array
    noise: Array
    terms: Array
    share: float


def _pairs(log: Log, model: mujoco.MjModel, own: Sequence[int]) -> list[_Pair]:
    moved = motion(log, model)
    commands, middle, noise = commanded(log, model), commanded(centred(log), model), _noise(log, model)
    still = commanded(replace(log, qvel=0.0 * log.qvel), model)
    out = []
    for i in own:
        effort = measured(log, i)
        assert effort is not None
        rows = [np.maximum(np.arange(len(log)) - k, 0) for k in range(ROWS)]
        each = [np.stack([filtered(x[r, i], log, moved)[moved.free] for r in rows]) for x in (commands, middle)]
        smooth = filtered(effort, log, moved)[moved.free]
        noisy = filtered(noise[:, i], log, moved)[moved.free]
        terms = filtered(still[:, i], log, moved)[moved.free]
        out.append(_Pair(smooth, each[0], each[1], np.stack([commands[:, i], effort]), noisy, terms, moved.share))
    return out


def _noise(log: Log, model: mujoco.MjModel) -> Array:
    """`[T, nu]`, what a draw of the encoders' noise changes in the forces of servos."""
    rng = np.random.default_rng(0)
    moved = [x + s * rng.normal(size=x.shape) for x, s in ((log.qpos, log.sigma_qpos), (log.qvel, log.sigma_qvel))]
    return commanded(replace(log, qpos=moved[0], qvel=moved[1]), model) - commanded(log, model)


def _better(name: str, pairs: Sequence[_Pair], period: float) -> Channel:
    """With commands as they hold, or in the middle of their rows: a servo's force follows the motion within a row."""
    held = _channel(name, pairs, [p.held for p in pairs], period, 0.5)
    middle = _channel(name, pairs, [p.centred for p in pairs], period, 0.0)
    return min(held, middle, key=lambda c: c.left)


def _channel(name: str, pairs: Sequence[_Pair], efforts: Sequence[Array], period: float, behind: float) -> Channel:
    """Least squares of the effort on the commands of this row and those before, and a constant.

    Args:
        behind: rows that a command acts later on average than it stands in the log, which is no lateness.
    """
    y = np.concatenate([np.sqrt(p.share) * p.effort for p in pairs])
    x = np.concatenate([np.sqrt(p.share) * z for p, z in zip(pairs, efforts, strict=True)], axis=1)
    one = np.concatenate([np.full(len(p.effort), np.sqrt(p.share)) for p in pairs])
    X = np.stack([*x, one], 1)
    c, *_ = np.linalg.lstsq(X, y, rcond=1e-6)
    rest, rows = float(np.sum((y - X @ c) ** 2)), float(one @ one)
    spread = float(np.sum((y - one * (one @ y) / max(rows, 1e-9)) ** 2))
    sums = np.append(np.ones(ROWS), 0.0)
    scale = float(c @ sums)
    deviation = float(np.sqrt(rest / max(rows - ROWS - 1, 1.0) * max(sums @ np.linalg.pinv(X.T @ X) @ sums, 0.0)))
    late = period * (float(c[:ROWS] @ np.arange(ROWS)) / scale - behind) if scale else 0.0
    varies = float(np.sqrt(spread / max(rows, 1e-9))) or 1e-300
    size = float(np.sqrt(y @ y / max(rows, 1e-9)))
    noise = float(np.sqrt(np.mean(np.concatenate([p.noise for p in pairs]) ** 2))) * abs(scale) / varies
    left = float(np.sqrt(rest / max(spread, 1e-300)))
    peak = float(np.max(np.abs(y - X @ c) / one, initial=0.0)) / max(size, 1e-300)
    noise = left if noise < left < LIMITS.steps * noise else noise
    return Channel(name, scale, deviation, late, left, peak, float(c[-1]), size, noise, _cancels(pairs), _echo(pairs))


def _cancels(pairs: Sequence[_Pair]) -> float:
    """How much larger a servo's stiffness pulls than stiffness and damping together; 1 of a torque's command."""
    net, part = (np.concatenate(x) for x in zip(*((p.centred[0], p.terms) for p in pairs), strict=True))
    size = float(np.std(net)) or 1e-300
    return max(1.0, float(np.std(part)) / size)


def _echo(pairs: Sequence[_Pair]) -> bool:
    """Whether every effort is its own row's command up to a scale, or that of the row before."""
    for late in (0, 1):
        x = np.concatenate([p.raw[0, : p.raw.shape[1] - late] for p in pairs])
        y = np.concatenate([p.raw[1, late:] for p in pairs])
        scale = float(x @ y) / max(float(x @ x), 1e-300)
        if np.abs(y - scale * x).max() < ECHO * (float(np.sqrt(np.mean(y**2))) + 1e-300):
            return True
    return False
