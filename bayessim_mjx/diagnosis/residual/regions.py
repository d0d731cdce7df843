"""Where in the state a missing force acts: means over bins with intervals and corrected significance, small trees.

Conditions are what is independent (`statistics`): they make intervals and p-values, and a tree has to predict the force
in conditions that it has not seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance, pooled
from bayessim_mjx.diagnosis.residual.motion_inputs import Inputs
from bayessim_mjx.diagnosis.selection.numbers import ODDS

Array = NDArray[np.float64]

# Share of the squared gap, or of a force's power, from which on a part of it is mentioned, and decides a verdict
# (docs/decisions/force_left.md)
MENTIONED = 0.1
FALSE = 1 / ODDS.strong  # rate of false discoveries
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
        """`[W, m]`, how much of a constant force the estimate shows."""
        return np.asarray(self.gain.sum(2))

    def target(self, kind: str) -> Array:
        """`[W, m]`, the force, or the force times the direction of motion: negative is against it."""
        return self.force * np.sign(self.axes["direction"]) if kind == ALONG else self.force

    def limits(self, axis: str, some: NDArray[np.bool_] | None = None) -> Array:
        """Inner edges of about equally filled bins of some nodes; as many bins as windows need by Rice's rule.

        Rice's rule is twice the cube root of their number (Terrell and Scott, 1985).
        """
        if axis == "direction":
            return np.zeros(1)
        values = self.axes[axis] if some is None else self.axes[axis][some]
        count = int(np.ceil(2 * np.cbrt(len(self.force))))
        return np.unique(np.quantile(values, np.arange(1, count) / count))


def nodes(disturbance: Disturbance, inputs: Inputs, dof: int) -> Nodes:
    """One dof's force and quantities."""
    axes, units = {}, {}
    angle, force = inputs.angle_unit[dof], inputs.force_unit[dof]
    of = {"position": angle, "speed": f"{angle}/s", "load": force, "effort": force, "time": "s", "since_reversal": "s"}
    for axis, (quantity, _) in AXES.items():
        values = inputs.of(quantity)[..., dof]
        axes[axis] = (np.abs(values) if axis.endswith("size") else values) @ disturbance.linear.average
        units[axis] = of.get(quantity, "")
    return Nodes(disturbance.force[..., dof], disturbance.gain[:, dof], axes, units, inputs.joints[dof], force)


def force_map(node: Nodes, axis: str, without: Array) -> tuple[dict, Array]:
    """Mean forces over the bins of an axis.

    Args:
        without: `[G, W]`, windows without each condition (`statistics.leave_one_out`).

    Returns:
        (numbers for a picture without `significant`, p-values `[bins]` of a mean that is that of all nodes); nothing of
        an axis that does not change.
    """
    values, force, reliability = node.axes[axis], node.target(AXES[axis][1]), node.reliability
    inner, ends = node.limits(axis), (float(values.min()), float(values.max()))
    inner = inner[(inner > ends[0]) & (inner < ends[1])]
    if not len(inner):
        return {}, np.zeros(0)
    index, count = np.searchsorted(inner, values, side="right"), len(inner) + 1
    inside = index[..., None] == np.arange(count)
    sums, shown = (np.einsum("wm,wmb->wb", x, inside) for x in (force, reliability))
    means, replicates = pooled(sums, shown, 0), pooled(without @ sums, without @ shown, ())
    whole = pooled(without @ sums, without @ shown, 1)[:, None]
    spread = [statistics.interval(m, r) for m, r in zip(means, replicates.T, strict=True)]
    low, high = (list(x) for x in zip(*spread, strict=True))
    found = {
        "joint": node.joint, "axis": axis, "quantity": AXES[axis][1], "unit": node.units[axis],
        "force_unit": node.force_unit, "edges": [ends[0], *inner.tolist(), ends[1]], "mean": means.tolist(),
        "low": low, "high": high, "count": inside.sum((0, 1)).tolist(),
    }  # fmt: skip
    return found, _p_values(means - pooled(sums, shown), replicates - whole)


def _p_values(value: Array, replicates: Array) -> Array:
    """Two-sided, of estimates `[k]` by replicates `[G, k]`, each without one condition; 1 of few conditions."""
    if len(replicates) < 2:
        return np.ones(len(value))
    error = np.maximum(statistics.error(replicates), np.finfo(np.float64).tiny)
    return np.asarray(2 * stats.t.sf(np.abs(value) / error, len(replicates) - 1))


def discoveries(p: Array) -> NDArray[np.bool_]:
    """Which of many hypotheses to reject (Benjamini and Hochberg, 1995)."""
    return np.asarray(stats.false_discovery_control(p) <= FALSE) if len(p) else np.zeros(0, bool)


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
    """Return the tree, of either kind of force, that predicts the force of held-out groups.

    The shallowest one that says as much; the search ends where neither one nor two more levels say more.
    """
    r2, target, at, depth = -np.inf, "", 0, 0
    while depth <= at + 1:
        found, kind = max((_held_out(node, target, depth, group), target) for target in SPLITS)
        if not depth or found > r2 + MENTIONED:
            r2, target, at = found, kind, depth
        depth += 1
    y, rel = node.target(target), node.reliability
    leaves = []
    for where in _grown(node, target, np.ones(y.shape, bool), at, ()):
        pick = _inside(node, where)
        mean = float(pooled(y[pick], rel[pick]))
        explained = float(np.sum(y[pick] ** 2 - (y[pick] - rel[pick] * mean) ** 2))
        leaves.append(Leaf(where, mean, int(pick.sum()), explained / max(float(np.sum(y**2)), 1e-300)))
    return Tree(tuple(sorted(leaves, key=lambda leaf: -leaf.share)), target, r2)


Where = tuple[tuple[str, bool, float], ...]


def _inside(node: Nodes, where: Where) -> NDArray[np.bool_]:
    pick = np.ones(node.force.shape, bool)
    for axis, above, limit in where:
        pick &= (node.axes[axis] > limit) == above
    return pick


def _grown(node: Nodes, target: str, some: NDArray[np.bool_], depth: int, where: Where) -> list[Where]:
    """Leaves below `where`, each split as explains most of the force at the nodes `some`."""
    y, rel, best = node.target(target), node.reliability, (0.0, "", 0.0)
    for axis in SPLITS[target] if depth and some.any() else ():
        values = node.axes[axis]
        for limit in node.limits(axis, some):
            both = some & (values > limit), some & (values <= limit)
            if all(side.any() for side in both):
                gain = float(sum(y[side].sum() * pooled(y[side], rel[side]) for side in both))
                best = max(best, (gain, axis, float(limit)))
    if not best[1]:
        return [where]
    _, axis, limit = best
    sides = [(above, some & ((node.axes[axis] > limit) == above)) for above in (True, False)]
    parts = [_grown(node, target, side, depth - 1, (*where, (axis, above, limit))) for above, side in sides]
    return [leaf for part in parts for leaf in part]


def _held_out(node: Nodes, target: str, depth: int, group: NDArray[np.int64]) -> float:
    """Share of the force's power predicted on groups that the tree has not seen."""
    y, rel, names = node.target(target), node.reliability, np.unique(group)
    left = 0.0
    for name in names if len(names) > 1 else ():
        out = np.broadcast_to((group == name)[:, None], y.shape)
        for where in _grown(node, target, ~out, depth, ()):
            here = _inside(node, where)
            mean = pooled(y[here & ~out], rel[here & ~out])
            left += float(np.sum((y[here & out] - rel[here & out] * mean) ** 2))
    return 1.0 - left / max(float(np.sum(y**2)), 1e-300) if len(names) > 1 else -np.inf
