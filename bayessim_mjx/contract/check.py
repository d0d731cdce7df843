"""The whole check: logs of a deployed policy against its file and manifest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.contract import acted, driven, manifest, observed, rebuilt, recording
from bayessim_mjx.contract.evidence import Evidence, Finding, Result
from bayessim_mjx.contract.network import Network
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
    driven.compare(evidence, result)
    acted.clock(evidence, result, _fed_back(evidence, result))
    return result


def _fed_back(evidence: Evidence, result: Result) -> bool:
    """Whether previous actions in the observations are those of the row before, so that the log has every step."""
    own = [(i, e) for i, e in enumerate(evidence.manifest.observations) if e.kind == "action"]
    if not own or not {e.name for _, e in own} & {*result.compared.get("observation", [])}:
        return False
    seen, expected = evidence.seen[:, [i for i, _ in own]], evidence.reference([e for _, e in own])("", 0)
    if expected is None:
        return False
    rows = np.isfinite(seen).all(1) & np.isfinite(expected).all(1)
    same = (np.abs(seen[rows] - expected[rows]) < acted.DIGITS).all(1)
    return bool(rows.any() and np.mean(same) > 0.5)  # a part of the steps may have old values; a rule of thumb


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
