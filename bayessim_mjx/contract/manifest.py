"""The manifest of an exported policy: what its observations, actions and commands mean."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.errors import UserError

Array = NDArray[np.float64]
NEEDED = ("observation_names", "action_names", "control_dt")  # without these there is nothing to compare
AGAIN = (
    "export the policy again with this version (bayessim-mjx play --export), or give these fields in --manifest FILE"
)


@dataclass(frozen=True)
class Entry:
    """One number of the observation: the sum of weight * source, plus offset.

    Attributes:
        name: as in the manifest. terms: {source: weight}; empty: not known. offset: in units of the observation.
        unit: of the sources.
    """

    name: str
    terms: Mapping[str, float]
    offset: float = 0.0
    unit: str = ""

    @property
    def source(self) -> str:
        """Return the only source; "" where there are several or none."""
        return next(iter(self.terms)) if len(self.terms) == 1 else ""

    @property
    def kind(self) -> str:
        """Return the kind of the source, as `qpos`."""
        return self.source.partition(":")[0]

    @property
    def weight(self) -> float:
        """Return the factor of the only source; 1 where there are several."""
        return self.terms[self.source] if self.source else 1.0


@dataclass(frozen=True)
class Manifest:
    """What an exported policy says of itself.

    Attributes:
        observations: entries in their order. actions: names of the actuators in their order. dt: control period, s.
        action_limit: largest action. scale, offset: commands are offset + scale * action; None: of another form.
        targets: the joint whose target position each command is; "" for other commands.
        command_range: [A, 2] of the actuators, infinite where there is none. observation_clip: inf where there is none.
        mean, std: of the normaliser that is inside the file; None: it has none, or does not say it.
        golden: pairs {observation, action[, memory]}. lacks: fields that an older export has not.
    """

    observations: tuple[Entry, ...]
    actions: tuple[str, ...]
    dt: float
    action_limit: float
    scale: Array | None
    offset: Array | None
    targets: tuple[str, ...]
    command_range: Array
    observation_clip: float
    mean: Array | None
    std: Array | None
    golden: Mapping[str, Array]
    lacks: tuple[str, ...]


def read(facts: Mapping[str, Any], source: str) -> Manifest:
    """Read the metadata of an ONNX file or of a JSON file.

    Args:
        facts: values, or texts of JSON. source: the file, for messages.

    Raises:
        UserError: a field that is missing or that has another length than the names.
    """
    own = {key: _value(value) for key, value in facts.items()}
    missing = [key for key in NEEDED if not own.get(key)]
    if missing:
        raise UserError(f"{source}: no {', '.join(missing)} in its metadata; {AGAIN}")
    names, actions = list(map(str, own["observation_names"])), tuple(map(str, own["action_names"]))
    meant = own.get("observation_meaning") or [None] * len(names)
    _length(source, "observation_meaning", meant, len(names))
    entries = tuple(_entry(source, name, m) for name, m in zip(names, meant, strict=True))
    scale, offset = (_numbers(source, own, f"action_{key}", len(actions)) for key in ("scale", "offset"))
    ranges = own.get("command_range") or [None] * len(actions)
    _length(source, "command_range", ranges, len(actions))
    targets = own.get("command_joint") or [None] * len(actions)
    _length(source, "command_joint", targets, len(actions))
    clip = own.get("observation_clip")
    return Manifest(
        observations=entries,
        actions=actions,
        dt=float(own["control_dt"]),
        action_limit=min(1.0, float(own.get("action_clip", 1.0))),
        scale=scale,
        offset=offset if offset is not None or scale is None else np.zeros(len(actions)),
        targets=tuple(str(joint or "") for joint in targets),
        command_range=np.array([r if r is not None else (-np.inf, np.inf) for r in ranges], float),
        observation_clip=np.inf if clip is None else float(clip),
        mean=_numbers(source, own, "normaliser_mean", len(names)),
        std=_numbers(source, own, "normaliser_std", len(names)),
        golden={
            k: np.array(own[f"golden_{k}"], float) for k in ("observation", "action", "memory") if f"golden_{k}" in own
        },
        lacks=tuple(key for key in ("observation_meaning", "golden_action") if key not in own),
    )


def of_file(path: Path) -> dict[str, Any]:
    """Read a manifest that is a JSON file.

    Raises:
        UserError: no such file, or no JSON object in it.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(
            f"{path}: cannot be read as JSON ({error}); allowed: an object with {', '.join(NEEDED)}"
        ) from None
    if not isinstance(found, dict):
        raise UserError(f"{path}: holds no JSON object; allowed: an object with {', '.join(NEEDED)}")
    return found


