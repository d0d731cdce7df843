"""Messages of ROS, what is chosen among them, and their time stamps on one clock."""

from __future__ import annotations

import struct
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.importers.cdr import faster
from bayessim_mjx.logs.importers.needs import needs
from bayessim_mjx.logs.importers.streams import Stream
from bayessim_mjx.logs.log import Array

STATE, IMU, CONTROLLER = "JointState", "Imu", "JointTrajectoryControllerState"
DYNAMIC, MULTI, LOW_STATE, LOW_COMMAND = "DynamicJointState", "MultiDOFJointState", "LowState", "LowCmd"
COMMANDS = ("Float64MultiArray", "Float64", "JointTrajectory", LOW_COMMAND)
STATES = (STATE, DYNAMIC, LOW_STATE, CONTROLLER)  # of several kinds the first is read
KINDS = (*STATES, MULTI, IMU, *COMMANDS)
FIELDS = ("position", "velocity", "effort")
FAR = 1_000_000_000  # ns between stamp and receipt: two clocks; rule of thumb, not measured
Kind = Literal["measured", "held", "linear"]


@dataclass(frozen=True, slots=True)
class Message:
    """One message; `kind` is its type without the package, `received` in ns.

    Of a topic that cannot be read one message stands for all: its kind is the whole type, its body None. `publisher` is
    what the file says of the sender, or "".
    """

    topic: str
    kind: str
    received: int
    body: Any
    publisher: str = ""

    @property
    def stamp(self) -> int:
        """ns of its header; of messages without one, or with 0 in it, when it was received."""
        stamp = getattr(getattr(self.body, "header", None), "stamp", None)
        if stamp is None:
            return self.received
        return int(stamp.sec) * 10**9 + int(stamp.nanosec) or self.received


@dataclass(frozen=True)
class Choice:
    """Which topics to read, and how; the rest is found by the topics' types and names.

    Attributes:
        states: topic of the joint states.
        commands: {topic: names of its values, or none where messages name them}.
        field: position, velocity or effort, where a command has several.
        stamps: header, or received: when a message was recorded.
        publisher: which of several publishers of the joint states, from 1.
        targets: the model's actuators are position servos, so the targets of a controller are their commands.
        joints: names of motors that are numbered, in their order; hinges: the model's joints, which name them too.
    """

    states: str | None = None
    commands: Mapping[str, Sequence[str]] | None = None
    field: str | None = None
    stamps: str = "header"
    publisher: int | None = None
    targets: bool = False
    joints: Sequence[str] = ()
    hinges: Sequence[str] = ()


@dataclass(frozen=True)
class Clock:
    """Time stamps as seconds since `origin` (ns)."""

    origin: int
    received: bool
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, messages: Sequence[Message], stamps: str) -> Clock:
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


def streams(samples: Mapping[str, Sequence[tuple[float, float]]], kind: Kind) -> dict[str, Stream]:
    return {
        joint: Stream(np.array([t for t, _ in s]), np.array([x for _, x in s]), kind) for joint, s in samples.items()
    }


def tracks(messages: Sequence[Message], what: str, when: Callable[[Message], float]) -> dict[str, tuple[Array, Array]]:
    """{joint: (times, finite values)} of one field of joint states, in the order of the messages.

    Args:
        what: position, velocity or effort. when: time of a message.
    """
    groups: dict[tuple[Any, int], list[int]] = defaultdict(list)
    for i, message in enumerate(messages):
        groups[tuple(message.body.name), len(getattr(message.body, what))].append(i)
    time = np.array([when(m) for m in messages], float)
    found: dict[str, list[tuple[NDArray[np.int64], Array]]] = defaultdict(list)
    for (names, count), rows in groups.items():
        table = np.array([getattr(messages[i].body, what) for i in rows], float).reshape(len(rows), count)
        for joint, values in zip(names, table.T, strict=False):
            seen = np.isfinite(values)
            if seen.any():
                found[str(joint)].append((np.array(rows)[seen], values[seen]))
    out = {}
    for joint, pieces in found.items():
        at, values = (np.concatenate(each) for each in zip(*pieces, strict=True))
        order = np.argsort(at, kind="stable")
        out[joint] = time[at[order]], values[order]
    return out


# MCAP files and ROS bags as messages; the packages that read them are imported here and nowhere else


