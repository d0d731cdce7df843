"""Where the gap lies: shares by joint, the missing force over regions of the state, one sentence per finding."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.residual import motion_inputs, regions
from bayessim_mjx.diagnosis.residual.disturbance import Disturbance, estimate
from bayessim_mjx.diagnosis.residual.fingerprints import fingerprints
from bayessim_mjx.diagnosis.residual.regions import ALONG, Leaf, Nodes, Tree
from bayessim_mjx.diagnosis.result import Place

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rules:
    """When a place is worth telling."""

    quiet: float = 1.1  # squared residual per sample that counts as noise alone
    worth: float = 0.1  # share of the gap that makes a joint worth a sentence
    told: float = 0.15  # share of a joint's missing power that a region must explain to be told


RULES = Rules()


def locate(
    fitter: Fitter, fit: Fit, disturbance: Disturbance | None = None, *, seed: int = 0
) -> tuple[list[Place], list[dict], list[str]]:
    """Places of the gap that a fit leaves.

    Args:
        disturbance: of this fit; None: estimated here.

    Returns:
        (places, largest share first; maps of the missing force, see `regions.force_map`; sentences).
    """
    if float(fit.quadratic(fitter.spread)[0].c.mean()) < RULES.quiet * fitter.size:
        return [], [], ["what this model leaves lies within the measurement noise"]
    disturbance = estimate(fitter, fit) if disturbance is None else disturbance
    windows, model = fitter.simulator.windows, fitter.simulator.physics.mj_model
    inputs = motion_inputs.measured(windows, model)
    rng = np.random.default_rng(seed)
    without = statistics.leave_one_out(windows.group)
    each = explained(fit, disturbance)
    kept = np.maximum(each.sum(0), 0.0)
    share, spread = kept / max(kept.sum(), 1e-300), statistics.interval_of_shares(each, windows.group)
    node = [regions.nodes(disturbance, inputs, v) for v in range(len(share))]
    worth = [v for v in np.argsort(-share) if share[v] > RULES.worth]
    maps = _maps([node[v] for v in worth], without, rng)
    trees = {v: regions.tree(node[v], windows.group) for v in worth}
    sentences = [s for v in worth for s in _sentences(node[v], trees[v])]
    prints = [f for v in worth for f in fingerprints(fitter, fit, disturbance, inputs, v, node[v], without)]
    sentences += [f.text for f in prints if f.text]
    places = [
        Place(node[v].joint, float(share[v]), spread[v], _region(node[v], trees.get(v))) for v in np.argsort(-share)
    ]
    return places, maps, sentences


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


def _told(found: Tree) -> list[Leaf]:
    return [leaf for leaf in found.leaves if leaf.share > RULES.told and found.r2 > RULES.told][:3]


def _sentences(node: Nodes, found: Tree) -> list[str]:
    told = _told(found)
    if not told:
        size = float(np.sqrt(np.mean(node.force[node.used] ** 2))) if node.used.any() else 0.0
        return [
            f"{node.joint}: a missing force of {size:.2g} {node.force_unit} rms without a simple place in the state"
        ]
    return [f"{node.joint}, {in_words(leaf, node)}: {_force(leaf, node, found.target)}" for leaf in told]


def _force(leaf: Leaf, node: Nodes, target: str) -> str:
    if target == ALONG:
        return f"{abs(leaf.mean):.2g} {node.force_unit} {'against' if leaf.mean < 0 else 'with'} the motion"
    return f"{leaf.mean:+.2g} {node.force_unit}"


def _region(node: Nodes, found: Tree | None) -> str:
    told = _told(found) if found is not None else []
    return in_words(told[0], node) if told else ""


def in_words(leaf: Leaf, node: Nodes) -> str:
    """'at speeds below 0.2 rad/s, moving forward'."""
    words = {
        "position": "position", "speed": "speed", "load": "gravity load", "effort": "effort", "time": "time in the log",
        "speed size": "speed", "load size": "gravity load (size)", "effort size": "effort (size)",
    }  # fmt: skip
    limits: dict[str, dict[bool, float]] = {}
    for axis, above, limit in leaf.where:  # nested splits on one axis: the tighter one
        own = limits.setdefault(axis, {})
        own[above] = limit if above not in own else (max if above else min)(own[above], limit)
    parts = []
    for axis, own in limits.items():
        unit = node.units[axis]
        if axis == "direction":
            parts.append("moving forward" if True in own else "moving backward")
        elif axis == "time since reversal":
            ends = [f"{'later than' if above else 'within'} {limit:.2g} s" for above, limit in own.items()]
            parts.append(f"{' and '.join(ends)} after a reversal")
        elif len(own) == 2:
            parts.append(f"{words[axis]} between {own[True]:.2g} and {own[False]:.2g} {unit}".rstrip())
        else:
            above, limit = next(iter(own.items()))
            parts.append(f"{words[axis]} {'above' if above else 'below'} {limit:.2g} {unit}".rstrip())
    return ", ".join(parts) if parts else "everywhere"
