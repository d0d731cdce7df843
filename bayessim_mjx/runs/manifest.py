"""run.json: what a run folder's manifest may say, and what it says is the best and what has changed."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bayessim_mjx.errors import UserError

MANIFEST = "run.json"
SCHEMA = 1
FOLDER = "checkpoints"


def read(path: Path) -> dict[str, Any]:
    """Read the manifest in the folder `path`.

    Raises:
        UserError: there is none, it is damaged, or another version wrote it.
    """
    file = path / MANIFEST
    if not file.is_file():
        raise UserError(f"{path}: not a run folder (no {MANIFEST} in it)")
    try:
        manifest = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"{file}: damaged manifest: {type(error).__name__}: {error}") from None
    schema = manifest.get("schema") if isinstance(manifest, dict) else None
    if type(schema) is int and schema != SCHEMA:
        raise UserError(f"{file}: written by another version (schema {schema}, this one reads {SCHEMA})")
    if fault := _fault(manifest):
        raise UserError(f"{file}: damaged manifest: {fault}")
    return manifest


def _fault(manifest: Any) -> str | None:
    """Find what is wrong with the contents of run.json; None: nothing."""
    if not isinstance(manifest, dict):
        return "not an object"
    for key, kind in (("schema", int), ("task", str), ("created", str), ("status", str), ("checkpoints", list)):
        if type(manifest.get(key)) is not kind:
            return f"{key} = {manifest.get(key)!r}"
    for entry in manifest["checkpoints"]:
        ok = isinstance(entry, dict) and type(entry.get("step")) is int and isinstance(entry.get("path"), str)
        score = entry.get("evaluation", "") if ok else ""
        if not ok or isinstance(score, bool) or not isinstance(score, int | float | None):
            return f"checkpoints: {entry!r}"
        if not _inside(entry["path"]):
            return f"checkpoints: path = {entry['path']!r}; allowed: {FOLDER}/<name>"
    steps = [entry["step"] for entry in manifest["checkpoints"]]
    for key in ("latest", "best"):
        step = manifest.get(key, "absent")
        if step is not None and (type(step) is not int or step not in steps):
            return f"{key} = {step!r} is none of the checkpoints {steps}"
    return None


def _inside(path: str) -> bool:
    """Whether a manifest's path names a folder of the run's own checkpoints."""
    parts = path.split("/")
    return len(parts) == 2 and parts[0] == FOLDER and parts[1] not in ("", ".", "..") and "\\" not in path


def differences(then: Any, now: Any, path: str = "") -> list[str]:
    """`ppo.gamma: 0.9, was 0.99` for every leaf of nested mappings that differs."""
    if isinstance(then, Mapping) and isinstance(now, Mapping):
        keys = dict.fromkeys([*then, *now])
        inner = [(f"{path}.{key}".lstrip("."), then.get(key), now.get(key)) for key in keys]
        return [text for at, a, b in inner for text in differences(a, b, at)]
    return [] if then == now else [f"{path}: {now}, was {then}"]


def best_of(listed: Sequence[Mapping[str, Any]]) -> int | None:
    """Step of the highest evaluation (the first of equals)."""
    evaluated = [c for c in listed if c["evaluation"] is not None]
    return max(evaluated, key=lambda c: c["evaluation"])["step"] if evaluated else None


def advice(others: Sequence[Mapping[str, Any]]) -> str:
    """Advise what to do about a damaged checkpoint, where these others are left."""
    if not others:
        return "There is no other checkpoint: start the run again"
    return f"Use another checkpoint of the run: {', '.join(str(c['step']) for c in others)}"
