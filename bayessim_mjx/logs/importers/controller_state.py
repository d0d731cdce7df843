"""Messages of `JointTrajectoryControllerState` as targets, commands and joint states."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.importers.messages import CONTROLLER, Choice, Clock, Message, streams
from bayessim_mjx.logs.importers.streams import Stream

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


__all__ = ["field_used", "of_controller", "state_of", "targets"]
