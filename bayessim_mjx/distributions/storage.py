"""A distribution on disk: one .npz of plain arrays with a JSON header (no pickle), replaced atomically."""

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

FIELDS = ("prior_weight", "logits", "means", "scales", "log_inside")
VERSION = 1


def write(path: str | Path, arrays: dict[str, np.ndarray], space: Any, chart: str) -> Path:
    """Write arrays and the space's names and box to `path` (a reader sees the old file or the new one, never half)."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".tmp")
    try:
        with os.fdopen(descriptor, "wb") as file:
            np.savez(file, **{"header": np.asarray(json.dumps({**header(space), "chart": chart})), **arrays})  # type: ignore[arg-type]
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise
    return path


def header(space: Any) -> dict[str, Any]:
    """What must agree between the file and the space it is read into."""
    box = {name: [float(low), float(high)] for name, low, high in zip(space.names, space.low, space.high, strict=True)}
    return {"format": "bayessim_mjx.Distribution", "version": VERSION, "names": list(space.names), "box": box}


def read(path: str | Path, space: Any) -> tuple[dict[str, np.ndarray], str]:
    """Arrays and chart of a file written by `write`; ValueError naming the first disagreement with `space`."""
    with np.load(path, allow_pickle=False) as file:
        if "header" not in file or any(name not in file for name in FIELDS):
            raise ValueError(f"{path} holds no distribution: it has {sorted(file)}, needed are header and {FIELDS}")
        stored = json.loads(str(file["header"]))
        arrays = {name: file[name] for name in FIELDS}
    expected = header(space)
    if stored.get("version") != VERSION:
        raise ValueError(f"{path} has version {stored.get('version')}, this program reads {VERSION}")
    if stored["names"] != expected["names"]:
        raise ValueError(f"{path} is over {stored['names']}, but the parameters here are {expected['names']}")
    for name, range_ in expected["box"].items():
        if not np.allclose(stored["box"][name], range_, rtol=1e-5):
            raise ValueError(f"{path} has {name} in {stored['box'][name]}, but its range here is {range_}")
    return arrays, stored.get("chart", "plain")
