"""Logs as an MCAP file of JSON messages, which Foxglove and PlotJuggler open."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx.logs.importers.needs import needs
from bayessim_mjx.logs.views import STREAMS, Sheet

TOPICS = {"ctrl": "commands", "qpos": "positions", "qvel": "velocities", "effort": "efforts"}
MOST = 2_000_000  # messages of a file: of longer logs every n-th row is written; a rule of thumb


def writer() -> Any:
    """Return the class that writes.

    Raises:
        UserError: the package mcap is not installed.
    """
    return needs("mcap.writer", "--mcap", "mcap").Writer


def write(path: Path, sheets: Sequence[Sheet]) -> int:
    """Write one topic for each log and stream, such as `/run1/positions`; returns the number of messages.

    Raises:
        UserError: the package mcap is not installed.
    """
    of = writer()
    every = max(1, -(-sum(len(s.time) for s in sheets) * len(STREAMS) // MOST))
    path.parent.mkdir(parents=True, exist_ok=True)
    written = 0
    with path.open("wb") as file:
        out = of(file)
        out.start(library="bayessim_mjx")
        for sheet in sheets:
            written += _one(out, sheet, every)
        out.finish()
    return written


def _one(writer: object, sheet: Sheet, every: int) -> int:
    """Write one log: time is that of its rows, from the start of the epoch where they are seconds since a start."""
    blocks = {stream: sheet.names(stream) for stream in STREAMS}
    rest = [name for name in sheet.channels if name.partition(":")[0] not in STREAMS]
    channels = {TOPICS[s]: {n: sheet.channels[f"{s}:{n}"] for n in names} for s, names in blocks.items() if names}
    channels |= {"others": {n: sheet.channels[n] for n in rest}} if rest else {}
    stem = sheet.name.partition(".")[0]
    written = 0
    for topic, values in channels.items():
        fields = {name: {"type": "number"} for name in values}
        schema = json.dumps({"type": "object", "properties": fields}).encode()
        kind = writer.register_schema(name=f"{stem}.{topic}", encoding="jsonschema", data=schema)  # type: ignore[attr-defined]
        own = writer.register_channel(topic=f"/{stem}/{topic}", message_encoding="json", schema_id=kind)  # type: ignore[attr-defined]
        for k in range(0, len(sheet.time), every):
            at = round(1e9 * float(sheet.time[k] - min(sheet.time[0], 0.0)))
            row = {name: float(column[k]) for name, column in values.items() if np.isfinite(column[k])}
            writer.add_message(own, log_time=at, publish_time=at, data=json.dumps(row).encode(), sequence=k)  # type: ignore[attr-defined]
            written += 1
    return written
