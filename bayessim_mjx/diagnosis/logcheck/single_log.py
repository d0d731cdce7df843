"""Checks of one log on its own: enough of it, sampled evenly, channels that move and are not clipped or wrapped."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.logcheck.drives import LEAST
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.logs.signals import moves, quantum
from bayessim_mjx.logs.velocities import bandwidth
from bayessim_mjx.quantities import percent

ROWS = 20  # fewer, or half as many control steps, hold no window; a rule of thumb, not counted
REGISTERS = 2.0**16, 2.0**32  # values that a register of 16 or of 32 bits holds
_FASTEST = {"hinge": 150.0, "slide": 50.0}  # rad/s, m/s; faster: probably another unit (a rule of thumb)


@dataclass(frozen=True)
class Finding:
    """One remark on a log: it refuses the log, warns, or is only told; delay: s, which may differ between logs."""

    kind: Literal["refused", "warning", "finding"]
    text: str
    delay: float = 0.0


def size(log: Log, dt: float, logs: int) -> Iterator[Finding]:
    """Rows, duration and rate against the control period dt [s]."""
    if len(log) < ROWS or log.duration < ROWS / 2 * dt:
        have = f"{len(log)} rows over {log.duration:.3g} s"
        need = f"at least {ROWS} rows and {ROWS // 2} control steps of {dt:.3g} s"
        yield Finding("refused", f"too short: {have}; allowed: {need}")
    elif log.period > 20 * dt:
        yield Finding("refused", f"one row per {log.period:.3g} s; allowed: up to 20 control periods of {dt:.3g} s")
    elif log.period > 1.5 * dt:
        yield Finding(
            "warning",
            f"one row per {log.period:.3g} s against a control period of {dt:.3g} s: motion between rows is unknown",
        )
    if not log.enabled.any():
        yield Finding("refused", "the drive is off throughout; allowed: a log with commands that act")


def jitter(log: Log, dt: float, logs: int) -> Iterator[Finding]:
    """Count steps of time more than a fifth off their median."""
    steps = np.diff(log.time)
    off = float(np.mean(np.abs(steps / log.period - 1.0) > 0.2))
    if off > 0.1:
        worst = float(np.max(np.abs(steps / log.period - 1.0)))
        yield Finding(
            "warning",
            f"time: {percent(off)} of the steps are more than 20 % off their median (the worst by {percent(worst)})",
        )


def constant(log: Log, dt: float, logs: int) -> Iterator[Finding]:
    """Joints that never move, commands that never change; nothing moving at all is refused.

    logs: how many are judged together: in none of their channels noise is to count as motion (`signals.STILL`).
    """
    tested = logs * (len(log.sigma_qpos) + len(log.sigma_qvel))
    moved = np.array([moves(x, s, tested) for x, s in zip(log.qpos.T, log.sigma_qpos, strict=True)], bool)
    seen = [j for j in log.joints if log.seen_dofs[log.channels.columns(j, "qvel")].all()]
    still = [j for j in seen if not moved[log.channels.columns(j)].any()]
    own = zip(log.qvel.T, log.sigma_qvel, log.seen_speeds & bool(log.absent), strict=True)
    if len(still) == len(seen) and not any(moves(x, s, tested) for x, s, fast in own if fast):
        yield Finding("refused", f"nothing moves: {', '.join(still)} stay within their noise")
        return
    for joint in still:
        yield Finding("warning", f"qpos:{joint} never moves: nothing can be said about this joint")
    for name, x in zip(log.actuators, log.ctrl.T, strict=True):
        if np.ptp(x) <= 1e-9 * max(1.0, float(np.abs(x).max())):
            yield Finding("warning", f"ctrl:{name} never changes ({x[0]:.4g}): its influence is unknown")
    for name, stream in log.streams.items():
        if name.startswith("effort:") and np.ptp(stream) == 0:
            yield Finding("warning", f"{name} never changes ({stream[0]:.4g}): it is not used")


def clipped(log: Log, targets: Mapping[str, Array]) -> Iterator[Finding]:
    """Flat tops: a sensor that runs into its end at speed and stays on one value.

    Args:
        targets: {joint: `[T]`}, of joints whose drives follow a target: while it does not change they hold still.
    """
    for name, x in _measured(log):
        target = targets.get(name.partition(":")[2])
        for end in (float(x.max()), float(x.min())):
            flat = _flat(x, end)
            share = float(np.mean(flat))
            if share <= LEAST:
                continue
            # most values of a target that does not change lie within a step of the encoder
            if target is None or np.subtract(*np.quantile(target[flat], (0.9, 0.1))) > quantum(x):
                text = f"{name} is clipped at {end:.5g} ({percent(share)} of the rows"
                drive = name.startswith("effort:")
                end_of = "the drive's limit" if drive else "a hard stop"
                yield Finding("finding" if drive else "warning", f"{text}; {end_of}?)")


def _measured(log: Log) -> Iterator[tuple[str, Array]]:
    kinds = dict(zip(log.joints, log.channels.kinds, strict=True))
    for stream, values in (("qpos", log.qpos), *((("qvel", log.qvel),) if log.has_qvel else ())):
        names = [(n, f"{stream}:{n}") for n in getattr(log.channels, stream)]
        pairs = zip(names, values.T, strict=True)
        yield from ((name, c) for (n, name), c in pairs if n in kinds and name not in log.absent)
    yield from ((n, s) for n, s in log.streams.items() if n.startswith("effort:") and np.isfinite(s).all())


def _flat(x: Array, end: float) -> NDArray[np.bool_]:
    """Rows `[T]` in runs of four or more on the value `end` that are entered faster than a fifth of the top rate."""
    on = np.concatenate([[False], x == end, [False]])
    edges = np.flatnonzero(np.diff(on.astype(int))).reshape(-1, 2)
    rate = np.abs(np.diff(x))
    top = float(np.percentile(rate[rate > 0], 95)) if (rate > 0).any() else 0.0
    rows = np.zeros(len(x), bool)
    for a, b in edges:
        rows[a:b] = b - a >= 4 and a >= 2 and rate[a - 2] > 0.2 * top > 0
    return rows


def wrapped(log: Log, dt: float, logs: int) -> Iterator[Finding]:
    """Signed registers read as unsigned: jumps by 2^16 or 2^32 resolution steps."""
    for name, x in log.streams.items():
        x = x[np.isfinite(x)]
        jump = float(np.abs(np.diff(x)).max(initial=0.0))
        for grain in {1.0, quantum(x)} - {0.0}:
            for register in REGISTERS:
                if abs(jump / grain - register) < 0.05 * register:
                    bits = int(np.log2(register))
                    text = f"{name} jumps by {jump:.6g}: a signed {bits}-bit register read as unsigned"
                    mend = f"{text} (mend it with `signed: {bits}` in the map)"
                    yield Finding("refused" if name.startswith("effort:") else "warning", mend)
                    break
            else:
                continue
            break


def units(log: Log, known: Collection[str] = ()) -> Iterator[Finding]:
    """Speeds that robots do not reach: degrees, counts, millimetres.

    Args:
        known: joints whose unit something else vouches for.
    """
    for joint, kind in zip(log.joints, log.channels.kinds, strict=True):
        if kind not in _FASTEST or joint in known or f"qpos:{joint}" in log.absent:
            continue
        q, v = log.channels.columns(joint).start, log.channels.columns(joint, "qvel").start
        fastest = float(np.percentile(_speed(log, q), 99))
        unit = "rad/s (degrees or counts?)" if kind == "hinge" else "m/s (millimetres or counts?)"
        if fastest > _FASTEST[kind]:
            yield Finding(
                "warning", f"qpos:{joint} moves at {fastest:.4g} {unit}: mend the unit with `scale` in the map"
            )
        measured = float(np.percentile(np.abs(log.qvel[:, v]), 99))
        if log.has_qvel and measured > _FASTEST[kind] and measured > 5.0 * fastest:
            yield Finding("warning", f"qvel:{joint} reads {measured:.4g} {unit}, its position moves at {fastest:.4g}")


def _speed(log: Log, column: int) -> Array:
    """Speeds over half a cycle of the bandwidth: between two rows noise and jitter of the stamps are fast as well."""
    each = max(1, round(0.5 / (bandwidth(log) * log.period)))
    return np.asarray(
        np.abs((log.qpos[each:, column] - log.qpos[:-each, column]) / (log.time[each:] - log.time[:-each]))
    )


CHECKS = (size, jitter, constant, wrapped)  # of (log, control period, how many logs there are)


def alone(log: Log, dt: float, logs: int) -> tuple[Finding, ...]:
    """Return what shows in one of so many logs on its own, before it is compared with a model."""
    return tuple(f for test in CHECKS for f in test(log, dt, logs))


def unusable(log: Log, dt: float, logs: int) -> bool:
    """Whether one of so many logs is refused on its own."""
    return any(f.kind == "refused" for f in alone(log, dt, logs))
