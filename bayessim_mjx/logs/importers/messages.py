"""Messages of ROS, what is chosen among them, and their time stamps on one clock."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from bayessim_mjx.logs.importers.streams import Stream

STATE, IMU, CONTROLLER = "JointState", "Imu", "JointTrajectoryControllerState"
DYNAMIC, MULTI, LOW_STATE, LOW_COMMAND = "DynamicJointState", "MultiDOFJointState", "LowState", "LowCmd"
COMMANDS = ("Float64MultiArray", "Float64", "JointTrajectory", LOW_COMMAND)
STATES = (STATE, DYNAMIC, LOW_STATE, CONTROLLER)  # of several kinds the first is read
KINDS = (*STATES, MULTI, IMU, *COMMANDS)
FIELDS = ("position", "velocity", "effort")
FAR = 1_000_000_000  # ns between stamp and receipt: two clocks; rule of thumb, not measured
Kind = Literal["measured", "held", "linear"]


@dataclass(frozen=True)
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