def of_mcap(path: Path) -> Iterator[Message]:
    """Messages of an MCAP file with ROS 2 messages (CDR).

    Of a file without its end, as a recorder leaves it that was killed, all whole messages are read, with a warning.

    Raises:
        UserError: the packages are missing, or the file is none.
    """
    readers = needs("mcap.reader", "from-mcap", "mcap")
    decoder = needs("mcap_ros2.decoder", "from-mcap", "mcap-ros2-support").DecoderFactory()
    errors = (needs("mcap.exceptions", "from-mcap", "mcap").McapError, EOFError, struct.error, OSError)
    read = 0
    try:
        with path.open("rb") as file:
            reader, listed = _opened(readers, file, errors)
            unread = {i: kind for i, (_, kind, used) in listed.items() if not used}
            yield from (Message(listed[i][0], kind, 0, None) for i, kind in unread.items())
            topics = [topic for topic, _, used in listed.values() if used]
            if listed and not topics:  # an empty list would mean all of them
                return
            decoders: dict[int, Any] = {}
            for schema, channel, message in reader.iter_messages(topics=topics or None, log_time_order=False):
                kind, used = _kind(_name(schema), channel.message_encoding)
                if not used and channel.id not in unread:  # one message says that the topic is not read
                    unread[channel.id] = kind
                    yield Message(channel.topic, kind, 0, None)
                if used:
                    if channel.id not in decoders:
                        decoders[channel.id] = faster(_short(kind), decoder.decoder_for("cdr", schema))
                    body = decoders[channel.id](message.data)
                    read += 1
                    sent = int(message.publish_time or message.log_time)
                    yield Message(channel.topic, _short(kind), sent, body, str(channel.id))
    except errors as error:
        why = f"{type(error).__name__}{f': {error}' if str(error) else ''}"
        mend = "`mcap recover` mends a file whose recorder was killed"
        if not read:
            text = f"{path}: not a readable MCAP file of ROS 2 messages ({why}); allowed: an .mcap file"
            raise UserError(f"{text}; {mend}") from None
        warnings.warn(f"{path}: it ends in the middle ({why}); {read} messages before are read; {mend}", stacklevel=2)


def _opened(
    readers: Any, file: Any, errors: tuple[type[Exception], ...]
) -> tuple[Any, dict[int, tuple[str, str, bool]]]:
    """Open an MCAP file: (a reader, {channel: (topic, type, whether it is read)}).

    Of a file without its end it is a reader from the start, and nothing is listed.
    """
    try:
        reader = readers.make_reader(file)
        summary = reader.get_summary()
    except errors:
        summary = None
    if summary is None or not summary.channels:
        file.seek(0)
        return readers.NonSeekingReader(file), {}
    names = {c.id: _name(summary.schemas.get(c.schema_id)) for c in summary.channels.values()}
    return reader, {c.id: (c.topic, *_kind(names[c.id], c.message_encoding)) for c in summary.channels.values()}


def _kind(name: str, encoding: str) -> tuple[str, bool]:
    """(type of a channel's messages, whether it is read); of types that could be, how they are written otherwise."""
    if _short(name) not in KINDS or encoding == "cdr":
        return name, _short(name) in KINDS
    return f"{name} written in {encoding}", False


def of_rosbag(path: Path) -> Iterator[Message]:
    """Messages of a ROS 1 bag (a file), or of a ROS 2 bag (a folder).

    Raises:
        UserError: the package is missing, or the bag is none.
    """
    highlevel = needs("rosbags.highlevel", "from-rosbag", "rosbags")
    typesys = needs("rosbags.typesys", "from-rosbag", "rosbags")
    store = typesys.get_typestore(typesys.Stores.LATEST)  # for bags of ROS 2 that do not hold their types
    try:
        with highlevel.AnyReader([path], default_typestore=store) as reader:
            known = reader.typestore.fielddefs  # of a bag that does not hold its types, the usual ones
            wanted = [c for c in reader.connections if _short(c.msgtype) in KINDS and c.msgtype in known]
            for c in reader.connections:
                if c not in wanted:
                    yield Message(c.topic, c.msgtype, 0, None)
            for connection, received, raw in reader.messages(connections=wanted) if wanted else ():
                body = reader.deserialize(raw, connection.msgtype)
                sender = str(getattr(connection.ext, "callerid", None) or "")
                yield Message(connection.topic, _short(connection.msgtype), int(received), body, sender)
    except highlevel.AnyReaderError as error:
        raise UserError(
            f"{path}: not a readable ROS bag ({error}); allowed: a .bag file or the folder of a bag"
        ) from None


def _name(schema: Any) -> str:
    return str(schema.name) if schema else ""


def _short(name: str) -> str:
    return name.rpartition("/")[2]
