"""Messages of other types as joint states and commands: ros2_control's, joints of several numbers, Unitree's motors."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import vendors
from bayessim_mjx.logs.importers.messages import CONTROLLER, FIELDS, Choice, Clock, Message, streams
from bayessim_mjx.logs.importers.streams import Stream

STOP = 2.146e9  # rad; a target that switches the position loop off: unitree_sdk2, PosStopF. Source: its examples


def dynamic(message: Message) -> Message:
    """Turn `DynamicJointState` into one of `JointState`; what a joint has no interface for is NaN."""
    body = message.body
    values = [dict(zip(each.interface_names, each.values, strict=False)) for each in body.interface_values]
    fields = {f: [v.get(f, float("nan")) for v in values] if any(f in v for v in values) else [] for f in FIELDS}
    new = SimpleNamespace(header=body.header, name=list(body.joint_names), **fields)
    return dataclasses.replace(message, body=new)


def other_interfaces(messages: Sequence[Message], clock: Clock) -> dict[str, Stream]:
    """Further interfaces of `DynamicJointState`, as columns `current:<joint>`."""
    samples: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for message in messages:
        for joint, each in zip(message.body.joint_names, message.body.interface_values, strict=False):
            for name, value in zip(each.interface_names, each.values, strict=False):
                if name not in FIELDS and np.isfinite(value):
                    samples[f"{name}:{joint}"].append((clock(message), float(value)))
    return streams(samples, "measured")


def multi(messages: Sequence[Message], clock: Clock) -> dict[str, Stream]:
    """Poses of `MultiDOFJointState` as positions `root[0]` ... `root[6]`: x y z, then the quaternion w x y z.

    Their twists are left out: the message does not say in which frame they are.
    """
    rows: dict[str, list[list[float]]] = defaultdict(list)
    for message in messages:
        for joint, pose in zip(message.body.joint_names, message.body.transforms, strict=False):
            p, q = pose.translation, pose.rotation
            rows[str(joint)].append([clock(message), p.x, p.y, p.z, q.w, q.x, q.y, q.z])
    out: dict[str, Stream] = {}
    for joint, values in rows.items():
        table = np.array(values)
        flips = np.sum(table[1:, 4:] * table[:-1, 4:], axis=1) < 0  # q and -q are one attitude
        table[1:, 4:] *= np.cumprod(np.where(flips, -1.0, 1.0))[:, None]
        out |= {f"{joint}[{i}]": Stream(table[:, 0], table[:, i + 1]) for i in range(7)}
    return out


def low_state(message: Message, motors: Mapping[int, str]) -> Message:
    """Turn Unitree's `LowState` into one of `JointState`; it has no stamp, so that of its receipt counts."""
    used = {i: m for i, m in enumerate(message.body.motor_state) if i in motors}
    fields = {"position": "q", "velocity": "dq", "effort": "tau_est"}
    read = {f: [float(getattr(m, own)) for m in used.values()] for f, own in fields.items()}
    return dataclasses.replace(message, body=SimpleNamespace(name=[motors[i] for i in used], **read))


def low_imu(messages: Sequence[Message], clock: Clock) -> dict[str, Stream]:
    """Return the IMU of Unitree's `LowState`, where it has one, as columns `imu.gyro.x`, `imu.accelerometer.x` ..."""
    time = np.array([clock(m) for m in messages])
    out: dict[str, Stream] = {}
    for field, short in (("gyroscope", "gyro"), ("accelerometer", "accelerometer")):
        rows = [getattr(getattr(m.body, "imu_state", None), field, ()) for m in messages]
        if all(len(row) == 3 for row in rows):
            out |= {f"imu.{short}.{x}": Stream(time, c) for x, c in zip("xyz", np.array(rows, float).T, strict=True)}
    return out


def motors_of(name: str, messages: Sequence[Message], choice: Choice) -> dict[int, str]:
    """Return {number: joint} of the motors that a message numbers.

    Raises:
        UserError: nobody says which is which.
    """
    count = len(
        messages[0].body.motor_state if hasattr(messages[0].body, "motor_state") else messages[0].body.motor_cmd
    )
    if choice.joints:
        if len(choice.joints) > count:
            raise UserError(f"{name}: --joints names {len(choice.joints)}; allowed: {count} motors at most")
        return dict(enumerate(choice.joints))
    if not choice.hinges:
        raise UserError(
            f"{name}: motors are numbered; allowed: --model FILE, or --joints NAME ... in the motors' order"
        )
    return vendors.motors("Unitree", choice.hinges)


