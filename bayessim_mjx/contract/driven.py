"""Commands against motion: does each joint go where its own command says? Only of drives whose command is a place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.contract.evidence import Evidence, Finding, Result, shifted
from bayessim_mjx.contract.relate import TOLD, relate

Array = NDArray[np.float64]
DELAYS = (0, 1, 2, 3, 4)  # steps by which a drive may follow its target
CLEAR = 4.0  # factor by which another joint's target explains a motion better: legs that touch the ground follow poorly


def compare(evidence: Evidence, result: Result) -> None:
    """Find drives that move another joint than their own, or against their command."""
    targets, names = evidence.manifest.targets, evidence.manifest.actions
    channels = [f"qpos:{joint}" for joint in targets]
    driven = [i for i, c in enumerate(channels) if targets[i] and any(c in run.channels for run in evidence.runs)]
    if not driven or not evidence.has("ctrl"):
        return
    places, asked = [], []
    for run in evidence.runs:
        if not all(channels[i] in run.channels for i in driven):
            continue
        places.append(np.stack([np.interp(run.time, run.rows, run.channels[channels[i]]) for i in driven], 1))
        asked.append(run.ctrl[:, driven])
    if not places:
        return
    seen = np.concatenate(places)

    def reference(frame: str, delay: int) -> Array | None:
        return None if frame else np.concatenate([shifted(a, delay) for a in asked])

    relation = relate(seen, reference, (), DELAYS, CLEAR)
    if relation is None:
        return
    own = [names[i] for i in driven]
    moved = [k for k, j in enumerate(relation.order) if j != k]
    if moved:
        shown = ", ".join(own[relation.order[k]] for k in moved)
        result.findings.append(Finding("motion", "order", tuple(own[k] for k in moved), shown, ""))
    against = tuple(
        own[k] for k in range(len(own)) if relation.told[k] and _slope(seen[:, k], relation.expected[:, k]) < 0
    )
    if against:
        result.findings.append(Finding("motion", "sign", against, -1.0, 1.0))
    bad = {*against, *(own[k] for k in moved)}
    right = [own[k] for k in range(len(own)) if relation.left[k] < TOLD and own[k] not in bad]
    result.compared.setdefault("motion", []).extend(right)


def _slope(seen: Array, expected: Array) -> float:
    rows = np.isfinite(seen) & np.isfinite(expected)
    return float(np.cov(seen[rows], expected[rows])[0, 1])
