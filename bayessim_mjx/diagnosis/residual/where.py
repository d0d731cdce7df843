"""Where the gap lies: shares by joint, the missing force over regions of the state, signatures of known causes.

Signatures are the "why" shown to people before any effect is fitted. Their regressions read  estimate = gain X beta,
with intervals by a jackknife over operating conditions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.residual import motion_inputs, regions
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance, estimate
from bayessim_mjx.diagnosis.residual.motion_inputs import Inputs
from bayessim_mjx.diagnosis.residual.regions import ALONG, MENTIONED, Leaf, Nodes, Tree
from bayessim_mjx.diagnosis.statistics import of_one

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Spot:
    """What one joint has of the gap.

    Attributes:
        joint, unit: its name, and of its force; share, ci: of the gap, with its 90 % interval.
        size: rms of the missing force; looked: whether the share is large enough for a look at regions.
        leaves: regions of the state that explain enough of the force; units: {axis: of their limits}.
        along: whether the leaves' force is that along the motion.
    """

    joint: str
    unit: str
    share: float
    ci: tuple[float, float]
    size: float
    looked: bool
    leaves: tuple[Leaf, ...]
    units: Mapping[str, str]
    along: bool


@dataclass(frozen=True, eq=False)
class Located:
    """Where a gap lies.

    Attributes:
        spots: joints, the largest share first; none where the gap is within the noise.
        maps: of the missing force, see `regions.force_map`; prints: signatures of known causes.
    """

    spots: tuple[Spot, ...] = ()
    maps: tuple[dict, ...] = ()
    prints: tuple[Fingerprint, ...] = ()


def locate(fitter: Fitter, fit: Fit, disturbance: Disturbance | None = None) -> Located:
    """Places of the gap that a fit leaves; `disturbance`: of this fit, None: estimated here."""
    if of_one(float(fit.quadratic()[0].c.mean()), fitter.size).at_noise:
        return Located()
    disturbance = estimate(fitter, fit) if disturbance is None else disturbance
    windows, model = fitter.simulator.windows, fitter.simulator.physics.mj_model
    inputs, without = motion_inputs.measured(windows, model), statistics.leave_one_out(windows.group)
    each = explained(fit, disturbance)
    kept = np.maximum(each.sum(0), 0.0)
    share, spread = kept / max(kept.sum(), 1e-300), statistics.interval_of_shares(each, windows.condition)
    node = [regions.nodes(disturbance, inputs, v) for v in range(len(share))]
    some = [v for v in np.argsort(-share) if share[v] > MENTIONED]
    trees = {v: regions.tree(node[v], windows.group) for v in some}
    prints = [f for v in some for f in fingerprints(fitter, fit, inputs, v, node[v])]
    spots = [_spot(node[v], trees.get(v), float(share[v]), spread[v]) for v in np.argsort(-share)]
    return Located(tuple(spots), tuple(_maps([node[v] for v in some], without)), tuple(prints))


def _spot(node: Nodes, found: Tree | None, share: float, ci: tuple[float, float]) -> Spot:
    size = float(np.sqrt(np.mean(node.force**2)))
    every = () if found is None or found.r2 <= MENTIONED else found.leaves
    leaves = tuple(leaf for leaf in every if leaf.share > MENTIONED)
    along = found is not None and found.target == ALONG
    return Spot(node.joint, node.force_unit, share, ci, size, found is not None, leaves, node.units, along)


def explained(fit: Fit, disturbance: Disturbance) -> Array:
    """`[W, nv]`: drop of each window's cost by the force on each joint; the sum is the drop by all of them.

    cost(0) - cost(d) = d'(2 g - S d), split by the entries of d.
    """
    q, k = disturbance.linear.quadratic, fit.A.shape[2]
    step, d = disturbance.values - fit.values, disturbance.flat
    g = q.g[:, k:] - q.S[:, k:, :k] @ step
    drop = d * (2 * g - np.einsum("wij,wj->wi", q.S[:, k:, k:], d))
    return drop.reshape(len(d), disturbance.force.shape[2], -1).sum(2) * fit.weight[:, None]


def _maps(nodes: list[Nodes], without: Array) -> list[dict]:
    """All maps of all joints; which bins are significant is decided over all of them together."""
    made = [regions.force_map(node, axis, without) for node in nodes for axis in regions.AXES]
    made = [(m, p) for m, p in made if m]
    found = iter(regions.discoveries(np.concatenate([np.zeros(0), *(p for _, p in made)])).tolist())
    return [m | {"significant": [next(found) for _ in p]} for m, p in made]


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
    """One signature at one joint.

    Attributes:
        numbers: its coefficients; weight: share of the force's power that each one carries.
        recent: s after a reversal that count as shortly after it.
    """

    name: str
    joint: str
    numbers: dict[str, Number]
    weight: dict[str, float]
    recent: float

    @property
    def relevant(self) -> dict[str, Number]:
        """The numbers that matter: clear, and not small."""
        return {k: n for k, n in self.numbers.items() if n.clear and self.weight[k] > MENTIONED}


def regress(y: Array, X: Array, gain: Array, without: Array) -> tuple[Array, Array, Array]:
    """Least squares of an estimated force on columns of a true one.

    Args:
        y: `[W, m]`; X: `[W, m, k]`; gain: `[W, m, m]`; without: `[G, W]`, windows without each condition.

    Returns:
        (beta `[k]`, replicates `[G, k]`, squares `[W]` that are left).
    """
    rows = gain @ X
    scale = np.sqrt(np.mean(rows**2, axis=(0, 1))) + 1e-300
    rows = rows / scale
    S, g = rows.mT @ rows, statistics.times(rows.mT, y)
    ridge = np.finfo(np.float32).eps * np.eye(X.shape[2]) * y.size  # against columns that are alike
    beta = np.linalg.solve(S.sum(0) + ridge, g.sum(0))
    left = np.sum((y - rows @ beta) ** 2, 1)
    some = np.linalg.solve(np.tensordot(without, S, 1) + ridge, (without @ g)[..., None])[..., 0]
    return beta / scale, some / scale, left


def fingerprints(fitter: Fitter, fit: Fit, inputs: Inputs, dof: int, node: Nodes) -> list[Fingerprint]:
    """F1 odd and even in speed, F2 load, F8 time, F10 time since reversal, F3 lag and speed of the motion itself."""
    without = statistics.leave_one_out(fitter.simulator.windows.group)
    w, unit, angle = node.axes["speed"], node.force_unit, inputs.angle_unit[dof]
    s, one = np.sign(node.axes["direction"]), np.ones_like(w)
    load, since = np.abs(node.axes["load"]), node.axes["time since reversal"]
    late, recent = node.axes["time"] - node.axes["time"].mean(), float(node.limits("time since reversal")[0])
    slope, square = f"{unit}/({angle}/s)", f"{unit}/({angle}/s)^2"
    odd = {"offset": (one, unit), "constant": (-s, unit), "linear": (-w, slope), "quadratic": (-w * np.abs(w), square)}
    drift = {"constant": (-s, unit), "friction": (-s * late, f"{unit}/s"), "level": (one, unit)}
    heavy = {"constant": (-s, unit), "linear": (-w, slope)}
    terms = {
        "odd and even in speed": odd | {"even": (-np.abs(w), slope)},
        "load": heavy | {"load": (-s * (load - load.mean()), f"{unit} per {unit}")},
        "time": drift | {"drift": (late, f"{unit}/s")},
        "time since reversal": {"constant": (-s, unit), "recent": (-s * (since < recent), unit)},
    }

    def printed(name: str, own: Mapping[str, tuple[Array, str]], y: Array, gain: Array) -> Fingerprint:
        X = np.stack([column for column, _ in own.values()], 2)
        beta, replicates, _ = regress(y, X, gain, without)
        rows = zip(own.items(), beta, replicates.T, strict=True)
        numbers = {k: Number(float(b), *statistics.interval(float(b), r), u) for (k, (_, u)), b, r in rows}
        weight = np.mean((X * beta) ** 2, axis=(0, 1)) / max(float(np.mean(y**2)), 1e-300)
        return Fingerprint(name, node.joint, numbers, dict(zip(own, map(float, weight), strict=True)), recent)

    out = [printed(name, own, node.force, node.gain) for name, own in terms.items()]
    if not fitter.used[dof]:
        return out  # no measured position that could lag
    cut, channel = fitter.simulator.windows, int(fitter.used[:dof].sum())
    behind = -fit.r.reshape(len(fit.r), cut.steps, -1)[..., channel] * cut.sigma_q[dof]
    nodes = node.force.shape[1]
    average = np.stack([part.mean(1) for part in np.array_split(behind, nodes, axis=1)], 1)
    even = np.broadcast_to(np.eye(nodes), node.gain.shape)
    return [*out, printed("lag", {"constant": (s, angle), "lag": (w, "s")}, average, even)]
