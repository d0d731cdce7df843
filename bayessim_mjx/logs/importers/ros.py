"""Messages of ROS, whatever file they come from, as a recording: joint states, commands of joints, IMUs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.importers.streams import Recording, Stream

STATE, IMU = "JointState", "Imu"
COMMANDS = ("Float64MultiArray", "Float64", "JointTrajectory")
KINDS = (STATE, IMU, *COMMANDS)
FIELDS = ("position", "velocity", "effort")
FAR = 1_000_000_000  # ns between stamp and receipt: two clocks
Kind = Literal["measured", "held", "linear"]


@dataclass(frozen=True)
class Message:
    """One message; `kind` is its type without the package, `received` in ns."""

    topic: str
    kind: str
    received: int
    body: Any

    @property
    def stamp(self) -> int:
        """ns of its header; of messages without one, or with 0 in it, when it was received."""
        stamp = getattr(getattr(self.body, "header", None), "stamp", None)
        if stamp is None:
            return self.received
        return int(stamp.sec) * 10**9 + int(stamp.nanosec) or self.received


@dataclass(frozen=True)
class Choice:
    """Which topics to read, and how; what is left open is found by the topics' types and names.

    Attributes:
        states: topic of the joint states.
        commands: {topic: names of its values, or none where messages name them}.
        field: position, velocity or effort, where a command has several.
        stamps: header, or received: when a message was recorded.
    """

    states: str | None = None
    commands: Mapping[str, Sequence[str]] | None = None
    field: str | None = None
    stamps: str = "header"


def recording(name: str, messages: Iterable[Message], choice: Choice) -> Recording:
    """The recording of one bag.

    Raises:
        UserError: topics that are missing or that cannot be told apart, arrays whose order is not known.
    """
    by_topic: dict[str, list[Message]] = defaultdict(list)
    for message in messages:
        if message.kind in KINDS:
            by_topic[message.topic].append(message)
    commands = _command_topics(name, by_topic, choice)
    states = _state_topic(name, by_topic, choice, commands)
    imus = [t for t, found in by_topic.items() if found[0].kind == IMU]
    clock = _Clock.of([m for t in (states, *commands, *imus) for m in by_topic[t]], choice.stamps)
    measured = {f: _joints(by_topic[states], f, clock) for f in FIELDS}
    sent: dict[str, Stream] = {}
    for topic, names in commands.items():
        streams = _commands(name, topic, by_topic[topic], names or (), list(measured["position"]), choice, clock)
        if twice := sorted(set(streams) & set(sent)):
            raise UserError(f"{name}: {topic} and another topic command {twice[0]!r}; choose by --commands TOPIC")
        sent |= streams
    others = {k: s for t in imus for k, s in _imu(t, by_topic[t], clock, len(imus) > 1).items()}
    notes = [f"{name}: states {states}; commands {', '.join(commands)}", *clock.notes]
    return Recording(name, measured["position"], sent, measured["velocity"], measured["effort"], others, notes)


@dataclass(frozen=True)
class _Clock:
    """Time stamps as seconds since `origin` (ns)."""

    origin: int
    received: bool
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, messages: Sequence[Message], stamps: str) -> _Clock:
        """By headers, unless they are of another clock than that of the messages that have none."""
        apart = float(np.median([abs(m.stamp - m.received) for m in messages if m.stamp != m.received] or [0]))
        bare = any(m.stamp == m.received for m in messages)
        mixed = stamps == "header" and bare and apart > FAR
        note = (
            f"headers are {apart * 1e-9:.3g} s away from the recorder's clock and commands have none: --stamps received"
        )
        by_receipt = stamps == "received" or mixed
        origin = min(m.received if by_receipt else m.stamp for m in messages)
        return cls(origin, by_receipt, (note,) if mixed else ())

    def __call__(self, message: Message) -> float:
        return ((message.received if self.received else message.stamp) - self.origin) * 1e-9


def _told(by_topic: Mapping[str, list[Message]]) -> str:
    return ", ".join(f"{topic} ({found[0].kind})" for topic, found in by_topic.items()) or "none of use"


def _command_topics(name: str, by_topic: Mapping[str, list[Message]], choice: Choice) -> Mapping[str, Sequence[str]]:
    if choice.commands:
        absent = [t for t in choice.commands if t not in by_topic]
        if absent:
            raise UserError(f"{name}: --commands {absent[0]}: no such topic; it has {_told(by_topic)}")
        return choice.commands
    found = {t: () for t, m in by_topic.items() if m[0].kind in COMMANDS or (m[0].kind == STATE and "command" in t)}
    if not found:
        raise UserError(f"{name}: no topic of commands; it has {_told(by_topic)}; allowed: --commands TOPIC")
    return found


def _state_topic(name: str, by_topic: Mapping[str, list[Message]], choice: Choice, commands: Iterable[str]) -> str:
    found = [t for t, m in by_topic.items() if m[0].kind == STATE and t not in commands]
    if choice.states is not None:
        if choice.states not in found:
            raise UserError(f"{name}: --states {choice.states}: no topic of JointState; it has {_told(by_topic)}")
        return choice.states
    named = [t for t in found if t.rpartition("/")[2] == "joint_states"]
    best = found if len(found) == 1 else named
    if len(best) != 1:
        raise UserError(
            f"{name}: {len(found)} topics of joint states; it has {_told(by_topic)}; allowed: --states TOPIC"
        )
    return best[0]


def _joints(messages: Sequence[Message], field: str, clock: _Clock, kind: Kind = "measured") -> dict[str, Stream]:
    """{joint: stream} of one field, whatever the order of joints in each message; fields may be empty."""
    samples: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for message in messages:
        values = getattr(message.body, field)
        for joint, value in zip(message.body.name, values, strict=False):
            if np.isfinite(value):
                samples[str(joint)].append((clock(message), float(value)))
    return _streams(samples, kind)


def _streams(samples: Mapping[str, Sequence[tuple[float, float]]], kind: Kind) -> dict[str, Stream]:
    return {
        joint: Stream(np.array([t for t, _ in s]), np.array([x for _, x in s]), kind) for joint, s in samples.items()
    }


def _commands(
    name: str,
    topic: str,
    messages: Sequence[Message],
    names: Sequence[str],
    joints: Sequence[str],
    choice: Choice,
    clock: _Clock,
) -> dict[str, Stream]:
    kind = messages[0].kind
    if kind == STATE:
        return _joints(messages, _field(name, topic, [m.body for m in messages], FIELDS, choice), clock, "held")
    if kind == "JointTrajectory":
        return _trajectory(name, topic, messages, choice, clock)
    each = [np.atleast_1d(np.asarray(m.body.data, float)) for m in messages]
    names = names or _order(name, topic, messages[0], len(each[0]), joints)
    for message, values in zip(messages, each, strict=True):
        if len(values) != len(names):
            at = f"{name}: {topic} at {clock(message):.6g} s has {len(values)} values"
            raise UserError(f"{at}; allowed: {len(names)} ({', '.join(names)})")
    time = np.array([clock(m) for m in messages])
    return {joint: Stream(time, np.array([v[i] for v in each]), "held") for i, joint in enumerate(names)}


def _order(name: str, topic: str, message: Message, count: int, joints: Sequence[str]) -> Sequence[str]:
    """Names of an array's values: its layout's label, or the only joint that there is."""
    dims: Sequence[Any] = getattr(getattr(message.body, "layout", None), "dim", ())
    labels = [label.strip() for label in dims[0].label.split(",")] if len(dims) else []
    if len(labels) == count and all(labels):
        return labels
    if count == len(joints) == 1:
        return joints
    allowed = f"allowed: --commands {topic}={','.join(joints[:count]) or 'JOINT'} with the joints in their order"
    raise UserError(f"{name}: {topic} does not say which of its {count} values is whose; {allowed}")


def _field(name: str, topic: str, bodies: Sequence[Any], fields: Sequence[str], choice: Choice) -> str:
    """The field that holds the commands."""
    filled = [f for f in fields if any(len(getattr(b, f)) for b in bodies)]
    wanted = [f for f in filled if choice.field is not None and f.startswith(choice.field)]
    if len(wanted or filled) != 1 or (choice.field is not None and not wanted):
        has = " and ".join(filled) or "nothing"
        raise UserError(f"{name}: {topic} commands {has}; allowed: --field position, velocity or effort, one it has")
    return (wanted or filled)[0]


def _trajectory(name: str, topic: str, messages: Sequence[Message], choice: Choice, clock: _Clock) -> dict[str, Stream]:
    """Points run linearly from one to the next; a new message takes the place of what is left of the one before."""
    points = [point for m in messages for point in m.body.points]
    fields = ("positions", "velocities", "effort")
    first = Choice(field=choice.field or next((f[:5] for f in fields if any(len(getattr(p, f)) for p in points)), None))
    field = _field(name, topic, points, fields, first)
    samples: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for message in messages:
        began = clock(message)
        for pairs in samples.values():
            pairs[:] = [pair for pair in pairs if pair[0] < began]
        for point in message.body.points:
            ahead = point.time_from_start.sec + point.time_from_start.nanosec * 1e-9
            for joint, value in zip(message.body.joint_names, getattr(point, field), strict=False):
                samples[str(joint)].append((began + ahead if len(message.body.points) > 1 else began, float(value)))
    several = any(len(m.body.points) > 1 for m in messages)
    return _streams(samples, "linear" if several else "held")


def _imu(topic: str, messages: Sequence[Message], clock: _Clock, several: bool) -> dict[str, Stream]:
    time = np.array([clock(m) for m in messages])
    prefix = f"{topic.strip('/').replace('/', '.')}." if several else "imu."
    out = {}
    for quantity, short in (("angular_velocity", "gyro"), ("linear_acceleration", "accelerometer")):
        for axis in "xyz":
            values = np.array([getattr(getattr(m.body, quantity), axis) for m in messages])
            out[f"{prefix}{short}.{axis}"] = Stream(time, values)
    return out
