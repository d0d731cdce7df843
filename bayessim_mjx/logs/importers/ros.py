"""Messages of ROS, whatever file they come from, as a recording: joint states, commands of joints, IMUs."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.importers import adapted
from bayessim_mjx.logs.importers.messages import (
    COMMANDS,
    CONTROLLER,
    DYNAMIC,
    FIELDS,
    IMU,
    KINDS,
    LOW_COMMAND,
    LOW_STATE,
    MULTI,
    STATE,
    STATES,
    Choice,
    Clock,
    Kind,
    Message,
    streams,
    tracks,
)
from bayessim_mjx.logs.importers.publishers import better_order, of_one_publisher, several_senders
from bayessim_mjx.logs.importers.streams import Recording, Stream
from bayessim_mjx.quantities import percent


def recording(name: str, messages: Iterable[Message], choice: Choice) -> Recording:
    """Return the recording of one bag.

    Raises:
        UserError: topics that are missing or that cannot be told apart, arrays whose order is not known.
    """
    topics = _Topics()
    for message in messages:
        if message.kind in KINDS:
            topics.of[message.topic].append(message)
        else:
            topics.unread[message.topic] = message.kind
    by_topic = topics.of
    for found in by_topic.values():
        found.sort(key=lambda message: message.received)
    commands = _command_topics(name, topics, choice)
    states = _state_topic(name, topics, choice, commands)
    imus, bodies = topics.of_kind(IMU), topics.of_kind(MULTI)
    read = dict.fromkeys((*([states] if states else []), *commands, *imus, *bodies))
    clock = Clock.of([m for t in read for m in by_topic[t]], choice.stamps)
    messages = _states(name, by_topic[states], choice) if states else []
    messages = of_one_publisher(name, states, messages, choice.publisher, clock.received)
    measured = {f: _joints(messages, f, clock) for f in FIELDS}
    for topic in bodies:
        measured["position"] |= adapted.multi(by_topic[topic], clock)
    sent, others, laws, notes = _sent(name, commands, by_topic, measured, choice, clock)
    if states and by_topic[states][0].kind == DYNAMIC:
        others |= adapted.other_interfaces(by_topic[states], clock)
    if states and by_topic[states][0].kind == LOW_STATE:
        others |= adapted.low_imu(by_topic[states], clock)
    others |= {k: s for t in imus for k, s in _imu(t, by_topic[t], clock, len(imus) > 1).items()}
    said = [
        f"{name}: states {', '.join(filter(None, (states, *bodies)))}; commands {', '.join(commands)}",
        *clock.notes,
    ]
    notes = [*said, *notes, *several_senders(name, commands, by_topic)]
    if topics.unread:
        notes.append(f"{name}: not read, as their types are not known here: {topics.left()}")
    return Recording(name, measured["position"], sent, measured["velocity"], measured["effort"], others, notes, laws)


def _states(name: str, messages: Sequence[Message], choice: Choice) -> list[Message]:
    """Return the messages as ones of `JointState`."""
    kind = messages[0].kind
    if kind == LOW_STATE:
        motors = adapted.motors_of(name, messages, choice)
        return [adapted.low_state(m, motors) for m in messages]
    return [adapted.dynamic(m) if kind == DYNAMIC else adapted.state_of(m) for m in messages]


def _sent(
    name: str,
    topics: Mapping[str, Sequence[str]],
    by_topic: Mapping[str, Sequence[Message]],
    measured: Mapping[str, dict[str, Stream]],
    choice: Choice,
    clock: Clock,
) -> tuple[dict[str, Stream], dict[str, Stream], dict[str, Any], list[str]]:
    """(commands, further columns, laws of the drives, notes) of all topics of commands."""
    sent: dict[str, Stream] = {}
    others: dict[str, Stream] = {}
    laws: dict[str, Any] = {}
    notes: list[str] = []
    for topic, names in topics.items():
        found = by_topic[topic]
        if found[0].kind == LOW_COMMAND:
            motors = adapted.motors_of(name, found, choice)
            new, law, said = adapted.low_commands(topic, found, motors, measured, choice, clock)
            laws |= law
            notes += [f"{name}: {text}" for text in said]
            others |= dict(adapted.enabled(found, motors, clock))
        else:
            new = _commands(name, topic, found, names or (), list(measured["position"]), choice, clock)
            notes += [f"{name}: {topic}: {used}" for used in [adapted.field_used(found, choice)] if used]
        if twice := sorted(set(new) & set(sent)):
            raise UserError(f"{name}: {topic} and another topic command {twice[0]!r}; choose by --commands TOPIC")
        if found[0].kind == CONTROLLER:
            others |= adapted.targets(found, clock)
        if hasattr(found[0].body, "data"):
            found_order = better_order(new, measured)
            if found_order is not None:
                (given, better), shares = (",".join(x) for x in found_order[:2]), [*map(percent, found_order[2])]
                why = f"explains {shares[1]} in place of {shares[0]}"
                text = f"{name}: {topic}: the motion fits the order {better} far better than {given} ({why})"
                notes.append(f"{text}: --commands {topic}={better}, if that is the controller's order")
        sent |= new
    return sent, others, laws, notes


@dataclass
class _Topics:
    """Messages by topic, and the types of topics that cannot be read."""

    of: dict[str, list[Message]] = field(default_factory=lambda: defaultdict(list))
    unread: dict[str, str] = field(default_factory=dict)

    def sentence(self) -> str:
        read = ", ".join(f"{topic} ({found[0].kind})" for topic, found in self.of.items()) or "none of use"
        return f"it has {read}" + (f"; cannot be read: {self.left()}" if self.unread else "")

    def left(self) -> str:
        return ", ".join(f"{topic} ({kind})" for topic, kind in sorted(self.unread.items()))

    def of_kind(self, *kinds: str) -> list[str]:
        return [t for t, found in self.of.items() if found[0].kind in kinds]


def _command_topics(name: str, topics: _Topics, choice: Choice) -> Mapping[str, Sequence[str]]:
    if choice.commands:
        absent = [t for t in choice.commands if t not in topics.of]
        if absent:
            raise UserError(f"{name}: --commands {absent[0]}: no such topic; {topics.sentence()}")
        return choice.commands
    found = [*topics.of_kind(*COMMANDS), *(t for t in topics.of_kind(STATE) if "command" in t)]
    found = found or topics.of_kind(CONTROLLER)  # where nothing else commands, a controller reports its reference
    if not found:
        raise UserError(f"{name}: no topic of commands; {topics.sentence()}; allowed: --commands TOPIC")
    return {topic: () for topic in found}


def _state_topic(name: str, topics: _Topics, choice: Choice, commands: Iterable[str]) -> str:
    by_kind = [[t for t in topics.of_kind(kind) if kind != STATE or t not in commands] for kind in STATES]
    if choice.states is not None:
        if choice.states not in sum(by_kind, []):
            raise UserError(f"{name}: --states {choice.states}: no topic of joint states; {topics.sentence()}")
        return choice.states
    found = next((each for each in by_kind if each), [])
    if not found and topics.of_kind(MULTI):
        return ""
    named = [t for t in found if t.rpartition("/")[2] == "joint_states"]
    best = found if len(found) == 1 else named
    if len(best) != 1:
        raise UserError(f"{name}: {len(found)} topics of joint states; {topics.sentence()}; allowed: --states TOPIC")
    return best[0]


def _joints(messages: Sequence[Message], what: str, clock: Clock, kind: Kind = "measured") -> dict[str, Stream]:
    """{joint: stream} of one field, whatever the order of joints in each message; fields may be empty."""
    return {joint: Stream(time, x, kind) for joint, (time, x) in tracks(messages, what, clock).items()}


def _commands(
    name: str,
    topic: str,
    messages: Sequence[Message],
    names: Sequence[str],
    joints: Sequence[str],
    choice: Choice,
    clock: Clock,
) -> dict[str, Stream]:
    kind = messages[0].kind
    if kind == STATE:
        return _joints(messages, _field(name, topic, [m.body for m in messages], FIELDS, choice), clock, "held")
    if kind == CONTROLLER:
        return adapted.of_controller(name, topic, messages, choice, clock)
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
    letters = ",".join("ABCDEFGHIJKLMNOPQRSTUVWXYZ"[:count])
    allowed = f"allowed: --commands {topic}={letters} with the joints ({', '.join(sorted(joints))} are measured) in the"
    text = f"{name}: {topic} does not say which of its {count} values is whose; {allowed} order of the controller"
    raise UserError(f"{text} (its parameter `joints`)")


def _field(name: str, topic: str, bodies: Sequence[Any], fields: Sequence[str], choice: Choice) -> str:
    """Return the field that holds the commands."""
    filled = [f for f in fields if any(len(getattr(b, f)) for b in bodies)]
    wanted = [f for f in filled if choice.field is not None and f.startswith(choice.field)]
    if len(wanted or filled) != 1 or (choice.field is not None and not wanted):
        has = " and ".join(filled) or "nothing"
        raise UserError(f"{name}: {topic} commands {has}; allowed: --field position, velocity or effort, one it has")
    return (wanted or filled)[0]


def _trajectory(name: str, topic: str, messages: Sequence[Message], choice: Choice, clock: Clock) -> dict[str, Stream]:
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
    return streams(samples, "linear" if several else "held")


def _imu(topic: str, messages: Sequence[Message], clock: Clock, several: bool) -> dict[str, Stream]:
    time = np.array([clock(m) for m in messages])
    prefix = f"{topic.strip('/').replace('/', '.')}." if several else "imu."
    out = {}
    for quantity, short in (("angular_velocity", "gyro"), ("linear_acceleration", "accelerometer")):
        for axis in "xyz":
            values = np.array([getattr(getattr(m.body, quantity), axis) for m in messages])
            out[f"{prefix}{short}.{axis}"] = Stream(time, values)
    return out


__all__ = ["Choice", "Message", "recording"]
