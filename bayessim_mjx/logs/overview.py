"""How logs are read, as tables; a map to edit where there is none; and the channels that are missing."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import inertial, units
from bayessim_mjx.logs.channel_units import units_of
from bayessim_mjx.logs.check import needed_columns
from bayessim_mjx.logs.csv_files import form_of
from bayessim_mjx.logs.exchanged import Exchange
from bayessim_mjx.logs.files import SUFFIXES, map_of_folder
from bayessim_mjx.logs.log import Array, Channels, Log
from bayessim_mjx.logs.mapping import LogMap, Source
from bayessim_mjx.logs.names import channel
from bayessim_mjx.logs.pieces import MAX_GAP, SHORT_GAP
from bayessim_mjx.logs.proposal import Proposal, native, propose
from bayessim_mjx.logs.read import check_map, read_logs, table_of
from bayessim_mjx.logs.table import Table
from bayessim_mjx.logs.transport import described

HEAD = """# Proposed from the names of the columns; read it, and edit it (docs/logs.md).
# A channel is `name: column`, or `name: {column: ..., unit: deg, sign: -1, offset: 0.1}`.
"""
TEXTS = (".csv", ".txt", ".tsv", ".dat", ".log", ".asc")
CONVERTED = {".mcap": "from-mcap", ".bag": "from-rosbag", ".db3": "from-rosbag", ".parquet": "from-lerobot",
             ".hdf5": "from-hdf5", ".h5": "from-hdf5", ".pt": "from-pace"}  # fmt: skip


@dataclass
class Overview:
    """The output of `bayessim-mjx logs check`.

    Attributes:
        columns: rows (column, channel, unit, values, note) of the first file, and of others with other columns.
        files: rows (file, rows, seconds, rate, jitter, gaps) of each file.
        notes: warnings and questions.
        missing: channels that the logs need; refused: why they cannot be read. Both have to be mended.
        map_text: the map that was proposed, "" where there is one.
        logs: as a diagnosis reads them, where nothing has to be mended.
        doubts: of the notes those that a wrong map may explain; end: the last line, of how many logs are refused.
        layouts: the different columns of the files.
        sources: {channel: its column} of the first file; mapped: whether a map names them.
        unmeasured: {position that was not measured: columns of no channel whose names suggest it}.
        exchanged: commands that fit the motion of other joints.
    """

    columns: list[tuple[str, ...]] = field(default_factory=list)
    files: list[tuple[str, ...]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    map_text: str = ""
    logs: list[Log] = field(default_factory=list)
    end: str = ""
    layouts: list[tuple[str, ...]] = field(default_factory=list)
    sources: dict[str, str] = field(default_factory=dict)
    mapped: bool = False
    unmeasured: dict[str, list[str]] = field(default_factory=dict)
    exchanged: list[Exchange] = field(default_factory=list)

    @property
    def faults(self) -> list[str]:
        """One line each: missing channels first."""
        return [*(f"missing: {text}" for text in self.missing), *(f"refused: {text}" for text in self.refused)]


def overview(path: Path, model: mujoco.MjModel | None, map_file: str | Path | None = None) -> Overview:
    """How a file or a folder of logs is read.

    Args:
        path: file or folder. model: names joints and actuators; without it only columns are shown.
        map_file: a map, in place of the folder's own.

    Raises:
        UserError: no such file or folder, nothing in it that can be a log, a map that is wrong.
    """
    out = Overview()
    own = map_file if map_file is not None else map_of_folder(path)
    log_map = LogMap.read(own) if own is not None else None
    files = _files(path, log_map)
    if log_map is None:
        log_map = _proposed(out, files, model)
    if model is not None and log_map.names_channels:
        try:
            check_map(log_map, Channels.of(model))
        except UserError as error:
            out.refused.append(str(error))
    for file in files:
        _one(out, file, log_map, model)
    if len(out.layouts) > 1:
        out.columns.insert(0, (f"{files[0].name}:", "", "", "", ""))
    if model is not None and not out.faults:
        _read(out, files, log_map, model)
    if model is None:
        out.missing.append("--model FILE: joints and actuators are named by it, and nothing is mapped without")
    return out


def _files(path: Path, log_map: LogMap | None) -> list[Path]:
    if not path.exists():
        raise UserError(f"{path}: no such file or folder; allowed: a folder of logs, or a file")
    if path.is_file():
        found = [path]
    elif log_map is not None and log_map.files:
        found = sorted(p for p in path.glob(log_map.files) if p.is_file())
    else:
        found = sorted(p for p in path.iterdir() if p.suffix in (*SUFFIXES, *TEXTS) and p.is_file())
        common = [p.suffix for p in found]
        found = [p for p in found if p.suffix == max(common, key=common.count)]
    for other in [path] if path.is_file() else ([] if found else sorted(path.iterdir())):
        if other.suffix in CONVERTED:
            raise UserError(f"{other}: `bayessim-mjx logs {CONVERTED[other.suffix]} {other} --out DIR` converts it")
    if not found:
        seen = ", ".join(sorted(p.name for p in path.iterdir())[:5]) or "nothing"
        allowed = f"files ending in {', '.join((*SUFFIXES, *TEXTS))}, or `files` in a map"
        raise UserError(f"{path}: no log; it holds {seen}; allowed: {allowed}")
    return found


def _proposed(out: Overview, files: Sequence[Path], model: mujoco.MjModel | None) -> LogMap:
    """Return the map that the first file suggests; its text goes into the overview."""
    first = files[0]
    content: dict[str, Any] = {"files": f"*{first.suffix}"}
    try:
        if first.suffix in TEXTS:
            content |= form_of(first)
        table = table_of(first, LogMap.read(content))
    except UserError as error:
        out.refused.append(str(error))
        return LogMap.read(content)
    found = (
        Proposal() if first.suffix == ".npz" or native(table.columns) else propose(list(table.columns), model, table)
    )
    plain = found.time == "time" and not (found.ctrl or found.qpos or found.qvel or found.streams)
    content |= {} if plain else found.blocks()
    out.notes += found.questions
    out.map_text = HEAD + yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=110)
    if model is not None and not native(table.columns) and first.suffix != ".npz":
        channels = Channels.of(model)
        lost = {"ctrl": [n for n in channels.actuators if n not in found.ctrl],
                "qpos": [n for n in channels.joints if n not in found.qpos]}  # fmt: skip
        for stream, names in lost.items():
            if names:
                entries = ", ".join(f"{name}: COLUMN" for name in names)
                out.map_text += f"# no column bears these names:\n# {stream}: {{{entries}}}\n"
    return LogMap.read(content)


def _one(out: Overview, file: Path, log_map: LogMap, model: mujoco.MjModel | None) -> None:
    try:
        table = table_of(file, log_map)
    except UserError as error:
        if str(error) not in out.refused:
            out.refused.append(str(error))
        return
    sources, absent = _sources(table, log_map)
    out.refused += [text for text in absent if text not in out.refused]
    with warnings.catch_warnings(record=True) as said:  # of stamps in another unit
        warnings.simplefilter("always")
        out.notes += described(table, sources)
    out.notes += [str(w.message) for w in said]
    layout = tuple(table.columns)
    if not out.layouts:
        out.sources = {name: str(source.column) for name, source in sources.items() if source.column is not None}
        out.mapped = log_map.names_channels
    if layout not in out.layouts:
        out.layouts.append(layout)
        out.columns += [(f"{file.name}:", "", "", "", "")] if len(out.layouts) > 1 else []
        used = {str(source.column): name for name, source in sources.items()}
        own = {"time": "s"} | (units_of(model) if model is not None else {})  # of columns that are taken as they are
        out.columns += [_column(table, column, used, sources, log_map, own) for column in table.columns]
        held = [(n, s) for n, s in sources.items() if s.value is not None]
        out.columns += [("-", name, "", f"{s.value:g}", "held constant by the map") for name, s in held]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            time = log_map.clock(table) if log_map.rate is not None or "time" in sources else None
        out.files.append((file.name, str(table.rows), *_clock(time, log_map)))
    except UserError as error:
        out.files.append((file.name, str(table.rows), "-", "-", "-", "-"))
        out.refused.append(str(error))
        return
    if model is not None and file.suffix != ".npz" and not out.refused:
        have = [*sources, *(["time"] if time is not None else [])]
        lost = [name for name in needed_columns(have, Channels.of(model)) if name not in have]
        _missing(out, file, lost, Channels.of(model))
        free = [column for column in table.columns if column not in {str(s.column) for s in sources.values()}]
        for name in (n for n in lost if n.startswith("qpos:")):
            joint = name.partition(":")[2]
            out.unmeasured[name] = [c for c in free if channel(c, model) in (("qpos", joint), ("", joint))]


def _missing(out: Overview, file: Path, lost: Sequence[str], channels: Channels) -> None:
    """Everything that is missing at once; positions may be, but not all."""
    keys = {"time": "`time: COLUMN` or `rate: ROWS_PER_SECOND`"}
    text = [f"time ({keys['time']} in the map)"] if "time" in lost else []
    commands = [n for n in lost if n.startswith("ctrl:")]
    if commands:
        text.append(f"commands: {', '.join(commands)} (`ctrl: {{ACTUATOR: COLUMN}}` in the map, needed)")
    positions = [n for n in lost if n.startswith("qpos:")]
    if len(positions) == len(channels.qpos):
        text.append(f"positions: {', '.join(positions)} (`qpos: {{JOINT: COLUMN}}` in the map)")
    elif positions:
        out.notes.append(f"{file.name}: not measured: {', '.join(positions)} (`diagnose` allows it, `real.logs` not)")
    line = "; ".join(text)
    if line and line not in out.missing:
        out.missing.append(line)


def _sources(table: Table, log_map: LogMap) -> tuple[Mapping[str, Source], list[str]]:
    """Where each channel comes from, columns by name, and what the map names in vain.

    Where the map names no channel, columns are named as channels.
    """
    if log_map.names_channels:
        every = {name: source for name, source, _ in log_map.channels()}
    else:
        every = {c: Source(c) for c in table.columns if native([c])}
    if log_map.rate is None and (log_map.time != LogMap.time or "time" in table.columns):
        every["time"] = log_map.time
    named = {}
    where, absent = {name: text for name, _, text in log_map.channels()}, []
    for name, source in every.items():
        try:
            at = where.get(name, f"{log_map.path}: {name}")
            column = None if source.value is not None else source.name(table, at)
        except UserError as error:
            absent.append(str(error))
            continue
        named[name] = dataclasses.replace(source, column=column)
    return named, absent


def _column(
    table: Table, column: str, used: Mapping[str, str], sources: Mapping[str, Source], log_map: LogMap,
    own: Mapping[str, str],
) -> tuple[str, ...]:  # fmt: skip
    channel = used.get(column, "")
    further = {log_map.time.date: "dates of the time", log_map.time.nanoseconds: "nanoseconds of the time"}
    note = further.get(column, "") if not channel else _how(sources[channel])
    said = (sources[channel].unit if channel else None) or units.of_name(column)
    unit = said or ("" if note else own.get(channel, ""))
    try:
        if table.dated(column):
            values, unit = f"{table.columns[column][0]} ...", "date"
        else:
            x = table.numbers(column)
            values = f"{np.nanmin(x):.6g} to {np.nanmax(x):.6g}" if np.isfinite(x).any() else "no numbers"
    except UserError:
        values = "text"
    if not channel and not note:
        note = "unused: text" if values == "text" else "unused: no channel of the map"
        if not log_map.names_channels and values != "text":
            unit_of = inertial.column(column)
            note = "kept as a stream" if unit_of is None else inertial.NAMES[unit_of[0]]
            unit = unit if unit_of is None else inertial.UNITS.get(unit_of[0], "")
    return column, channel or "-", unit, values, note


def _how(source: Source) -> str:
    """Say how the map changes the column."""
    keys = ("scale", "sign", "zero", "offset", "resolution", "range", "torque_constant", "signed", "sign_magnitude",
            "wrap", "rate", "format")  # fmt: skip
    plain = Source()
    said = [f"{k} {v}" for k in keys if (v := getattr(source, k, None)) is not None and v != getattr(plain, k, None)]
    return ", ".join(said)


def _clock(time: Array | None, log_map: LogMap) -> tuple[str, ...]:
    """(seconds, rate, jitter, gaps) of one file's times."""
    if time is None or np.isfinite(time).sum() < 3:
        return "-", "-", "-", "-"
    steps = np.diff(time[np.isfinite(time)])
    step = float(np.median(steps))
    if step <= 0:
        return f"{np.ptp(time):.4g} s", "stamps stand still", "-", "-"
    usual = steps[np.abs(steps / step - 1.0) < 0.9]
    gaps = steps[steps > max(MAX_GAP * step, SHORT_GAP)]
    gap = f"{len(gaps)}, longest {gaps.max():.3g} s" if len(gaps) else "none"
    rate = f"{1.0 / step:.6g} Hz" + (" (stated)" if log_map.rate or log_map.time.rate else "")
    jitter = float(np.std(usual))
    shown = f"{1e3 * jitter:.3g} ms" if jitter > 1e-6 * step else "none"  # below, it is that of floating point
    return f"{np.nanmax(time) - np.nanmin(time):.4g} s", rate, shown, gap


def _read(out: Overview, files: Sequence[Path], log_map: LogMap, model: mujoco.MjModel) -> None:
    """Read the logs as a diagnosis does; its warnings are notes."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            out.logs = list(read_logs(files, model, log_map, partial=True))
        except UserError:
            out.refused += [text for text in (_refusal(file, log_map, model) for file in files) if text]
    out.notes += list(dict.fromkeys(str(w.message) for w in said))


def _refusal(file: Path, log_map: LogMap, model: mujoco.MjModel) -> str:
    try:
        read_logs(file, model, log_map, partial=True)
    except UserError as error:
        return str(error)
    return ""


__all__ = ["Overview", "overview"]
