"""Signatures of known causes in the estimated force: the "why" shown to people before any effect is fitted.

All regressions read  estimate = gain X beta,  with intervals by a jackknife over operating conditions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance, step_of_starts
from bayessim_mjx.diagnosis.residual.motion_inputs import Inputs
from bayessim_mjx.diagnosis.residual.regions import Nodes
from bayessim_mjx.diagnosis.statistics import interval

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """What counts as just now, and as small."""

    recent: float = 0.1  # s after a reversal
    small: float = 0.2  # of the force's rms: contributions below are not mentioned


LIMITS = Limits()


@dataclass(frozen=True)
class Number:
    """One coefficient with its 90 % interval."""

    value: float
    low: float
    high: float
    unit: str

    @property
    def clear(self) -> bool:
        """Zero lies outside of the interval."""
        return self.low > 0 or self.high < 0


@dataclass(frozen=True)
class Fingerprint:
    """One signature at one joint: its numbers, and the share of the force's rms that each one carries."""

    name: str
    joint: str
    numbers: dict[str, Number]
    weight: dict[str, float]

    @property
    def told(self) -> dict[str, Number]:
        """The numbers that matter: clear, and not small."""
        return {k: n for k, n in self.numbers.items() if n.clear and self.weight[k] > LIMITS.small}


def regress(y: Array, X: Array, gain: Array, without: Array) -> tuple[Array, Array, Array]:
    """(beta `[k]`, replicates `[G, k]`, rms of terms `[k]`): y `[W, m]`, X `[W, m, k]`, gain `[W, m, m]`.

    `without`: `[G, W]`, windows without each condition (`clusters.leave_one_out`).
    """
    rows = gain @ X
    scale = np.sqrt(np.mean(rows**2, axis=(0, 1))) + 1e-300
    rows = rows / scale
    S, g = np.einsum("wmi,wmj->wij", rows, rows), np.einsum("wmi,wm->wi", rows, y)
    ridge = 1e-6 * np.eye(X.shape[2]) * rows[..., 0].size
    beta = np.linalg.solve(S.sum(0) + ridge, g.sum(0)) / scale
    replicates = (
        np.linalg.solve(np.tensordot(without, S, 1) + ridge, np.tensordot(without, g, 1)[..., None])[..., 0] / scale
    )
    term = np.sqrt(np.mean((X * beta) ** 2, axis=(0, 1)))
    return beta, replicates, term


def _fingerprint(
    name: str,
    node: Nodes,
    y: Array,
    terms: dict[str, tuple[Array, str]],
    without: Array,
) -> Fingerprint:
    """terms: {name: (column `[W, m]`, unit)}."""
    X = np.stack([column for column, _ in terms.values()], 2)
    used = node.used
    beta, replicates, rms = regress(np.where(used, y, 0.0), X, used[..., None] * node.gain, without)
    numbers = {
        key: Number(float(b), *interval(float(b), s), unit)
        for (key, (_, unit)), b, s in zip(terms.items(), beta, replicates.T, strict=True)
    }
    size = max(float(np.sqrt(np.mean(y[node.used] ** 2))) if node.used.any() else 0.0, 1e-300)
    weight = {key: float(r) / size for key, r in zip(terms, rms, strict=True)}
    return Fingerprint(name, node.joint, numbers, weight)


def fingerprints(
    fitter: Fitter, fit: Fit, disturbance: Disturbance, inputs: Inputs, dof: int, node: Nodes, without: Array
) -> list[Fingerprint]:
    """F1 odd and even in speed, F2 load, F3 lag and speed, F8 time, F10 time since reversal."""
    w, unit = node.axes["speed"], node.force_unit
    rate = inputs.angle_unit[dof] + "/s"
    s, one = np.sign(node.axes["direction"]), np.ones_like(w)
    load = np.abs(node.axes["load"])
    late = node.axes["time"] - node.axes["time"].mean()
    recent = np.exp(-node.axes["time since reversal"] / LIMITS.recent)
    y = node.force
    slope, square = f"{unit}/({rate})", f"{unit}/({rate})^2"
    odd = {"offset": (one, unit), "constant": (-s, unit), "linear": (-w, slope), "quadratic": (-w * np.abs(w), square)}
    drift = {"constant": (-s, unit), "friction": (-s * late, f"{unit}/s"), "level": (one, unit)}
    heavy = {"constant": (-s, unit), "linear": (-w, slope)}
    terms = {
        "odd and even in speed": odd | {"even": (-np.abs(w), slope)},
        "load": heavy | {"load": (-s * (load - load.mean()), f"{unit} per {unit}")},
        "time": drift | {"drift": (late, f"{unit}/s")},
        "time since reversal": {"constant": (-s, unit), "recent": (-s * recent, unit)},
    }
    out = [_fingerprint(name, node, y, own, without) for name, own in terms.items()]
    if not fitter.used[dof]:
        return out  # no measured position that could lag
    return [*out, _lag(fitter, fit, disturbance, inputs, dof, node, without)]


def _lag(
    fitter: Fitter, fit: Fit, disturbance: Disturbance, inputs: Inputs, dof: int, node: Nodes, without: Array
) -> Fingerprint:
    """|error| = c + T |speed|: how far the measured motion lags behind the simulated one (F3)."""
    linear, own = disturbance.linear, int(fitter.used[:dof].sum())  # its place among the measured channels
    step = disturbance.values - fit.values
    dx = step_of_starts(linear, fit, step, np.zeros_like(disturbance.flat))
    r = linear.r - np.einsum("wns,ws->wn", fit.B, dx) - fit.A @ step
    windows = fitter.simulator.windows
    channels = r.reshape(len(r), windows.steps, -1)
    behind = -channels[..., own] * windows.sigma_q[dof]
    average = linear.basis / linear.basis.sum(0)
    one = np.broadcast_to(np.eye(average.shape[1]), node.gain.shape)
    whole = Nodes(behind @ average, one, node.axes, node.units, node.joint, node.force_unit)
    angle = inputs.angle_unit[dof]
    s, w = np.sign(node.axes["direction"]), node.axes["speed"]
    return _fingerprint("lag", whole, whole.force, {"constant": (s, angle), "lag": (w, "s")}, without)
