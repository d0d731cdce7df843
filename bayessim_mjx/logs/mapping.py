"""The map from a foreign log's columns to channels: value = sign * scale * raw + offset, written in YAML."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx.config import read_yaml
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array, suggest
from bayessim_mjx.logs.table import Table


@dataclass(frozen=True)
class Source:
    """Where one channel comes from.

    Attributes:
        column: header name, or index counted from 0; or
        value: a constant, for a channel that was not recorded but is known.
        scale, offset, sign: value = sign * scale * raw + offset.
        signed: bits of a two's complement register that was stored unsigned (16: 65535 means -1).
        wrap: period [raw units] at which the raw value jumps; it is unwrapped.
    """

    column: str | int | None = None
    value: float | None = None
    scale: float = 1.0
    offset: float = 0.0
    sign: int = 1
    signed: int | None = None
    wrap: float | None = None

    def read(self, table: Table, where: str) -> Array:
        """The channel [T] from the table.

        Raises:
            UserError: no such column.
        """
        if self.value is not None:
            return np.full(table.rows, float(self.value))
        raw = table.numbers(self._name(table, where))
        if self.signed is not None:
            half = 2.0 ** (self.signed - 1)
            raw = (raw + half) % (2 * half) - half
        if self.wrap is not None:
            raw = np.unwrap(raw, period=self.wrap)
        return self.sign * self.scale * raw + self.offset

    def _name(self, table: Table, where: str) -> str:
        names = list(table.columns)
        if isinstance(self.column, int) and str(self.column) not in names:
            if 0 <= self.column < len(names):
                return names[self.column]
            raise UserError(f"{table.path}: no column {self.column} ({where}); allowed: 0 to {len(names) - 1}")
        if str(self.column) not in names:
            raise UserError(f"{table.path}: no column {self.column!r} ({where}); {suggest(str(self.column), names)}")
        return str(self.column)


@dataclass(frozen=True)
class LogMap:
    """A whole map: which files, how they are written, and the source of every channel."""

    files: str | None = None
    delimiter: str = ","
    header: bool = True
    time: Source = Source("time")
    ctrl: Mapping[str, Source] = field(default_factory=dict)
    qpos: Mapping[str, Source] = field(default_factory=dict)
    qvel: Mapping[str, Source] = field(default_factory=dict)
    streams: Mapping[str, Source] = field(default_factory=dict)
    metadata: Mapping[str, Any] = field(default_factory=dict)
    path: str = "map"

    @classmethod
    def read(cls, source: str | Path | Mapping[str, Any]) -> LogMap:
        """From a YAML file, or from its contents as a mapping.

        Raises:
            UserError: no such file, bad YAML, an unknown key, a value of the wrong kind; each names file and key.
        """
        path = "map" if isinstance(source, Mapping) else str(source)
        content = source if isinstance(source, Mapping) else read_yaml(source)
        allowed = [f.name for f in fields(cls) if f.name != "path"]
        for key in content:
            if key not in allowed:
                raise UserError(f"{path}: unknown key {key!r}; {suggest(str(key), allowed)}")
        settings: dict[str, Any] = {
            k: _plain(path, k, content[k]) for k in ("files", "delimiter", "header") if k in content
        }
        if "time" in content:
            settings["time"] = _source(path, "time", content["time"])
        for stream in ("ctrl", "qpos", "qvel", "streams"):
            block = _mapping(path, stream, content.get(stream, {}))
            settings[stream] = {str(k): _source(path, f"{stream}.{k}", v) for k, v in block.items()}
        return cls(**settings, metadata=_mapping(path, "metadata", content.get("metadata", {})), path=path)

    def apply(self, table: Table) -> dict[str, Array]:
        """Columns of the file as channels: time, ctrl:<actuator>, qpos:<joint>, qvel:<joint> and streams."""
        out = {"time": self.time.read(table, f"{self.path}: time")}
        for stream in ("ctrl", "qpos", "qvel"):
            for name, source in getattr(self, stream).items():
                out[f"{stream}:{name}"] = source.read(table, f"{self.path}: {stream}.{name}")
        return out | {k: s.read(table, f"{self.path}: streams.{k}") for k, s in self.streams.items()}


def _mapping(path: str, key: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise UserError(f"{path}: {key} is {value!r}; allowed: a mapping 'name: ...'")
    return value


_KINDS: dict[str, tuple[type | tuple[type, ...], str]] = {
    "files": (str, "a file pattern inside the folder such as '*.csv'"),
    "delimiter": (str, "one character"),
    "header": (bool, "true or false"),
    "column": ((str, int), "a header name or an index from 0"),
    "signed": (int, "a number of bits from 2 to 64, such as 16"),
    "sign": (int, "1 or -1"),
}


def _plain(path: str, key: str, value: Any) -> Any:
    """The value if it has the kind its key asks for (a number, where _KINDS says nothing else)."""
    last = key.rsplit(".", 1)[-1]
    kind, allowed = _KINDS.get(last, ((int, float), "a number"))
    good = isinstance(value, kind) and (kind is bool or not isinstance(value, bool))
    if last == "delimiter":
        good = good and len(value) == 1
    if last == "sign":
        good = good and value in (1, -1)
    if last == "signed":
        good = good and 2 <= value <= 64
    if last == "files":
        good = good and bool(value.strip()) and not Path(value).is_absolute() and ".." not in Path(value).parts
    if last in ("value", "offset", "wrap", "scale"):
        good = good and abs(value) < 1e300 and (last != "wrap" or value > 0) and (last != "scale" or value != 0)
    if not good:
        raise UserError(f"{path}: {key} = {value!r}; allowed: {allowed}")
    return value


def _source(path: str, key: str, value: Any) -> Source:
    if isinstance(value, str | int) and not isinstance(value, bool):
        return Source(column=value)
    allowed = [f.name for f in fields(Source)]
    block = _mapping(path, key, value)
    for entry in block:
        if entry not in allowed:
            raise UserError(f"{path}: unknown key {key}.{entry}; {suggest(str(entry), allowed)}")
    if ("column" in block) == ("value" in block):
        raise UserError(f"{path}: {key} needs either column or value; it has {', '.join(block) or 'nothing'}")
    return Source(**{k: _plain(path, f"{key}.{k}", v) for k, v in block.items()})
