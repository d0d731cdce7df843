"""The whole check: logs of a deployed policy against its file and manifest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.contract import acted, manifest, observed, rebuilt, recording
from bayessim_mjx.contract.evidence import Evidence, Finding, Result, shifted
from bayessim_mjx.contract.manifest import Network
from bayessim_mjx.contract.relate import order_of
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Channels


def check(
    policy: Path, logs: Path, given: Path | None = None, golden: Path | None = None, model: Channels | None = None
) -> Result:
    """Compare logs with the contract of an exported policy.

    Args:
        policy: ONNX file. logs: folder or file. given: JSON file whose fields replace those of the policy's metadata.
        golden: JSON file with pairs {observation, action} of the deployed machine. model: names the channels of arrays.

    Raises:
        UserError: a file that cannot be read, or names that do not fit the manifest.
    """
    network = Network(policy)
    facts: dict[str, Any] = network.facts | (manifest.of_file(given) if given is not None else {})
    contract = manifest.read(facts, str(policy) if given is None else f"{policy} with {given}")
    if len(contract.observations) != network.size:
        names = len(contract.observations)
        raise UserError(
            f"{policy}: the network takes {network.size} numbers, the manifest names {names}; {manifest.AGAIN}"
        )
    pairs = _pairs(golden, contract) if golden is not None else None
    evidence = Evidence(recording.read_runs(logs, contract, model), contract, network)
    result = Result(notes=[f"lacks {key}" for key in contract.lacks])
    acted.golden(evidence, result, pairs)
    normalised = False
    if evidence.has("observation"):
        normalised = observed.compare(evidence, result)
        if normalised:
            result.findings.append(Finding("observation", "normalised"))
        acted.actions(evidence, result, normalised)
        acted.commands(evidence, result)
    elif rebuilt.compare(evidence, result) and evidence.has("action"):
        acted.commands(evidence, result)
    elif "rebuilt_unlike" in result.notes:
        acted.commands(evidence, result, strict=True)
    compare(evidence, result)
    acted.clock(evidence, result, _complete(evidence, result))
    return result


def _complete(evidence: Evidence, result: Result) -> bool | None:
    """Whether the log has every step of the policy; None where nothing shows it.

    A log with rows between the steps has them all, and so has one whose previous actions are those of the row before,
    or whose actions are those of a memory that was given no other observation.
    """
    if all(np.median(np.diff(run.rows)) < recording.FINER * run.period for run in evidence.runs):
        return True
    own = [(i, e) for i, e in enumerate(evidence.manifest.observations) if e.kind == "action"]
    seen, expected = (
        evidence.seen[:, [i for i, _ in own]],
        evidence.reference([e for _, e in own])("", 0) if own else None,
    )
    if expected is None:
        remembers = evidence.network.memory and evidence.has("action") and result.compared.get("action")
        return True if remembers and evidence.has("observation") else None
    seen = evidence.seen[:, [i for i, _ in own]]
    rows = np.isfinite(seen).all(1) & np.isfinite(expected).all(1)
    same = (np.abs(seen[rows] - expected[rows]) < acted.DIGITS).all(1)
    if not rows.any() or np.ptp(seen[rows], axis=0).max() < acted.DIGITS:
        return None
    return bool(np.mean(same) > 0.5)  # a part of the steps may have old values; a rule of thumb


def _pairs(path: Path, contract: manifest.Manifest) -> dict[str, NDArray[np.float64]]:
    found = manifest.of_file(path) if path.suffix == ".json" else {}
    own = {key.removeprefix("golden_"): value for key, value in found.items()}
    if "observation" not in own or "action" not in own:
        raise UserError(f"{path}: allowed: a JSON file with observation and action, lists of rows")
    try:
        keys = [key for key in ("observation", "action", "memory") if key in own]
        pairs: dict[str, NDArray[np.float64]] = {key: np.array(own[key], float) for key in keys}
    except ValueError as error:
        raise UserError(f"{path}: rows of numbers are needed ({error})") from None
    for key, count in (("observation", len(contract.observations)), ("action", len(contract.actions))):
        if pairs[key].ndim != 2 or pairs[key].shape[1] != count:
            raise UserError(f"{path}: {key} has shape {pairs[key].shape}; allowed: rows of {count} numbers")
    return pairs


# Commands against motion: does each joint go where its own command says? Only of drives whose command is a place


Array = NDArray[np.float64]
DELAYS = (0, 1, 2)  # steps by which a drive may get its target late; a rule of thumb
# Share of a joint's way that a target has to explain to be its own: twice what chance explains of 100 rows in one case
# of 20, the 95 % point of chi-squared with one degree of freedom over the rows (.04). The factor is a rule of thumb.
MOVED = 0.08
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
