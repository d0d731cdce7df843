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
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance, estimate, step_of_starts
from bayessim_mjx.diagnosis.residual.motion_inputs import Inputs
from bayessim_mjx.diagnosis.residual.regions import ALONG, Leaf, Nodes, Tree
from bayessim_mjx.diagnosis.statistics import interval, of_one

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rules:
    """When a place is mentioned. Rules of thumb, not counted.

    Attributes:
        worth: share of the gap from which on a joint has a sentence.
        least_share: share of a joint's missing power that a region has to explain.
    """

    worth: float = 0.1
    least_share: float = 0.15


RULES = Rules()


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


def locate(fitter: Fitter, fit: Fit, disturbance: Disturbance | None = None, *, seed: int = 0) -> Located:
    """Places of the gap that a fit leaves; `disturbance`: of this fit, None: estimated here."""
    if of_one(float(fit.quadratic(fitter.spread)[0].c.mean()), fitter.size).at_noise:
        return Located()
    disturbance = estimate(fitter, fit) if disturbance is None else disturbance
    windows, model = fitter.simulator.windows, fitter.simulator.physics.mj_model
    inputs = motion_inputs.measured(windows, model)
    rng = np.random.default_rng(seed)
    without = statistics.leave_one_out(windows.group)
    each = explained(fit, disturbance)
    kept = np.maximum(each.sum(0), 0.0)
    share, spread = kept / max(kept.sum(), 1e-300), statistics.interval_of_shares(each, windows.condition)
    node = [regions.nodes(disturbance, inputs, v) for v in range(len(share))]
    worth = [v for v in np.argsort(-share) if share[v] > RULES.worth]
    maps = _maps([node[v] for v in worth], without, rng)
    trees = {v: regions.tree(node[v], windows.group) for v in worth}
    prints = [f for v in worth for f in fingerprints(fitter, fit, disturbance, inputs, v, node[v], without)]
    spots = [_spot(node[v], trees.get(v), float(share[v]), spread[v]) for v in np.argsort(-share)]
    return Located(tuple(spots), tuple(maps), tuple(prints))


def _spot(node: Nodes, found: Tree | None, share: float, ci: tuple[float, float]) -> Spot:
    size = float(np.sqrt(np.mean(node.force[node.used] ** 2))) if node.used.any() else 0.0
    every = () if found is None or found.r2 <= RULES.least_share else found.leaves
    leaves = tuple([leaf for leaf in every if leaf.share > RULES.least_share][:3])
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


def _maps(nodes: list[Nodes], without: Array, rng: np.random.Generator) -> list[dict]:
    """All maps of all joints; which bins are significant is decided over all of them together."""
    made = [regions.force_map(node, axis, without, rng) for node in nodes for axis in regions.AXES]
    made = [(m, p) for m, p in made if m]
    if not made:
        return []
    found = regions.discoveries(np.concatenate([p for _, p in made]))
    ends = np.cumsum([len(p) for _, p in made])
    parts = np.split(found, ends[:-1])
    return [m | {"significant": part.tolist()} for (m, _), part in zip(made, parts, strict=True)]


@dataclass(frozen=True)
class Limits:
    """Which parts of a signature are mentioned. Rules of thumb, not counted.

    Attributes:
        recent: s after a reversal, in which a force counts as recent.
        small: share of the force's rms, below which a part is not mentioned.
    """

    recent: float = 0.1
    small: float = 0.2


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
    def relevant(self) -> dict[str, Number]:
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
