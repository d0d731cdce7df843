"""The map from a foreign log's columns to channels: value = sign * scale * raw + offset, written in YAML."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx.config import read_yaml
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import HOLDS, Array, suggest
from bayessim_mjx.logs.table import Table


@dataclass(frozen=True)
class Source:
    """Where one channel comes from.

    Attributes:
        column: header name, or index counted from 0; or
        value: a constant, for a channel that was not recorded but is known.
        scale, offset, sign: value = sign * scale * raw + offset.
        signed: bits of a two's complement register that was stored unsigned (16: 65535 means -1).
        sign_magnitude: the bit that holds the sign, counted from 0; those below hold the magnitude (10: 1029 means -5).
            The registers of many hobby servos are of this kind.
        wrap: period [raw units] at which the raw value jumps; it is unwrapped.
    """

    column: str | int | None = None
    value: float | None = None
    scale: float = 1.0
    offset: float = 0.0
    sign: int = 1
    signed: int | None = None
    sign_magnitude: int | None = None
    wrap: float | None = None

    def read(self, table: Table, where: str, time: bool = False) -> Array:
        """The channel [T] from the table; `time`: the column may hold dates.

        Raises:
            UserError: no such column, a field that is no number or does not fit the register.
        """
        if self.value is not None:
            return np.full(table.rows, float(self.value))
        name = self.name(table, where)
        raw = table.times(name) if time else table.numbers(name)
        if self.signed is not None:
            half = 2.0 ** (self.signed - 1)
            raw = (raw + half) % (2 * half) - half
        if self.sign_magnitude is not None:
            raw = self._signed_magnitude(raw, table, name)
        if self.wrap is not None:
            seen = np.isfinite(raw)
            raw[seen] = np.unwrap(raw[seen], period=self.wrap)
        return self.sign * self.scale * raw + self.offset

    def _signed_magnitude(self, raw: Array, table: Table, name: str) -> Array:
        half = 2.0 ** (self.sign_magnitude or 0)
        fits = (raw >= 0) & (raw < 2 * half) & (raw == np.floor(raw))
        odd = np.flatnonzero(~fits & np.isfinite(raw))
        if len(odd) and not table.lenient:
            at = f"{table.path}: column {name!r}, {table.where(int(odd[0]))}: {raw[odd[0]]:g}"
            text = f"{at} is no register of sign and magnitude with its sign in bit {self.sign_magnitude}"
            raise UserError(f"{text}; allowed: whole numbers from 0 to {2 * half - 1:.0f}")
        return np.where(fits, np.where(raw >= half, half - raw, raw), np.nan)

    def name(self, table: Table, where: str) -> str:
        """The column's name in the table.

        Raises:
            UserError: no such column.
        """
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
    """A whole map: which files, how they are written, and the source of every channel.

    Attributes:
        files: pattern of the files in a folder; delimiter, header, skip_rows: of CSV files (skip_rows: of all texts).
        bad_rows: what becomes of rows that cannot be used: error, drop or nan (see `bad_rows.leave_out`).
        hold: how a command goes on from its row to the next: previous (None) or linear.
        time: s; rate: rows per second, in place of a column of times.
        ctrl, qpos, qvel, streams: channels by name; all empty: columns are named as the model's channels.
        metadata: of every file; path: of the map, for messages.
    """

    files: str | None = None
    delimiter: str = ","
    header: bool = True
    skip_rows: int = 0
    bad_rows: str = "error"
    hold: str | None = None
    time: Source = Source("time")
    rate: float | None = None
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
        plain = ("files", "delimiter", "header", "skip_rows", "bad_rows", "hold", "rate")
        settings: dict[str, Any] = {k: _plain(path, k, content[k]) for k in plain if k in content}
        if "time" in content and "rate" in content:
            raise UserError(
                f"{path}: time and rate; allowed: one of them (rate: rows per second, without a time column)"
            )
        if "time" in content:
            settings["time"] = _source(path, "time", content["time"])
        for stream in ("ctrl", "qpos", "qvel", "streams"):
            block = _mapping(path, stream, content.get(stream, {}))
            settings[stream] = {str(k): _source(path, f"{stream}.{k}", v) for k, v in block.items()}
        return cls(**settings, metadata=_mapping(path, "metadata", content.get("metadata", {})), path=path)

    @property
    def names_channels(self) -> bool:
        """Whether it says where channels come from."""
        return bool(self.ctrl or self.qpos or self.qvel or self.streams)

    def clock(self, table: Table) -> Array:
        """The times of the rows [T], s.

        Raises:
            UserError: no such column, a field that is no time.
        """
        if self.rate is not None:
            return np.arange(table.rows) / self.rate
        return self.time.read(table, f"{self.path}: time", time=True)

    def apply(self, table: Table) -> dict[str, Array]:
        """Columns of the file as channels: time, ctrl:<actuator>, qpos:<joint>, qvel:<joint> and streams."""
        channels = {name: source.read(table, where) for name, source, where in self._channels()}
        return {"time": self.clock(table), **channels}

    def sources(self, table: Table) -> dict[str, str]:
        """{channel: column of the file}, of those that have one."""
        timed = [] if self.rate is not None else [("time", self.time, f"{self.path}: time")]
        every = (*timed, *self._channels())
        return {name: source.name(table, where) for name, source, where in every if source.value is None}

    def _channels(self) -> Iterator[tuple[str, Source, str]]:
        """(channel, where it comes from, the key for messages), but for the time."""
        for stream in ("ctrl", "qpos", "qvel", "streams"):
            for name, source in getattr(self, stream).items():
                channel = name if stream == "streams" else f"{stream}:{name}"
                yield channel, source, f"{self.path}: {stream}.{name}"


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
    "sign_magnitude": (int, "the bit of the sign, from 1 to 62, such as 10"),
    "skip_rows": (int, "a number of lines from 0"),
    "bad_rows": (str, "error, drop (leave such rows out) or nan (their other fields are missing)"),
    "hold": (str, "previous (held until the next row) or linear"),
    "rate": ((int, float), "rows per second, above 0"),
    "sign": (int, "1 or -1"),
}


_WORDS = {"bad_rows": ("error", "drop", "nan"), "hold": HOLDS}


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
    if last == "sign_magnitude":
        good = good and 1 <= value <= 62
    if last in _WORDS:
        good = good and value in _WORDS[last]
    if last == "skip_rows":
        good = good and value >= 0
    if last == "rate":
        good = good and 1e-300 < value < 1e300
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
    if "signed" in block and "sign_magnitude" in block:
        raise UserError(f"{path}: {key} has signed and sign_magnitude; allowed: one of them")
    return Source(**{k: _plain(path, f"{key}.{k}", v) for k, v in block.items()})
