"""Commands against motion: does each joint go where its own command says? Only of drives whose command is a place.

A drive pulls its joint to the target, so that the way of the next steps follows the target, given place and speed:
dq = a u - b q + c v + e. The share of dq that a target explains beside q, v and e is compared between targets.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.contract.evidence import Evidence, Finding, Result, shifted
from bayessim_mjx.contract.relate import order_of

Array = NDArray[np.float64]
DELAYS = (0, 1, 2)  # steps by which a drive may get its target late
MOVED = 0.08  # share of a joint's way that a target has to explain to be told; with 100 rows chance gives 0.04
AHEAD = 3  # steps of that way: drives of legs need as long; a rule of thumb
CLEAR = 4.0  # factor by which another target has to explain more: legs push each other over the ground; a rule of thumb
APART = 0.1  # share of a target's spread that place and speed have to leave: it is no copy of them; a rule of thumb
ROWS = 100  # rows at least; a rule of thumb


def compare(evidence: Evidence, result: Result) -> None:
    """Find drives that move another joint than their own, or against their command."""
    targets, names = evidence.manifest.targets, evidence.manifest.actions
    runs = [
        run
        for run in evidence.runs
        if all(f"{s}:{joint}" in run.channels for joint in targets if joint for s in ("qpos", "qvel"))
    ]
    driven = [i for i, joint in enumerate(targets) if joint]
    if not driven or not runs or not evidence.has("ctrl"):
        return
    place, speed = (
        [np.stack([np.interp(r.time, r.rows, r.channels[f"{s}:{targets[i]}"]) for i in driven], 1) for r in runs]
        for s in ("qpos", "qvel")
    )
    asked = [run.ctrl[:, driven] for run in runs]
    best: tuple[float, Array, Array] | None = None
    for delay in DELAYS:
        late = [shifted(u, delay) for u in asked]
        slopes = _explained(place, speed, late)
        if slopes is not None and (best is None or np.abs(slopes).max(1).sum() > best[0]):
            best = float(np.abs(slopes).max(1).sum()), slopes, _alike(np.concatenate(place), np.concatenate(late))
    if best is None:
        return
    _judge([names[i] for i in driven], best[1], best[2], result)


def _judge(own: list[str], slopes: Array, alike: Array, result: Result) -> None:
    """Make findings of signed shares: in cycles of the order, and of negative signs.

    Args:
        alike: [n, n] correlation of place i with target j, which has to agree: a drive that follows its own target is
            right whatever the small rest of its way says.
    """
    share = np.abs(slopes)
    order = order_of(np.maximum(1e-6, 1e-2 / np.maximum(share, 1e-4)), CLEAR, np.inf)
    order = [j if share[i, j] > MOVED and share[order[j], order[order[j]]] > 0 else i for i, j in enumerate(order)]
    order = [j if j == i or alike[i, j] > max(alike[i, i], 0.0) else i for i, j in enumerate(order)]
    if sorted(order) != list(range(len(own))):  # a cycle of which a part is not clear
        order = list(range(len(own)))
    moved = [i for i, j in enumerate(order) if j != i]
    if moved:
        shown = ", ".join(own[order[i]] for i in moved)
        result.findings.append(Finding("motion", "order", tuple(own[i] for i in moved), shown, ""))
    signs = [slopes[i, j] for i, j in enumerate(order)]
    against = tuple(own[i] for i, s in enumerate(signs) if s < -MOVED and alike[i, order[i]] < 0)
    if against:
        result.findings.append(Finding("motion", "sign", against, -1.0, 1.0))
    right = [own[i] for i, s in enumerate(signs) if s > MOVED and i not in moved]
    result.compared.setdefault("motion", []).extend(right)


def _alike(place: Array, asked: Array) -> Array:
    """[n, n] correlation of place i with target j."""
    rows = np.isfinite(place).all(1) & np.isfinite(asked).all(1)
    x, y = (v[rows] - v[rows].mean(0) for v in (place, asked))
    sizes = np.sqrt(np.outer((x**2).sum(0), (y**2).sum(0)))
    return np.divide(x.T @ y, sizes, out=np.zeros_like(sizes), where=sizes > 1e-12)


def _explained(place: list[Array], speed: list[Array], asked: list[Array]) -> Array | None:
    """[n, n] share of the way of joint i that target j explains beside place and speed, with its sign."""
    change = np.concatenate([shifted(q, -AHEAD) - q for q in place])
    q, v, u = (np.concatenate(x) for x in (place, speed, asked))
    rows = np.isfinite(change).all(1) & np.isfinite(q).all(1) & np.isfinite(v).all(1) & np.isfinite(u).all(1)
    if rows.sum() < ROWS:
        return None
    change, q, v, u = change[rows], q[rows], v[rows], u[rows]
    out = np.zeros((q.shape[1], q.shape[1]))
    for i in range(q.shape[1]):
        known = np.stack([q[:, i], v[:, i], np.ones(len(q))], 1)
        basis, _ = np.linalg.qr(known)
        left = change[:, i] - basis @ (basis.T @ change[:, i])
        other = u - basis @ (basis.T @ u)
        sizes = np.sqrt((other**2).sum(0) * (left**2).sum())
        r = np.divide(other.T @ left, sizes, out=np.zeros(len(sizes)), where=other.std(0) > APART * u.std(0) + 1e-9)
        out[i] = np.sign(r) * r**2
    return out
