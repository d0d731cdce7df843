"""Frequency: command to motion, measured and simulated; equivalent delay; orders in the angle; resonance lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal, stats

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.windows import Windows
from bayessim_mjx.diagnosis.residual import motion_inputs
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance, estimate
from bayessim_mjx.diagnosis.residual.motion_inputs import Inputs
from bayessim_mjx.diagnosis.residual.regions import FALSE, MENTIONED, discoveries
from bayessim_mjx.diagnosis.residual.where import Number, regress
from bayessim_mjx.diagnosis.selection.numbers import EFFORT

Array = NDArray[np.float64]


# Half bandwidth of a spectrum's tapers, in frequency steps (Thomson, Proc. IEEE 70, 1982): wide enough to smear what
# the ends of windows leave in an estimated force at multiples of their rate
BANDWIDTH = 2.5
TAPERS = int(2 * BANDWIDTH) - 1  # that leak little


@dataclass(frozen=True, eq=False)
class Spectra:
    """Multitaper spectra of segments, `[segments, F]`: of x, of y, cross (conj(x) y).

    Attributes:
        hz: `[F]`; log: of each segment; square: `[segments]`, of y, as the sum of its spectrum is where nothing
            is taken off.
    """

    hz: Array
    xx: Array
    yy: Array
    xy: NDArray[np.complex128]
    log: NDArray[np.int64]
    square: Array

    def pooled(self, weight: Array | None = None) -> tuple[Array, Array, NDArray[np.complex128]]:
        """Sum over segments with weights."""
        w = np.ones(len(self.xx)) if weight is None else weight
        return w @ self.xx, w @ self.yy, w @ self.xy

    @property
    def coherence(self) -> Array:
        """`[F]`, from 0 to 1."""
        xx, yy, xy = self.pooled()
        return np.abs(xy) ** 2 / np.maximum(xx * yy, 1e-300)

    @property
    def response(self) -> NDArray[np.complex128]:
        """`[F]`, y over x."""
        xx, _, xy = self.pooled()
        return xy / np.maximum(xx, 1e-300)


def spectra(x: Sequence[Array], y: Sequence[Array], dt: float, log: Sequence[int] | None = None) -> Spectra:
    """Of pairs of series of any lengths, in segments of scipy's length, or of the shortest, that overlap by half."""
    size = min(256, *(len(a) for a in x))  # `scipy.signal.welch`
    tapers = signal.windows.dpss(size, BANDWIDTH, TAPERS)
    rows: list[tuple[Any, ...]] = []
    owner = []
    for i, (a, b) in enumerate(zip(x, y, strict=True)):
        for start in range(0, len(a) - size + 1, max(size // 2, 1)):
            own = [series[start : start + size] for series in (a, b)]
            fa, fb = (np.fft.rfft(tapers * signal.detrend(series))[:, 1:] for series in own)
            both = [np.mean(np.conj(u) * v, 0) for u, v in ((fa, fa), (fb, fb), (fa, fb))]
            rows.append((*both, size / 2 * np.mean(own[1] ** 2)))
            owner.append(i if log is None else log[i])
    xx, yy, xy, square = (np.array(of) for of in zip(*rows, strict=True))
    hz = np.asarray(np.fft.rfftfreq(size, dt)[1:], np.float64)
    return Spectra(hz, xx.real, yy.real, xy, np.array(owner), square)


def delay(found: Spectra) -> Number:
    """Equivalent delay T of y behind x [s]: the cross spectrum's phase is -omega T, about.

    The most likely one, with weights C / (1 - C) of coherences C (Knapp and Carter, IEEE Trans. ASSP 24, 1976), at the
    lower frequencies that have almost all of the power of x: Newton's steps from T = 0.
    """
    omega, coherence, power = 2 * np.pi * found.hz, found.coherence, np.cumsum(found.pooled()[0])
    weight = coherence / np.maximum(1 - coherence, 1 / (TAPERS * len(found.xx)))  # is known no better
    weight = np.where(power <= (1 - FALSE) * power[-1], weight, 0.0)

    def best(total: NDArray[np.complex128]) -> float:
        late, unit = 0.0, weight * total / np.maximum(np.abs(total), 1e-300)
        for _ in range(EFFORT.rounds):
            turned = unit * np.exp(1j * omega * late)
            late -= float(np.sum(omega * turned.imag) / max(float(np.sum(omega**2 * np.abs(turned.real))), 1e-300))
        return late

    whole = best(found.pooled()[2])
    replicates = np.array([best(found.pooled(w)[2]) for w in statistics.leave_one_out(found.log)])
    return Number(whole, *statistics.interval(whole, replicates), "s")


def runs(windows: Windows) -> list[NDArray[np.int64]]:
    """Windows that follow each other without a gap, in order."""
    order = np.lexsort((windows.start, windows.log))
    log, start = windows.log[order], windows.start[order]
    gaps = (np.diff(log) != 0) | (np.diff(start) != windows.steps)
    return [np.asarray(part) for part in np.split(order, np.flatnonzero(gaps) + 1)]


def orders(disturbance: Disturbance, inputs: Inputs, dof: int, without: Array) -> list[dict]:
    """[{"order", "amplitude", "p"}]: forces periodic in the angle of a hinge, significant ones.

    Amplitudes by least squares beside friction, load and offset, with the averaging between nodes taken into account.
    A period is within the range of motion, and lasts two nodes at least at a usual speed. A short range smears an order
    over its neighbours: of these the largest counts.
    """
    q, average = inputs.position[..., dof], disturbance.linear.average
    if not inputs.hinge[dof] or np.ptp(q) <= 0:
        return []
    spacing = disturbance.time[-1] / (len(disturbance.time) - 0.5)
    pace = float(np.median(np.abs(inputs.speed[..., dof])))
    tried = np.arange(int(np.ceil(2 * np.pi / np.ptp(q))), int(np.pi / (pace * spacing)) + 1 if pace else 0)
    if not len(tried):
        return []
    y, gain = disturbance.force[..., dof], disturbance.gain[:, dof]
    w, s, load = (inputs.of(k)[..., dof] @ average for k in ("speed", "direction", "load"))
    flat = [np.ones_like(w), s, w, w * np.abs(w), load, q @ average]
    before = float(regress(y, np.stack(flat, 2), gain, without)[2].sum())
    found = []
    for n in tried.tolist():
        X = np.stack([*flat, np.cos(n * q) @ average, np.sin(n * q) @ average], 2)
        beta, replicates, left = regress(y, X, gain, without)
        share = 1 - float(left.sum()) / max(before, 1e-300)
        p = _of_pair(beta[-2:], replicates[:, -2:])
        found.append({"order": n, "amplitude": float(np.hypot(*beta[-2:])), "p": p, "share": share})
    strong, shares = discoveries(np.array([f["p"] for f in found])), np.array([f["share"] for f in found])
    peak = np.isin(np.arange(len(found)), signal.argrelmax(shares)[0])
    return [f for f, told in zip(found, strong & peak & (shares > MENTIONED), strict=True) if told]


def _of_pair(pair: Array, replicates: Array) -> float:
    """p-value of two coefficients that are 0, by Hotelling's T^2; 1 where there are fewer than three conditions.

    (own - 1) / (2 own) T^2 ~ F(2, own - 1) for own + 1 conditions.
    """
    own = len(replicates) - 1
    if own < 2:
        return 1.0
    z2 = float(pair @ np.linalg.solve(statistics.covariance(replicates) + 1e-300 * np.eye(2), pair))
    return float((1 + z2 / own) ** (-(own - 1) / 2))


def line(found: Spectra) -> tuple[float, float]:
    """(frequency, height above the surroundings) of the largest narrow peak of y that x does not have; (nan, 0): none.

    Surroundings are the median of as many values on either side as the root of their number. Logs are what is
    independent: motion has its lines elsewhere in each, and the largest of the mean heights has to be significant over
    them. The peak has its part of the power of y.
    """
    logs = found.log == np.unique(found.log)[:, None]
    x, y = logs @ found.xx, logs @ found.yy
    side, inner = int(np.sqrt(len(found.hz))), len(found.hz) - 2 * int(np.sqrt(len(found.hz)))
    if len(logs) < 2 or inner < 1:
        return float("nan"), 0.0
    around = [np.median(np.lib.stride_tricks.sliding_window_view(s, 2 * side + 1, 1), axis=2) for s in (x, y)]
    over = [np.log(s[:, side:-side] / a) for s, a in zip((x, y), around, strict=True)]
    each = over[1] - np.maximum(over[0], 0.0)
    best = int(np.argmax(each.mean(0)))
    likely = inner * stats.ttest_1samp(each[:, best], 0.0, alternative="greater").pvalue
    near = np.abs(np.arange(inner) - best) <= BANDWIDTH
    share = float(np.sum((y[:, side:-side] - around[1])[:, near]) / found.square.sum())
    clear = likely < FALSE and share > MENTIONED
    return (float(found.hz[side + best]), float(np.exp(each[:, best].mean()))) if clear else (float("nan"), 0.0)


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
    """Return the findings in the spectra of effort, motion and missing force, joint by joint.

    Simulated motion is that of the windows, put together: it starts at the measured state in each of them, so that what
    accumulates over longer times than a window does not show. The equivalent delay therefore comes from forces: effort
    plus missing force against effort.
    """
    disturbance = estimate(fitter, fit) if disturbance is None else disturbance
    windows = fitter.simulator.windows
    inputs = motion_inputs.measured(windows, fitter.simulator.physics.mj_model)
    parts = [part for part in runs(windows) if len(part) > 1]
    if not parts:  # windows of chaotic motion lie apart
        return ()
    driven = [fitter.used[v] and np.any(np.ptp(inputs.effort[..., v], axis=1) > 0) for v in range(len(inputs.joints))]
    return tuple(_joint(fitter, fit, inputs, disturbance, parts, int(dof)) for dof in np.flatnonzero(driven))


def _joint(
    fitter: Fitter, fit: Fit, inputs: Inputs, disturbance: Disturbance, parts: list[NDArray[np.int64]], dof: int
) -> Heard:
    windows, average = fitter.simulator.windows, disturbance.linear.average
    logs = [int(windows.log[part[0]]) for part in parts]
    effort, position = inputs.effort[..., dof], inputs.position[..., dof]
    channel = int(fitter.used[:dof].sum())
    error = fit.r.reshape(len(fit.r), windows.steps, -1)[..., channel] * windows.sigma_q[dof]
    # measured positions as the simulation's errors have them: after each control step
    real = [np.unwrap(position[part].ravel()) if inputs.hinge[dof] else position[part].ravel() for part in parts]
    sim = [r - error[part].ravel() for r, part in zip(real, parts, strict=True)]
    sent = [effort[part].ravel() for part in parts]
    picture = _picture(spectra(sent, real, windows.dt, logs), spectra(sent, sim, windows.dt, logs))
    spacing = windows.steps * windows.dt / disturbance.linear.nodes
    shown = disturbance.reliability[..., dof].mean(0)  # at the ends of windows less of the force is seen
    drive = [(effort[part] @ average).ravel() for part in parts]
    missing = [(disturbance.force[part][..., dof] / shown).ravel() for part in parts]
    late = delay(spectra(drive, [a + b for a, b in zip(drive, missing, strict=True)], spacing, logs))
    turning = orders(disturbance, inputs, dof, statistics.leave_one_out(windows.group))
    peak, height = line(spectra(drive, missing, spacing, logs))
    return Heard(inputs.joints[dof], late, turning, inputs.force_unit[dof], peak, height, windows.dt, picture)


def _picture(measured: Spectra, simulated: Spectra) -> dict:
    out: dict = {"hz": measured.hz.tolist()}
    for name, s in (("real", measured), ("sim", simulated)):
        out[f"coherence_{name}"] = s.coherence.tolist()
        out[f"gain_{name}"] = np.abs(s.response).tolist()
        out[f"phase_{name}_deg"] = np.degrees(np.unwrap(np.angle(s.response))).tolist()
    return out
