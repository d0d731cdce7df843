"""Which column may be which channel: proposed from the names of columns, joints and actuators, for a map to edit."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import units, vendors
from bayessim_mjx.logs.check import STREAMS
from bayessim_mjx.logs.log import Channels
from bayessim_mjx.logs.table import Table

_WORDS = {  # of a column's name, besides that of the joint; the first kind that has one of them wins
    "ctrl": "cmd command commands commanded target goal desired des ctrl control setpoint sp ref reference action u "
    "soll sollwert consigne",
    "effort": "effort torque tau current load force iq moment",
    "qvel": "vel velocity velocities speed qd dq qvel omega rate",
    "qpos": "pos position positions q angle qpos actual measured meas present state joint encoder enc ist istwert "
    "winkel",
}
KINDS = {kind: frozenset(words.split()) for kind, words in _WORDS.items()}
_CLOCK = frozenset(
    ("t", "time", "timestamp", "timestamps", "stamp", "stamps", "zeit", "clock", "sec", "secs", "seconds")
)
_PART = re.compile(r"[A-Z]+(?=[A-Z][a-z])|[A-Z]?[a-z]+|[A-Z]+|\d+")
_UNIT = re.compile(r"\s*[\[(<{][^\])>}]*[\])>}]\s*$")


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


def parts(name: str) -> tuple[str, ...]:
    """Words of a name without its unit: `shoulderPos_deg` -> shoulder, pos."""
    words = [word.lower() for word in _PART.findall(_UNIT.sub("", name))]
    if len(words) > 1 and units.of_name(name) is not None and units.of_name(f"x_{words[-1]}") is not None:
        words.pop()
    return tuple(words)


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
    clocks = [c for c in columns if _is_clock(c)]
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
        channel = None if column in clocks else _channel(named.get(column, column), model)
        if channel is not None:
            found.setdefault(channel, []).append(column)
    for (kind, name), own in found.items():
        if len(own) > 1:
            out.questions.append(f"{kind}.{name} may be {' or '.join(own)}; the map takes none of them")
            continue
        block = out.streams if kind == "effort" else getattr(out, kind)
        block[f"effort:{name}" if kind == "effort" else name] = _entry(out, kind, name, own[0], model)
    if out.qvel and set(out.qvel) != set(Channels.of(model).qvel):
        out.questions.append("qvel names some joints only; `diagnose` allows that, `real.logs` needs all or none")
    return out


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
        drive = _actuator_of(model, channels, joint)
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


def _is_clock(column: str) -> bool:
    words = parts(column)
    return bool(words) and (set(words) <= _CLOCK or (len(words) == 1 and units.of_name(column) in units.TIMES))


def _channel(column: str, model: mujoco.MjModel) -> tuple[str, str] | None:
    """(kind, channel) that a column's name suggests, or None."""
    channels = Channels.of(model)
    words = parts(column)
    single = [j for j, kind in zip(channels.joints, channels.kinds, strict=True) if kind in ("hinge", "slide")]
    joint, actuator = _longest(words, single), _longest(words, channels.actuators)
    if joint is None and actuator is None:
        return None
    by_drive = actuator is not None and (joint is None or len(parts(actuator)) > len(parts(joint)))
    rest = set(words) - set(parts(str(actuator if by_drive else joint)))
    kind = next((k for k, known in KINDS.items() if rest & known), "ctrl" if by_drive else "qpos")
    if kind in ("qpos", "qvel"):
        own = joint if joint is not None else _joint_of(model, channels, str(actuator))
        return None if own is None else (kind, own)
    drive = actuator if by_drive else _actuator_of(model, channels, str(joint))
    return None if drive is None else (kind, drive)


def _longest(words: Sequence[str], names: Iterable[str]) -> str | None:
    """Return the name whose words stand in a row among these; the longest, if it is the only one of its length."""
    fits: dict[int, list[str]] = {}
    for name in names:
        own = parts(name)
        if own and any(tuple(words[i : i + len(own)]) == own for i in range(len(words))):
            fits.setdefault(len(own), []).append(name)
    best = fits[max(fits)] if fits else []
    return best[0] if len(best) == 1 else None


def drives(model: mujoco.MjModel, joint: int) -> list[int]:
    """Return the numbers of the actuators on a joint."""
    types = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    on_joint = np.isin(model.actuator_trntype, types)
    return [int(i) for i in np.flatnonzero(on_joint & (model.actuator_trnid[:, 0] == joint))]


def _actuator_of(model: mujoco.MjModel, channels: Channels, joint: str) -> str | None:
    own = drives(model, channels.joints.index(joint))
    return channels.actuators[own[0]] if len(own) == 1 else None


def _joint_of(model: mujoco.MjModel, channels: Channels, actuator: str) -> str | None:
    own = [j for j in range(model.njnt) if channels.actuators.index(actuator) in drives(model, j)]
    return channels.joints[own[0]] if len(own) == 1 else None


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


__all__ = ["Proposal", "drives", "hint", "missing_of", "native", "parts", "propose"]
