"""The map from a foreign log's columns to channels: value = sign * scale * raw + offset, written in YAML."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from bayessim_mjx.config import read_yaml
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import stamps
from bayessim_mjx.logs.csv_files import Form
from bayessim_mjx.logs.instants import MEND
from bayessim_mjx.logs.log import Array, suggest
from bayessim_mjx.logs.map_keys import plain, source_keys
from bayessim_mjx.logs.table import Table
from bayessim_mjx.logs.units import PERCENT, scale_of

WRITTEN = tuple(f.name for f in fields(Form) if f.name != "lenient")  # keys of a map that say how files are written
PLAIN = ("files", *WRITTEN, "bad_rows", "hold", "rate")
CHANNELS = ("ctrl", "qpos", "qvel", "streams")

S = TypeVar("S", bound="Source")


@dataclass(frozen=True)
class Source:
    """Where one channel comes from.

    Attributes:
        column: header name, or index counted from 0; or
        value: a constant, for a channel that was not recorded but is known.
        scale, offset, sign: value = sign * scale * (raw - zero) + offset; scale None: 1, and nobody said so.
        unit: of the raw value, in place of scale; of counts with `resolution` (per turn), of percent with `range` (the
            channel at 0 and at 100 %), of A and mA with `torque_constant` (N m/A).
        zero: raw value where the channel is 0.
        signed: bits of a two's complement register that was stored unsigned (16: 65535 means -1).
        sign_magnitude: the bit that holds the sign, counted from 0; those below hold the magnitude (10: 1029 means -5).
            The registers of many hobby servos are of this kind.
        suffix: text behind each number, such as ` rad`. missing: raw value that stands for a missing one.
        wrap: period [raw units] at which the raw value jumps; it is unwrapped.
    """

    column: str | int | None = None
    value: float | None = None
    scale: float | None = None
    offset: float = 0.0
    sign: int = 1
    unit: str | None = None
    zero: float = 0.0
    resolution: float | None = None
    range: Sequence[float] | None = None
    torque_constant: float | None = None
    signed: int | None = None
    sign_magnitude: int | None = None
    wrap: float | None = None
    suffix: str = ""
    missing: float | None = None

    @property
    def stated(self) -> bool:
        """Whether the map says in which unit the column is."""
        return self.scale is not None or self.unit is not None or self.value is not None

    def factors(self) -> tuple[float, float]:
        """(scale, offset): value = scale * (raw - zero) + offset, with unit and sign."""
        if self.unit == PERCENT:
            low, high = self.range or (0.0, 1.0)
            return self.sign * (high - low) / 100.0, self.offset + self.sign * low
        scale = self.scale if self.scale is not None else 1.0
        if self.unit is not None:
            scale = scale_of(self.unit, self.resolution, self.torque_constant)
        return self.sign * scale, self.offset

    def read(self, table: Table, where: str) -> Array:
        """Return the channel [T] from the table.

        Raises:
            UserError: no such column, a field that is no number or does not fit the register.
        """
        if self.value is not None:
            return np.full(table.rows, float(self.value))
        name = self.name(table, where)
        raw = self.decoded(table.numbers(name, self.suffix), table, name)
        scale, offset = self.factors()
        return scale * (raw - self.zero) + offset

    def decoded(self, raw: Array, table: Table, name: str) -> Array:
        """Raw values [T] of a register or a counter that wraps, as numbers.

        Raises:
            UserError: a field that does not fit the register.
        """
        if self.missing is not None:
            raw = np.where(raw == self.missing, np.nan, raw)
        if self.signed is not None:
            half = 2.0 ** (self.signed - 1)
            raw = (raw + half) % (2 * half) - half
        if self.sign_magnitude is not None:
            raw = self._signed_magnitude(raw, table, name)
        if self.wrap is not None:
            seen = np.isfinite(raw)
            raw[seen] = np.unwrap(raw[seen], period=self.wrap)
        return raw

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
        """Return the column's name in the table.

        Raises:
            UserError: no such column.
        """
        return column_of(table, self.column, where)


def column_of(table: Table, column: str | int | None, where: str) -> str:
    """Return the name in the table of a column that is given by its name or its index from 0.

    Raises:
        UserError: no such column.
    """
    names = list(table.columns)
    if isinstance(column, int) and str(column) not in names:
        if 0 <= column < len(names):
            return names[column]
        raise UserError(f"{table.path}: no column {column} ({where}); allowed: 0 to {len(names) - 1}")
    if str(column) not in names:
        raise UserError(f"{table.path}: no column {column!r} ({where}); {suggest(str(column), names)}")
    return str(column)


@dataclass(frozen=True)
class Clock(Source):
    """Where the times of the rows come from.

    Attributes:
        date: column with the dates, where `column` has the times of day.
        nanoseconds: column that is added to one of whole seconds.
        format: form of the dates, as in `strptime`, where two forms fit.
        rate: rows per second: the stamps are too coarse or late, and rows follow each other evenly.
    """

    date: str | int | None = None
    nanoseconds: str | int | None = None
    format: str | None = None
    rate: float | None = None

    def read(self, table: Table, where: str) -> Array:
        """Seconds [T]; see `stamps.seconds_of`."""
        name = self.name(table, where)
        date = None if self.date is None else column_of(table, self.date, where)
        if table.dated(name) or date is not None or self.format is not None:
            raw = table.times(name, date, self.format)
            raw = raw if self.unit is None and self.scale is None else self.factors()[0] * raw
        else:
            raw = self._numbers(table, name, where)
        return raw if self.rate is None else stamps.even(raw, self.rate, table, name)

    def _numbers(self, table: Table, name: str, where: str) -> Array:
        try:
            raw = table.numbers(name, self.suffix)
        except UserError as error:
            raise UserError(f"{error}{MEND}") from None
        if self.wrap is None:
            stamps.check_counter(raw, table, name)
        raw = self.decoded(raw, table, name)
        if self.nanoseconds is not None:
            more = table.numbers(column_of(table, self.nanoseconds, where))
            return self.factors()[0] * raw + 1e-9 * more + self.offset
        if self.stated:
            scale, offset = self.factors()
            return scale * (raw - self.zero) + offset
        return stamps.seconds_of(raw, table, name, self.suffix) + self.offset


@dataclass(frozen=True)
class LogMap:
    """A whole map: which files, how they are written, and the source of every channel.

    Attributes:
        files: pattern of the files in a folder; form: how text files are written. Its fields are keys of the map.
        bad_rows: what becomes of rows that cannot be used: error, drop or nan (see `bad_rows.leave_out`).
        hold: how a command goes on from its row to the next: previous (None) or linear.
        time: s; rate: rows per second, in place of a column of times.
        ctrl, qpos, qvel, streams: channels by name; all empty: columns are named as the model's channels.
        metadata: of every file; path: of the map, for messages.
    """

    files: str | None = None
    form: Form = Form()
    bad_rows: str = "error"
    hold: str | None = None
    time: Clock = Clock("time")
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
        allowed = [*PLAIN, "time", *CHANNELS, "metadata"]
        for key in content:
            if key not in allowed:
                raise UserError(f"{path}: unknown key {key!r}; {suggest(str(key), allowed)}")
        settings: dict[str, Any] = {k: plain(path, k, content[k]) for k in PLAIN if k in content}
        if settings.get("decimal", ".") == settings.get("thousands"):
            raise UserError(f"{path}: decimal and thousands are both {settings['thousands']!r}; allowed: two marks")
        if "time" in content and "rate" in content:
            raise UserError(
                f"{path}: time and rate; allowed: one of them (rate: rows per second, without a time column)"
            )
        if "time" in content:
            settings["time"] = _source(path, "time", content["time"], Clock)
        form = Form(
            **{k: settings.pop(k) for k in WRITTEN if k in settings},
            lenient=settings.get("bad_rows", cls.bad_rows) != "error",
        )
        for stream in CHANNELS:
            block = _mapping(path, stream, content.get(stream, {}))
            settings[stream] = {str(k): _source(path, f"{stream}.{k}", v, Source) for k, v in block.items()}
        return cls(**settings, form=form, metadata=_mapping(path, "metadata", content.get("metadata", {})), path=path)

    @property
    def names_channels(self) -> bool:
        """Whether it says where channels come from."""
        return bool(self.ctrl or self.qpos or self.qvel or self.streams)

    def clock(self, table: Table) -> Array:
        """Return the times of the rows [T], s.

        Raises:
            UserError: no such column, a field that is no time.
        """
        if self.rate is not None:
            return np.arange(table.rows) / self.rate
        return self.time.read(table, f"{self.path}: time")

    def apply(self, table: Table) -> dict[str, Array]:
        """Columns of the file as channels: time, ctrl:<actuator>, qpos:<joint>, qvel:<joint> and streams."""
        channels = {name: source.read(table, where) for name, source, where in self.channels()}
        return {"time": self.clock(table), **channels}

    def sources(self, table: Table) -> dict[str, str]:
        """{channel: column of the file}, of those that have one."""
        timed = [] if self.rate is not None else [("time", self.time, f"{self.path}: time")]
        every = (*timed, *self.channels())
        return {name: source.name(table, where) for name, source, where in every if source.value is None}

    def channels(self) -> Iterator[tuple[str, Source, str]]:
        """(channel, where it comes from, the key for messages), but for the time."""
        for stream in CHANNELS:
            for name, source in getattr(self, stream).items():
                channel = name if stream == "streams" else f"{stream}:{name}"
                yield channel, source, f"{self.path}: {stream}.{name}"


def _mapping(path: str, key: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise UserError(f"{path}: {key} is {value!r}; allowed: a mapping 'name: ...'")
    return value


def _source(path: str, key: str, value: Any, kind: type[S]) -> S:
    if isinstance(value, str | int) and not isinstance(value, bool):
        return kind(column=value)
    block = _mapping(path, key, value)
    source_keys(path, key, block, [f.name for f in fields(kind)])
    return kind(**{k: plain(path, f"{key}.{k}", v) for k, v in block.items()})
