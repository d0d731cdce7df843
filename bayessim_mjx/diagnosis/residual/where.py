"""Where the gap lies: shares by joint, the missing force over regions of the state, signatures of known causes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.gap import of_one
from bayessim_mjx.diagnosis.residual import motion_inputs, regions
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance, estimate
from bayessim_mjx.diagnosis.residual.fingerprints import Fingerprint, fingerprints
from bayessim_mjx.diagnosis.residual.regions import ALONG, Leaf, Nodes, Tree

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rules:
    """When a place is worth telling."""

    worth: float = 0.1  # share of the gap that makes a joint worth a sentence
    told: float = 0.15  # share of a joint's missing power that a region must explain to be told


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
    leaves = _told(found) if found is not None else ()
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


def _told(found: Tree) -> tuple[Leaf, ...]:
    return tuple([leaf for leaf in found.leaves if leaf.share > RULES.told and found.r2 > RULES.told][:3])
