"""Which column may be which channel: proposed from the names of columns, joints and actuators, for a map to edit."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import names, units, vendors
from bayessim_mjx.logs.check import STREAMS
from bayessim_mjx.logs.log import Channels
from bayessim_mjx.logs.table import Table


@dataclass
class Proposal:
    """Entries of a map, and what nobody but the user can say.

    Attributes:
        time: the entry, or None. ctrl, qpos, qvel, streams: entries by channel, a column's name or keys of a source.
        metadata: what the columns say of all logs, as the controller in the drives.
        questions: sentences for the user.
    """

    time: Any = None
    ctrl: dict[str, Any] = field(default_factory=dict)
    qpos: dict[str, Any] = field(default_factory=dict)
    qvel: dict[str, Any] = field(default_factory=dict)
    streams: dict[str, Any] = field(default_factory=dict)
    metadata: dict[str, Any] = field(default_factory=dict)
    questions: list[str] = field(default_factory=list)

    def blocks(self) -> dict[str, Any]:
        """Return the blocks of the map that hold something."""
        every = {key: getattr(self, key) for key in ("time", "ctrl", "qpos", "qvel", "streams", "metadata")}
        return {key: block for key, block in every.items() if block}


def native(columns: Iterable[str]) -> bool:
    """Whether columns are named as channels already."""
    return any(column.partition(":")[0] in STREAMS and ":" in column for column in columns)


def propose(columns: Sequence[str], model: mujoco.MjModel | None, table: Table | None = None) -> Proposal:
    """Suggest a map by the names of columns.

    Args:
        columns: of the file. model: names joints and actuators; without it only the time is found.
        table: the file, whose values say how a vendor's drives were commanded.
    """
    out = Proposal()
    clocks = [c for c in columns if names.is_clock(c)]
    halves = _halves(columns)
    if halves:
        clocks = list(halves)
        out.time = {"column": halves[0], "nanoseconds": halves[1]}
    elif clocks:
        unit = units.of_name(clocks[0])
        out.time = {"column": clocks[0], "unit": unit} if unit in units.TIMES and unit != "s" else clocks[0]
        if len(clocks) > 1:
            out.questions.append(f"time may be {' or '.join(clocks)}; the map takes {clocks[0]}")
    if model is None:
        return out
    dialect = vendors.dialect_of(columns)
    if dialect is not None:
        _of_vendor(out, dialect, columns, model, table)
        return out
    found: dict[tuple[str, str], list[str]] = {}
    named = _named(columns, table)
    for column in columns:
        channel = None if column in clocks else names.channel(named.get(column, column), model)
        if channel is not None:
            found.setdefault(channel, []).append(column)
    for (kind, name), own in found.items():
        _enter(out, kind, name, own, model)
    if out.qvel and set(out.qvel) != set(Channels.of(model).qvel):
        out.questions.append("qvel names some joints only; `diagnose` allows that, `real.logs` needs all or none")
    return out


def _enter(out: Proposal, kind: str, name: str, own: Sequence[str], model: mujoco.MjModel) -> None:
    """Take a column for a channel, where one alone can be it; else ask."""
    if not kind:
        text = f"{' and '.join(own)}: of {name}, and nothing in the name says which quantity it is"
        out.questions.append(f"{text}; the map leaves it out (qpos, qvel or ctrl: {{{name}: {own[0]}}} takes it)")
        return
    if kind == "ctrl":
        wrong = {column: text for column in own if (text := names.mismatch(column, name, model))}
        own = [column for column in own if column not in wrong]
        if not own:
            out.questions += wrong.values()
            return
    if len(own) > 1:
        out.questions.append(f"{kind}.{name} may be {' or '.join(own)}; the map takes none of them")
        return
    block = out.streams if kind == "effort" else getattr(out, kind)
    block[f"effort:{name}" if kind == "effort" else name] = _entry(out, kind, name, own[0], model)


def _of_vendor(
    out: Proposal, dialect: vendors.Dialect, columns: Sequence[str], model: mujoco.MjModel, table: Table | None
) -> None:
    """Fill the proposal for columns that a vendor's tool numbers."""
    clock = next((c for c in columns if re.fullmatch(dialect.clock[0], c)), None)
    if clock is not None and out.time in (None, clock):
        out.time = clock if dialect.clock[1] == "s" else {"column": clock, "unit": dialect.clock[1]}
    try:
        joints = vendors.motors(dialect.vendor, vendors.hinges(model))
    except UserError as error:
        out.questions.append(str(error))
        return
    by = vendors.numbered(dialect, columns)
    channels = Channels.of(model)
    for number, joint in joints.items():
        drive = names.drive_of(model, channels, joint)
        for kind, block, name in (("qpos", out.qpos, joint), ("qvel", out.qvel, joint),
                                  ("effort", out.streams, f"effort:{drive}" if drive else "")):  # fmt: skip
            if name and number in by[kind]:
                block[name] = by[kind][number]
        if drive is not None:
            _command(out, by, number, drive, vendors.is_servo(model, channels.actuators.index(drive)), table)
    out.questions += [note for kind, note in dialect.notes.items() if by[kind] and (kind != "torque" or out.ctrl)]
    out.questions.append(f"numbers of {dialect.vendor} are joints: " + ", ".join(f"{i} {j}" for i, j in joints.items()))