def _value(text: Any) -> Any:
    if not isinstance(text, str):
        return text
    try:
        return json.loads(text)
    except ValueError:
        return text


def _entry(source: str, name: str, meant: Any) -> Entry:
    if meant is None:
        return Entry(name, {})
    if not isinstance(meant, Mapping) or not isinstance(meant.get("terms"), Mapping):
        raise UserError(
            f"{source}: observation_meaning of {name} is {meant!r}; allowed: {{terms, offset, unit}} or null"
        )
    terms = {str(key): float(value) for key, value in meant["terms"].items()}
    return Entry(name, terms, float(meant.get("offset", 0.0)), str(meant.get("unit", "")))


def _numbers(source: str, own: Mapping[str, Any], key: str, count: int) -> Array | None:
    if own.get(key) is None:
        return None
    _length(source, key, own[key], count)
    return np.array(own[key], float)


def _length(source: str, key: str, value: Sequence[Any], count: int) -> None:
    if len(value) != count:
        raise UserError(f"{source}: {key} has {len(value)} values; allowed: {count}, as many as there are names")


# The policy's ONNX file on this machine: its metadata and its answers


class Network:
    """An exported policy: observations [K, S] -> actions [K, A].

    Raises:
        UserError: no such file, no ONNX file, or onnxruntime is not installed.
    """

    def __init__(self, path: Path) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise UserError('policy check needs onnxruntime: pip install "bayessim-mjx[export]"') from None
        if not path.is_file():
            raise UserError(f"{path}: no such file; allowed: an ONNX file of bayessim-mjx play --export")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        try:
            self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime has kinds of its own for broken files
            text = " ".join(str(error).split())[:150]
            raise UserError(f"{path}: not a readable ONNX file ({text}); export it again") from None
        inputs = {i.name: i.shape for i in self.session.get_inputs()}
        if "observation" not in inputs or "action" not in [o.name for o in self.session.get_outputs()]:
            raise UserError(f"{path}: its input is {', '.join(inputs)}; allowed: observation, with the output action")
        self.size = inputs["observation"][1]
        self.memory = inputs["memory"][1] if "memory" in inputs else 0

    @property
    def facts(self) -> dict[str, Any]:
        """Return the metadata of the file, texts."""
        return dict(self.session.get_modelmeta().custom_metadata_map)

    def answers(self, observation: Array, memory: Array) -> Array:
        """Actions [K, A] at observations [K, S] and memories [K, M] that do not follow from each other."""
        given = {"observation": observation.astype(np.float32)}
        if self.memory:
            given["memory"] = memory.astype(np.float32)
        return np.asarray(self.session.run(["action"], given)[0], float)

    def run(self, observation: Array, forgets: bool = False) -> Array:
        """Actions [K, A] of one run from its start.

        Args:
            observation: [K, S]; rows that are not finite give NaN. forgets: the memory is zero in every step.
        """
        bad = ~np.isfinite(observation).all(axis=1, keepdims=True)
        filled = np.where(bad, 0.0, observation)
        if not self.memory or forgets:
            out = self.answers(filled, np.zeros((len(filled), self.memory)))
        else:
            memory, rows = np.zeros((1, self.memory), np.float32), []
            for row in filled.astype(np.float32):
                action, memory = self.session.run(
                    ["action", "memory_next"], {"observation": row[None], "memory": memory}
                )
                rows.append(action[0])
            out = np.array(rows, float)
        return np.where(bad, np.nan, out)
