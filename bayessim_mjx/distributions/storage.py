"""A distribution on disk: one .npz of plain arrays with a JSON header (no pickle), replaced atomically."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx import atomic
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters.ranged import Ranged

FIELDS = ("prior_weight", "logits", "means", "scales", "log_inside")
FORMAT, VERSION = "bayessim_mjx.Distribution", 1


def write(path: str | Path, arrays: dict[str, np.ndarray], space: Any, chart: str) -> Path:
    """Write arrays and what they mean to `path` (a reader sees the old file or the new one, never half)."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"format": FORMAT, "version": VERSION, **coordinates(space, chart)}
    if isinstance(space, Ranged):
        header["range"] = _box(space)
    with atomic.replacing(path) as file:
        np.savez(file, **{"header": np.asarray(json.dumps(header)), **arrays})  # type: ignore[arg-type]
    return path


def coordinates(space: Any, chart: str) -> dict[str, Any]:
    """Describe what arrays in unit coordinates mean: names, box and priors of the space, the chart; for JSON.

    The box is that which a run begins with. Where ranges have moved, they are arrays beside the others.
    """
    box = _box(getattr(space, "start", space))
    priors = {p.name: [p.prior, *(None if v is None else float(v) for v in (p.mean, p.sd))] for p in space.parameters}
    return {"names": list(space.names), "box": box, "priors": priors, "chart": chart}


def _box(space: Any) -> dict[str, list[float]]:
    return {name: [float(low), float(high)] for name, low, high in zip(space.names, space.low, space.high, strict=True)}


def disagreement(stored: dict[str, Any], own: dict[str, Any]) -> str:
    """Name the first way in which two `coordinates` differ, in words; "" where they do not. Older files lack some."""
    if stored["names"] != own["names"]:
        return f"is over {', '.join(stored['names'])}, but the parameters here are {', '.join(own['names'])}"
    for name, range_ in own["box"].items():
        if not np.allclose(stored["box"].get(name, np.nan), range_, rtol=1e-5):
            return f"has {name} in {stored['box'].get(name)}, but its range here is {range_}"
    for name, prior in own["priors"].items():
        if not _same(given := stored.get("priors", {}).get(name, prior), prior):
            return f"has the prior {_words(given)} of {name}, but its prior here is {_words(prior)}"
    chart = stored.get("chart", "plain")
    return "" if chart == own["chart"] else f"is in {chart} coordinates, but they are {own['chart']} here"


def _same(a: list, b: list) -> bool:
    """Whether two [prior, mean, sd] agree."""
    one, two = ([np.nan if v is None else float(v) for v in prior[1:]] for prior in (a, b))
    return a[0] == b[0] and bool(np.allclose(one, two, rtol=1e-5, equal_nan=True))


def _words(prior: list) -> str:
    kind, mean, sd = prior
    return kind if mean is None else f"{kind} ({mean:g} +- {sd:g})"


def read(path: str | Path, space: Any) -> tuple[dict[str, np.ndarray], str, Any]:
    """Arrays, chart and space of a file written by `write`: that given, with the file's ranges where they have moved.

    ValueError naming the first disagreement with `space`.
    """
    with np.load(path, allow_pickle=False) as file:
        if "header" not in file or any(name not in file for name in FIELDS):
            raise UserError(f"{path} holds no distribution: it has {sorted(file)}, needed are header and {FIELDS}")
        stored = json.loads(str(file["header"]))
        arrays = {name: file[name] for name in FIELDS}
    if stored.get("version") != VERSION:
        raise UserError(f"{path} has version {stored.get('version')}, this program reads {VERSION}")
    chart = stored.get("chart", "plain")
    if words := disagreement(stored, coordinates(space, chart)):
        raise UserError(f"{path} {words}")
    if moved := stored.get("range"):
        low, high = np.asarray([moved[name] for name in space.names], np.float32).T
        space = Ranged(getattr(space, "start", space), low, high)
    return arrays, chart, space