def _command(
    out: Proposal, by: Mapping[str, Mapping[int, str]], number: int, drive: str, servo: bool, table: Table | None
) -> None:
    """Propose the column that commands one drive: its target, a torque, or none where several terms are summed."""
    target, torque = by["target"].get(number), by.get("torque", {}).get(number)
    if servo or torque is not None:
        column = target if servo else torque
        if column is not None:
            out.ctrl[drive] = column
        return
    kind, law = vendors.laws(table, by, number) if table is not None else ("", {})
    if kind and number in by[kind]:
        out.ctrl[drive] = by[kind][number]
        if law:
            out.metadata.setdefault("controller", {})[drive] = law
    elif target is not None:
        text = f"ctrl.{drive}: the model takes a torque, and {target} is a target"
        out.questions.append(
            f"{text}; `metadata: {{controller: {{{drive}: {{law: position, kp: ..., kd: ...}}}}}}` declares its law"
        )


def _halves(columns: Sequence[str]) -> tuple[str, str] | None:
    """Return the columns of whole seconds and of nanoseconds, as ROS writes a stamp."""
    pairs = [(c, re.fullmatch(r"(.*?)(n?)(?:ano)?(secs?|seconds)", c.lower())) for c in columns]
    whole = {m[1]: c for c, m in pairs if m and not m[2]}
    rest = {m[1]: c for c, m in pairs if m and m[2]}
    both = [start for start in whole if start in rest]
    return (whole[both[0]], rest[both[0]]) if both else None


def _named(columns: Sequence[str], table: Table | None) -> dict[str, str]:
    """Return {column: name with its joint} of `field.position0` beside `field.name0` (`rostopic echo -p`).

    A column of names that changes from row to row names nothing.
    """
    out: dict[str, str] = {}
    for column in columns if table is not None else ():
        match = re.fullmatch(r"(.*\.)name(\d+)", column)
        values = {str(v).strip() for v in table.columns[column]} if match and table is not None else set()
        if match and len(values) == 1:
            kinds = ("position", "velocity", "effort")
            out |= {f"{match[1]}{kind}{match[2]}": f"{next(iter(values))}.{kind}" for kind in kinds}
    return out


def _entry(out: Proposal, kind: str, name: str, column: str, model: mujoco.MjModel) -> Any:
    unit = units.of_name(column)
    if kind == "effort" or unit is None or unit in units.TIMES or unit in ("rad", "rad/s"):
        return column
    entry: dict[str, Any] = {"column": column, "unit": unit}
    if unit == units.COUNTS:
        entry["resolution"] = 4096
        out.questions.append(f"{kind}.{name}: resolution (counts per turn) and `zero` of the encoder are guesses")
    if unit == units.PERCENT:
        joint = Channels.of(model).joints.index(name) if kind == "qpos" else None
        limited = joint is not None and model.jnt_limited[joint]
        entry["range"] = [float(x) for x in model.jnt_range[joint]] if limited else [0.0, 1.0]
        out.questions.append(f"{kind}.{name}: range (the channel at 0 and at 100 %) is a guess")
    if kind == "ctrl" and unit in units.CURRENTS:
        entry["torque_constant"] = 1.0
        out.questions.append(f"{kind}.{name}: torque_constant (N m per A) is a guess")
    return entry


def hint(columns: Sequence[str], model: mujoco.MjModel) -> str:
    """Return the tail of a refusal: the keys of a map that name the columns, and what none of them can be; or ""."""
    found = propose(columns, model)
    if not (found.qpos or found.qvel or found.ctrl):
        return ""
    keys = ", ".join(f"`{key}: {_short(block)}`" for key, block in found.blocks().items())
    text = f"; a map names them: {keys}"
    missing = missing_of(found, Channels.of(model))
    return f"{text}; also missing, and needed: {', '.join(missing)}" if missing else text


def missing_of(found: Proposal, channels: Channels) -> list[str]:
    """List the channels that a diagnosis needs and the proposal lacks."""
    lost = [f"ctrl:{name}" for name in channels.actuators if name not in found.ctrl]
    commands = [f"commands ({', '.join(lost)})"] if lost else []
    return ([] if found.time is not None else ["time (or `rate`, rows per second)"]) + commands


def _short(block: Any) -> str:
    if isinstance(block, Mapping):
        return "{" + ", ".join(f"{key}: {_short(value)}" for key, value in block.items()) + "}"
    return str(block)


__all__ = ["Proposal", "hint", "missing_of", "native", "propose"]