def low_commands(
    topic: str, messages: Sequence[Message], motors: Mapping[int, str], measured: Mapping[str, Mapping[str, Stream]],
    choice: Choice, clock: Clock,
) -> tuple[dict[str, Stream], dict[str, Any], list[str]]:  # fmt: skip
    """(commands, laws of the drives, notes) of Unitree's `LowCmd`: u = kp (q* - q) + kd (dq* - dq) + tau.

    Targets are the commands of position servos. Of motors under a law that stays they are too, moved by
    (kd dq* + tau) / kp; else the sum is made here, of positions and velocities as they were measured.
    """
    time = np.array([clock(m) for m in messages])
    sent: dict[str, Stream] = {}
    laws: dict[str, Any] = {}
    notes: list[str] = []
    for number, joint in motors.items():
        each = [m.body.motor_cmd[number] for m in messages]
        column = {k: np.array([float(getattr(m, k)) for m in each]) for k in ("q", "dq", "tau", "kp", "kd")}
        held = np.abs(column["q"]) < STOP
        kind, law = vendors.law_of(
            {"kp": column["kp"], "kd": column["kd"], "speed": column["dq"], "ahead": column["tau"]}
        )
        if choice.targets:
            sent[joint] = Stream(time[held], column["q"][held], "held")
        elif law:
            shift = (column["kd"] * column["dq"] + column["tau"]) / column["kp"]
            sent[joint] = Stream(time[held], (column["q"] + shift)[held], "held")
            laws[joint] = law
        elif kind == "ahead":
            sent[joint] = Stream(time, column["tau"], "held")
        else:
            q, w = (measured[f][joint].on(time) for f in ("position", "velocity"))
            loop = column["kp"] * np.where(held, column["q"] - q, 0.0) + column["kd"] * (column["dq"] - w)
            summed = loop + column["tau"]
            known = np.isfinite(summed)
            sent[joint] = Stream(time[known], summed[known], "held")
            notes.append(joint)
    said = [f"{topic}: kp (q* - q) + kd (dq* - dq) + tau is summed of {', '.join(notes)}"] if notes else []
    return {j: s for j, s in sent.items() if len(s.time)}, laws, said


def enabled(messages: Sequence[Message], motors: Mapping[int, str], clock: Clock) -> Iterator[tuple[str, Stream]]:
    """(column, stream) of motors that were off in between: `enabled:<joint>`, 0 where their mode was 0."""
    time = np.array([clock(m) for m in messages])
    for number, joint in motors.items():
        on = np.array([float(m.body.motor_cmd[number].mode != 0) for m in messages])
        if np.ptp(on) > 0:
            yield f"enabled:{joint}", Stream(time, on, "held")


# a field of `JointState` or --field, and that of a point of a trajectory
POINT = {"position": "positions", "velocity": "velocities", "effort": "effort"}
# what was wanted, what was measured, what was sent to the drives: ROS 2's names first, then those of ROS 1
WANTED, SEEN, SENT = ("reference", "desired"), ("feedback", "actual"), ("output",)


def _point(body: Any, names: Sequence[str]) -> Any:
    """Return the first of the points that holds anything, or None."""
    found = [getattr(body, name) for name in names if getattr(body, name, None) is not None]
    return next((p for p in found if any(len(getattr(p, f)) for f in POINT.values())), None)


def state_of(message: Message) -> Message:
    """Return the message as one of `JointState`: of a controller, what it measured."""
    if message.kind != CONTROLLER:
        return message
    point = _point(message.body, SEEN)
    fields = {f: () if point is None else getattr(point, p) for f, p in POINT.items()}
    body = SimpleNamespace(header=message.body.header, name=list(message.body.joint_names), **fields)
    return dataclasses.replace(message, body=body)


def _used(messages: Sequence[Message], choice: Choice) -> tuple[tuple[str, ...], str]:
    """(points, field) that hold the commands: the output where it is filled, else the positions that were wanted."""

    def filled(names: Sequence[str], field: str) -> bool:
        points = (_point(m.body, names) for m in messages)
        values = (getattr(p, POINT[field]) for p in points if p is not None)
        return any(len(v) and np.isfinite(np.asarray(v, float)).any() for v in values)

    if choice.field == "position" or (choice.field is None and choice.targets):
        order = [(WANTED, "position"), (SENT, "position")]
    elif choice.field is not None:
        order = [(SENT, choice.field), (WANTED, choice.field)]
    else:
        order = [*((SENT, f) for f in ("effort", "velocity", "position")), (WANTED, "position")]
    found = [(names, field) for names, field in order if filled(names, field)]
    sent = [field for names, field in found if names == SENT]
    if choice.field is None and not choice.targets and len(sent) > 1:
        return (), " and ".join(sent)
    return found[0] if found else ((), "")


def of_controller(
    name: str, topic: str, messages: Sequence[Message], choice: Choice, clock: Clock
) -> dict[str, Stream]:
    """Commands by joint.

    Raises:
        UserError: nothing of that kind in the messages, or an output of several kinds.
    """
    points, field = _used(messages, choice)
    if not points:
        has = f"an output of {field}" if field else "neither targets nor an output of that kind"
        raise UserError(f"{name}: {topic} holds {has}; allowed: --field position, velocity or effort, one it has")
    return _of_points(messages, points, field, clock)


def _of_points(messages: Sequence[Message], names: Sequence[str], field: str, clock: Clock) -> dict[str, Stream]:
    samples: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for message in messages:
        point = _point(message.body, names)
        values = () if point is None else getattr(point, POINT[field])
        for joint, value in zip(message.body.joint_names, values, strict=False):
            if np.isfinite(value):
                samples[str(joint)].append((clock(message), float(value)))
    return streams(samples, "held")


def field_used(messages: Sequence[Message], choice: Choice) -> str:
    """Name the part of a controller's messages that holds the commands; "" for other messages."""
    if messages[0].kind != CONTROLLER:
        return ""
    points, field = _used(messages, choice)
    body = messages[0].body
    own = next((p for p in points if getattr(body, p, None) is not None), "")
    return f"commands are {own}.{POINT[field]}" if own else ""


def targets(messages: Sequence[Message], clock: Clock) -> dict[str, Stream]:
    """Positions that were wanted, as further columns `target:<joint>`."""
    return {f"target:{joint}": s for joint, s in _of_points(messages, WANTED, "position", clock).items()}


__all__ = [
    "dynamic",
    "enabled",
    "field_used",
    "low_commands",
    "low_imu",
    "low_state",
    "motors_of",
    "multi",
    "of_controller",
    "other_interfaces",
    "state_of",
    "targets",
]
