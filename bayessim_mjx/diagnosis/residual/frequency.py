"""Frequency: command to motion, measured and simulated; equivalent delay; orders in the angle; resonance lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import detrend
from scipy.signal.windows import dpss

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.windows import Windows
from bayessim_mjx.diagnosis.residual import motion_inputs
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance, estimate
from bayessim_mjx.diagnosis.residual.motion_inputs import Inputs
from bayessim_mjx.diagnosis.residual.regions import discoveries
from bayessim_mjx.diagnosis.residual.where import Number, regress

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rules:
    """How spectra are estimated, and what of them is mentioned. Rules of thumb, not counted.

    Attributes:
        segment: s, of a spectrum; least: values in a row that one is made of.
        tapers, bandwidth: of the multitaper estimate (Thomson, 1982).
        coherent: coherence from which on a frequency counts for the phase.
        line: times that a line is above its surroundings; stands: times that an order is above the others.
        small: share of the force's rms, below which an order is not mentioned.
        turns: periods of an order within the range of motion.
    """

    segment: float = 4.0
    tapers: int = 4
    bandwidth: float = 2.5
    coherent: float = 0.5
    line: float = 6.0
    small: float = 0.1
    stands: float = 4.0
    least: int = 16
    turns: float = 2.0


RULES = Rules()


@dataclass(frozen=True, eq=False)
class Spectra:
    """Multitaper spectra, `[segments, F]`: of x, of y, cross (conj(x) y); hz `[F]`; log of each segment."""

    hz: Array
    xx: Array
    yy: Array
    xy: NDArray[np.complex128]
    log: NDArray[np.int64]

    def pooled(self, weight: Array | None = None) -> tuple[Array, Array, NDArray[np.complex128]]:
        w = np.ones(len(self.xx)) if weight is None else weight
        return w @ self.xx, w @ self.yy, w @ self.xy

    @property
    def coherence(self) -> Array:
        xx, yy, xy = self.pooled()
        return np.abs(xy) ** 2 / np.maximum(xx * yy, 1e-300)

    @property
    def response(self) -> NDArray[np.complex128]:
        xx, _, xy = self.pooled()
        return xy / np.maximum(xx, 1e-300)


def spectra(x: Sequence[Array], y: Sequence[Array], dt: float, log: Sequence[int] | None = None) -> Spectra:
    """Of pairs of series of any lengths; each is cut into segments of one common length that overlap by half."""
    shortest = min(len(a) for a in x)
    size = min(int(round(RULES.segment / dt)), max(shortest, RULES.least))
    tapers = np.asarray(dpss(size, RULES.bandwidth, RULES.tapers))
    rows, owner = [], []
    for i, (a, b) in enumerate(zip(x, y, strict=True)):
        for start in range(0, len(a) - size + 1, max(size // 2, 1)):
            fa, fb = (np.fft.rfft(tapers * detrend(s[start : start + size])) for s in (a, b))
            rows.append((np.mean(np.abs(fa) ** 2, 0), np.mean(np.abs(fb) ** 2, 0), np.mean(np.conj(fa) * fb, 0)))
            owner.append(i if log is None else log[i])
    xx, yy, xy = (np.array([row[k] for row in rows]) for k in range(3))
    hz = np.asarray(np.fft.rfftfreq(size, dt)[1:], np.float64)
    return Spectra(hz, xx[:, 1:].real, yy[:, 1:].real, xy[:, 1:], np.array(owner))


def delay(found: Spectra, top: float = np.inf) -> Number:
    """Equivalent delay of y behind x [s] from the slope of the phase through zero, weighted by coherence.

    phase = -2 pi f T, weights C / (1 - C): frequencies without coherence C or above `top` Hz count nothing.
    """
    coherence = found.coherence
    # where a wrapped phase could be meant, a delay is ambiguous: stop at the first jump of the phase
    phase = np.unwrap(np.angle(found.response))
    use = (coherence > RULES.coherent) & (found.hz <= top)
    weight = np.where(use, coherence / np.maximum(1 - coherence, 1e-3), 0.0)
    omega = 2 * np.pi * found.hz

    def slope(total: NDArray[np.complex128]) -> float:
        turned = np.angle(total * np.exp(-1j * phase)) + phase  # near the pooled phase: no jumps between logs
        return float(-np.sum(weight * omega * turned) / max(float(np.sum(weight * omega**2)), 1e-300))

    whole = slope(found.pooled()[2])
    replicates = np.array([slope(found.pooled(w)[2]) for w in statistics.leave_one_out(found.log)])
    return Number(whole, *statistics.interval(whole, replicates), "s")


def runs(windows: Windows) -> list[NDArray[np.int64]]:
    """Windows that follow each other without a gap, in order."""
    order = np.lexsort((windows.start, windows.log))
    cuts = [
        k
        for k in range(1, len(order))
        if windows.log[order[k]] != windows.log[order[k - 1]]
        or windows.start[order[k]] != windows.start[order[k - 1]] + windows.steps
    ]
    return [np.asarray(part) for part in np.split(order, cuts)]


def orders(disturbance: Disturbance, inputs: Inputs, dof: int, without: Array, most: int = 64) -> list[dict]:
    """[{"order", "amplitude", "p"}]: forces periodic in the angle of a hinge, significant ones.

    Amplitudes by least squares beside friction, load and offset, with the averaging between nodes taken into account.
    """
    q, basis = inputs.position[..., dof], disturbance.linear.basis
    if not inputs.hinge[dof] or np.ptp(q) <= 0:
        return []
    average = basis / basis.sum(0)
    spacing = float(np.median(np.diff(disturbance.time))) if len(disturbance.time) > 1 else np.inf
    pace = float(np.median(np.abs(inputs.speed[..., dof])))
    first, last = int(np.ceil(RULES.turns * 2 * np.pi / np.ptp(q))), int(min(most, np.pi / max(pace * spacing, 1e-9)))
    tried = np.arange(max(first, 1), last + 1)
    if not len(tried):
        return []
    y, gain = disturbance.force[..., dof], disturbance.gain[:, dof]
    w, s, load = (inputs.of(k)[..., dof] @ average for k in ("speed", "direction", "load"))
    flat = [np.ones_like(w), s, w, w * np.abs(w), load, q @ average]
    found = [_order(int(n), y, gain, q, average, flat, without) for n in tried]
    strong = discoveries(np.array([f["p"] for f in found]))
    size = np.array([f["amplitude"] for f in found])
    padded = np.pad(size, 1)
    peak = (size >= padded[2:]) & (size >= padded[:-2])  # a short range of motion smears an order over its neighbours
    large = peak & (size > RULES.small * np.sqrt(np.mean(y**2))) & (size > RULES.stands * np.median(size))
    return [f for f, is_strong in zip(found, strong & large, strict=True) if is_strong]


def _order(n: int, y: Array, gain: Array, q: Array, average: Array, flat: list[Array], without: Array) -> dict:
    X = np.stack([*flat, np.cos(n * q) @ average, np.sin(n * q) @ average], 2)
    beta, replicates, _ = regress(y, X, gain, without)
    pair, own = beta[-2:], len(replicates) - 1
    p = 1.0  # two coefficients are told from 0 by three conditions at least
    if own > 1:
        z2 = float(pair @ np.linalg.solve(statistics.covariance(replicates[:, -2:]) + 1e-300 * np.eye(2), pair))
        p = float((1 + z2 / own) ** (-(own - 1) / 2))  # Hotelling's T^2: (own - 1) / (2 own) T^2 ~ F(2, own - 1)
    return {"order": n, "amplitude": float(np.hypot(*pair)), "p": p}


def line(hz: Array, power: Array, lowest: float = 1.0) -> tuple[float, float]:
    """(frequency, height above the surroundings) of the strongest narrow peak above `lowest` Hz; (nan, 0): none."""
    around = np.array([np.median(power[max(0, i - 12) : i + 13]) for i in range(len(power))])
    height = np.where(hz >= lowest, power / np.maximum(around, 1e-300), 0.0)
    best = int(np.argmax(height))
    return (float(hz[best]), float(height[best])) if height[best] > RULES.line else (float("nan"), 0.0)


@dataclass(frozen=True, eq=False)
class Heard:
    """What the spectra of one joint show.

    Attributes:
        late: delay of the acting effort, s; orders: [{"order", "amplitude", ...}] per turn, in `unit`.
        line_hz, height: of a line of the missing force above its surroundings (NaN, 0: none); period: of control, s.
        picture: spectra, for the report.
    """

    joint: str
    late: Number
    orders: list[dict]
    unit: str
    line_hz: float
    height: float
    period: float
    picture: dict

    def details(self) -> dict:
        """For the report."""
        more = {
            "orders": [{k: t[k] for k in ("order", "amplitude")} for t in self.orders],
            "delay": {"mean": self.late.value, "low": self.late.low, "high": self.late.high}, "line_hz": self.line_hz,
        }  # fmt: skip
        return {"joint": self.joint, **self.picture, **more}


def analyse(fitter: Fitter, fit: Fit, disturbance: Disturbance | None = None) -> tuple[Heard, ...]:
    """What the spectra of effort, motion and missing force show, joint by joint.

    Simulated motion is that of the windows, put together: it starts at the measured state in each of them, so that what
    accumulates over longer times than a window does not show. The equivalent delay therefore comes from forces: effort
    plus missing force against effort.
    """
    disturbance = estimate(fitter, fit) if disturbance is None else disturbance
    windows = fitter.simulator.windows
    inputs = motion_inputs.measured(windows, fitter.simulator.physics.mj_model)
    nodes = disturbance.linear.nodes
    parts = [part for part in runs(windows) if len(part) * min(nodes, windows.steps) >= RULES.least]
    if not parts:  # windows of chaotic motion lie apart
        return ()
    theta = fitter.vector(fit.coordinates, fit.values)
    error = fitter.simulator.run(theta[None], fit.offsets[None])[0]
    without = statistics.leave_one_out(windows.group)
    found = []
    for dof, joint in enumerate(inputs.joints):
        if not fitter.used[dof] or not np.any(np.ptp(inputs.effort[..., dof], axis=1) > 0):
            continue
        found.append(_joint(joint, windows, inputs, disturbance, error, parts, dof, without))
    return tuple(found)


def _joint(
    joint: str,
    windows: Windows,
    inputs: Inputs,
    disturbance: Disturbance,
    error: Array,
    parts: list[NDArray[np.int64]],
    dof: int,
    without: Array,
) -> Heard:
    logs = [int(windows.log[part[0]]) for part in parts]
    effort = [inputs.effort[part][..., dof].ravel() for part in parts]
    # measured positions as the simulation's errors have them: after each control step
    real = [_positions(windows, part, inputs, dof) for part in parts]
    sim = [r - error[part][..., dof].ravel() for r, part in zip(real, parts, strict=True)]
    measured, simulated = spectra(effort, real, windows.dt, logs), spectra(effort, sim, windows.dt, logs)
    average = disturbance.linear.basis / disturbance.linear.basis.sum(0)
    spacing = windows.steps * windows.dt / disturbance.linear.nodes
    drive = [(inputs.effort[part][..., dof] @ average).ravel() for part in parts]
    shown = max(float(disturbance.reliability[..., dof].mean()), 0.1)
    missing = [disturbance.force[part][..., dof].ravel() / shown for part in parts]
    through = spectra(drive, [a + b for a, b in zip(drive, missing, strict=True)], spacing, logs)
    late = delay(through, top=_busy(through))
    turning = orders(disturbance, inputs, dof, without)
    peak, height = _resonance(spectra(drive, missing, spacing, logs))
    picture, unit = _picture(measured, simulated), inputs.force_unit[dof]
    return Heard(joint, late, turning, unit, peak, height, windows.dt, picture)


def _resonance(found: Spectra) -> tuple[float, float]:
    """A line of the missing force that is not one of the drive: in the ratio of their powers."""
    drive, missing, _ = found.pooled()
    peak, height = line(found.hz, missing / (drive + 1e-4 * drive.max()))
    strong = height and missing[np.argmin(np.abs(found.hz - peak))] > 0.01 * missing.max()
    return (peak, height) if strong else (float("nan"), 0.0)


def _positions(windows: Windows, part: NDArray[np.int64], inputs: Inputs, dof: int) -> Array:
    middle = inputs.position[part][..., dof].ravel()
    return np.asarray(np.unwrap(middle)) if inputs.hinge[dof] else middle


def _busy(found: Spectra) -> float:
    """Hz below which 95 % of the drive's power lies."""
    power = np.cumsum(found.pooled()[0])
    return float(found.hz[np.searchsorted(power, 0.95 * power[-1])])


def _picture(measured: Spectra, simulated: Spectra) -> dict:
    out: dict = {"hz": measured.hz.tolist()}
    for name, s in (("real", measured), ("sim", simulated)):
        out[f"coherence_{name}"] = s.coherence.tolist()
        out[f"gain_{name}"] = np.abs(s.response).tolist()
        out[f"phase_{name}_deg"] = np.degrees(np.unwrap(np.angle(s.response))).tolist()
    return out
