"""Where in the state a missing force acts: means over bins with intervals and corrected significance, small trees."""

from __future__ import annotations

from dataclasses import dataclass
from math import erfc

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.residual.disturbance import Disturbance
from bayessim_mjx.diagnosis.residual.motion_inputs import Inputs
from bayessim_mjx.diagnosis.statistics import interval

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rules:
    """How states are split into regions, and which regions are mentioned. Rules of thumb, not counted, but for `rate`.

    Attributes:
        bins: of a map; shuffles: of windows, behind its p-values.
        least: share of the best reliability, below which a node's force is not used.
        rate: of false discoveries among the significant bins (Benjamini and Hochberg, 1995).
        depth: of a tree, at most; filled: share of all nodes that every leaf holds at least.
        worth: share of the held-out power that a deeper tree has to gain.
    """

    bins: int = 8
    least: float = 0.3
    rate: float = 0.05
    shuffles: int = 300
    depth: int = 3
    filled: float = 0.05
    worth: float = 0.05


RULES = Rules()
ALONG = "force along the motion"
# axis -> (quantity, of what force): along the motion means times the direction of motion
AXES = {
    "position": ("position", "force"), "speed": ("speed", "force"), "direction": ("direction", "force"),
    "load": ("load", "force"), "effort": ("effort", "force"), "time": ("time", "force"),
    "speed size": ("speed", ALONG), "load size": ("load", ALONG), "effort size": ("effort", ALONG),
    "time since reversal": ("since_reversal", ALONG),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Nodes:
    """One joint's estimated force and the measured quantities, at the nodes of all windows.

    Attributes:
        force: `[W, m]`, N m or N; gain: `[W, m, m]`, what the estimate shows of a true force.
        axes: {axis: `[W, m]`}; units: {axis: unit}.
        joint, force_unit: for people.
    """

    force: Array
    gain: Array
    axes: dict[str, Array]
    units: dict[str, str]
    joint: str
    force_unit: str

    @property
    def reliability(self) -> Array:
        return np.asarray(self.gain.sum(2))

    @property
    def used(self) -> NDArray[np.bool_]:
        return self.reliability > RULES.least * self.reliability.max()

    def along(self) -> Array:
        """Force times direction of motion: negative is against it."""
        return self.force * np.sign(self.axes["direction"])

    def target(self, axis: str) -> Array:
        return self.along() if AXES[axis][1] == ALONG else self.force


def nodes(disturbance: Disturbance, inputs: Inputs, dof: int) -> Nodes:
    """One dof's samples."""
    basis = disturbance.linear.basis
    average = basis / basis.sum(0)
    axes, units = {}, {}
    angle, force = inputs.angle_unit[dof], inputs.force_unit[dof]
    of = {"position": angle, "speed": f"{angle}/s", "load": force, "effort": force, "time": "s", "since_reversal": "s"}
    for axis, (quantity, _) in AXES.items():
        values = inputs.of(quantity)[..., dof]
        axes[axis] = (np.abs(values) if axis.endswith("size") else values) @ average
        units[axis] = of.get(quantity, "")
    return Nodes(disturbance.force[..., dof], disturbance.gain[:, dof], axes, units, inputs.joints[dof], force)


def bins(node: Nodes, axis: str) -> tuple[Array, NDArray[np.int64]]:
    """(edges `[n + 1]`, bin of each node `[W, m]`, -1 where it is not used); about equally filled."""
    values = node.axes[axis]
    if axis == "direction":
        edges = np.array([-1.0, 0.0, 1.0])
    else:
        edges = (
            np.unique(np.quantile(values[node.used], np.linspace(0, 1, RULES.bins + 1)))
            if node.used.any()
            else np.zeros(1)
        )
    if len(edges) < 3:
        return np.zeros(0), np.full(values.shape, -1)
    index = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    return edges, np.where(node.used, index, -1)


def force_map(node: Nodes, axis: str, without: Array, rng: np.random.Generator) -> tuple[dict, Array]:
    """(numbers for a picture without `significant`, p-values per bin).

    Args:
        without: `[G, W]`, windows without each condition (`clusters.leave_one_out`).
        rng: for the permutation of windows: a bin is significant if its mean differs from that of all nodes more than
            with the axis taken from other windows.
    """
    edges, index = bins(node, axis)
    count = max(len(edges) - 1, 0)
    if not count:
        return {}, np.zeros(0)
    force, reliability = node.target(axis), node.reliability
    each = np.stack([np.where(index == b, x, 0.0).sum(1) for b in range(count) for x in (force, reliability)], 1)
    each = each.reshape(len(force), count, 2)
    total = each.sum(0)
    replicates = np.einsum("gw,wbx->bgx", without, each)
    means = total[:, 0] / np.maximum(total[:, 1], 1e-9)
    spread = [interval(m, w[:, 0] / np.maximum(w[:, 1], 1e-9)) for m, w in zip(means, replicates, strict=True)]
    low, high = (np.array(x) for x in zip(*spread, strict=True))
    found = {
        "joint": node.joint, "axis": axis, "quantity": AXES[axis][1], "unit": node.units[axis],
        "force_unit": node.force_unit, "edges": edges.tolist(), "mean": means.tolist(), "low": low.tolist(),
        "high": high.tolist(), "count": [int(np.sum(index == b)) for b in range(count)],
    }  # fmt: skip
    return found, _p_values(force, reliability, index, means, count, rng)


def _p_values(
    force: Array, reliability: Array, index: NDArray[np.int64], means: Array, count: int, rng: np.random.Generator
) -> Array:
    """Two-sided, from the mean and spread of each bin's contrast under permutation of the windows."""
    used = index >= 0
    centre = np.sum(force[used]) / max(float(np.sum(reliability[used])), 1e-9)
    left = np.where(used, force - centre * reliability, 0.0)
    null = np.zeros((RULES.shuffles, count))
    for k in range(RULES.shuffles):
        shuffled = index[rng.permutation(len(index))]
        both = used & (shuffled >= 0)
        below = np.bincount(shuffled[both], reliability[both], count)
        null[k] = np.bincount(shuffled[both], left[both], count) / np.maximum(below, 1e-9)
    z = np.abs(means - centre - null.mean(0)) / np.maximum(null.std(0, ddof=1), 1e-300)
    return np.array([erfc(x / np.sqrt(2)) for x in z])


def discoveries(p: Array, rate: float = RULES.rate) -> NDArray[np.bool_]:
    """Benjamini and Hochberg (1995): which of many hypotheses to reject."""
    order = np.argsort(p)
    passed = np.flatnonzero(p[order] <= rate * np.arange(1, len(p) + 1) / max(len(p), 1))
    out = np.zeros(len(p), bool)
    if len(passed):
        out[order[: passed.max() + 1]] = True
    return out


@dataclass(frozen=True)
class Leaf:
    """A region: [(axis, above, limit)], its mean force, nodes in it, share of the force's power that it explains."""

    where: tuple[tuple[str, bool, float], ...]
    mean: float
    count: int
    share: float


@dataclass(frozen=True)
class Tree:
    """Regions of one joint; `target`: a key of SPLITS; r2: of the force's power, on held-out groups."""

    leaves: tuple[Leaf, ...]
    target: str
    r2: float


SPLITS = {
    "force": ("position", "direction", "load", "effort", "time", "speed"),
    ALONG: ("speed size", "load size", "effort size", "time since reversal", "position", "direction", "time"),
}


def tree(node: Nodes, group: NDArray[np.int64]) -> Tree:
    """The shallowest tree, of either kind of force, that predicts the force of held-out groups about best."""
    best: tuple[float, str, int] | None = None
    for depth in range(RULES.depth + 1):
        for target in SPLITS:
            r2 = _held_out(node, target, depth, group)
            if best is None or r2 > best[0] + RULES.worth:
                best = (r2, target, depth)
    assert best is not None
    r2, target, depth = best
    y, rel, x = _table(node, target)
    power = max(float(np.sum(y**2)), 1e-300)
    leaves = []
    for where, pick in _grow(y, rel, x, np.ones(len(y), bool), depth, ()):
        mean = float(y[pick].sum() / max(rel[pick].sum(), 1e-9))
        explained = power_of(y[pick], rel[pick], mean) / power
        leaves.append(Leaf(where, mean, int(pick.sum()), explained))
    return Tree(tuple(sorted(leaves, key=lambda leaf: -leaf.share)), target, r2)


def power_of(y: Array, rel: Array, mean: float) -> float:
    """How much of sum y^2 a constant force explains."""
    return float(np.sum(y**2) - np.sum((y - rel * mean) ** 2))


def _table(node: Nodes, target: str) -> tuple[Array, Array, dict[str, Array]]:
    used = node.used
    y = (node.along() if target == ALONG else node.force)[used]
    return y, node.reliability[used], {a: node.axes[a][used] for a in SPLITS[target]}


def _grow(y: Array, rel: Array, x: dict[str, Array], pick: NDArray[np.bool_], depth: int, where: tuple) -> list:
    """[(conditions, rows)] of the leaves below the rows `pick`."""
    best = (0.0, "", 0.0)
    least = RULES.filled * len(y)
    if depth and pick.any():
        for axis, values in x.items():
            for limit in np.unique(np.quantile(values[pick], np.linspace(0.1, 0.9, 9))):
                high = pick & (values > limit)
                low = pick & ~high
                if min(high.sum(), low.sum()) < least:
                    continue
                gain = sum(y[s].sum() ** 2 / max(rel[s].sum(), 1e-9) for s in (high, low))
                if gain > best[0]:
                    best = (float(gain), axis, float(limit))
    if not best[1]:
        return [(where, pick)]
    _, axis, limit = best
    high = pick & (x[axis] > limit)
    up = _grow(y, rel, x, high, depth - 1, (*where, (axis, True, limit)))
    return up + _grow(y, rel, x, pick & ~high, depth - 1, (*where, (axis, False, limit)))


def _held_out(node: Nodes, target: str, depth: int, group: NDArray[np.int64]) -> float:
    """Share of the force's power predicted on groups that the tree has not seen."""
    y, rel, x = _table(node, target)
    of = np.repeat(group[:, None], node.force.shape[1], 1)[node.used]
    left = 0.0
    for name in np.unique(of):
        train, out = of != name, of == name
        if not train.any():
            return -np.inf
        inside = {a: v[train] for a, v in x.items()}
        for where, pick in _grow(y[train], rel[train], inside, np.ones(int(train.sum()), bool), depth, ()):
            mean = y[train][pick].sum() / max(rel[train][pick].sum(), 1e-9)
            here = out.copy()
            for axis, above, limit in where:
                here &= (x[axis] > limit) == above
            left += float(np.sum((y[here] - rel[here] * mean) ** 2))
    return 1.0 - left / max(float(np.sum(y**2)), 1e-300)
