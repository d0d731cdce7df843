"""Joint states that more than one publisher sent on one topic: never merged where their positions differ."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.importers.messages import FIELDS, Message, tracks
from bayessim_mjx.logs.importers.streams import Stream
from bayessim_mjx.logs.log import Array
from bayessim_mjx.logs.signals import COUNTS, STEPS, derivative, noise_level, quantum
from bayessim_mjx.logs.stamps import WINDOW

# Rules of thumb, not measured.
LEAST = 5e-3  # rad or m, apart from which two values are two
# An order is far better if it leaves less than this share of the variance that the given one leaves, where that is more
# than this share of all. Counted over simulated chains: of 160 right orders none is doubted, of 106 wrong ones whose
# joints are driven in different ways 88 are found, 87 with the right order. Of weak and stiff servos, 4 of 5 with
# different targets, no right order of 200 is doubted, and of 200 wrong ones 129 are found, 112 with the right order
FAR = 0.5
ENOUGH = 20_000  # rows that decide between orders, spread over the log; shares of a variance change by less than 1 %
FEW = 5  # values off the motion from which another publisher is behind them; rule of thumb


@dataclass(frozen=True)
class _Form:
    """The features by which one publisher's messages differ from another's."""

    publisher: str
    frame: str
    names: tuple[str, ...]
    fields: tuple[str, ...]

    @classmethod
    def of(cls, message: Message) -> _Form:
        body = message.body
        frame = str(getattr(getattr(body, "header", None), "frame_id", "") or "")
        filled = tuple(f for f in FIELDS if len(getattr(body, f)))
        return cls(message.publisher, frame, tuple(map(str, body.name)), filled)

    def sentence(self, number: int, count: int) -> str:
        by = f" of {self.publisher}" if self.publisher.startswith("/") else ""
        frame = f", frame {self.frame!r}" if self.frame else ""
        return f"{number}: {count} messages{by} with {', '.join(self.fields)} of {', '.join(self.names)}{frame}"


def of_one_publisher(
    name: str, topic: str, messages: Sequence[Message], chosen: int | None, received: bool = False
) -> list[Message]:
    """Return the messages of joint states of one publisher, or of several that agree or have no joint in common.

    Args:
        name: of the recording; topic: of the messages.
        chosen: number of the publisher, from 1, in the order of a refusal.
        received: stamps are those of receipt.

    Raises:
        UserError: two publishers give different positions of a joint; names both, and how to choose.
    """
    forms: dict[_Form, list[Message]] = defaultdict(list)
    for message in messages:
        forms[_Form.of(message)].append(message)
    ranked = sorted(forms.items(), key=lambda item: -len(item[1]))
    if chosen is not None:
        if not 1 <= chosen <= len(ranked):
            raise UserError(f"{name}: --publisher {chosen}; allowed: 1 to {len(ranked)} on {topic}")
        return ranked[chosen - 1][1]
    why = (not received and _same_stamp(messages)) or _apart(ranked, received) or _two_tracks(messages, received)
    if not why:
        return list(messages)
    choices = "; ".join(form.sentence(i, len(each)) for i, (form, each) in enumerate(ranked, 1))
    text = f"{name}: {topic} has more than one publisher: {why}"
    if len(ranked) == 1:
        text += "; their messages cannot be distinguished; allowed: a recording without the second publisher, another"
        raise UserError(f"{text} topic by --states TOPIC, or --stamps received, if one publisher's stamps are coarse")
    raise UserError(f"{text}; choose by --publisher N ({choices}), or another topic by --states TOPIC")


def _positions(message: Message) -> dict[str, float]:
    pairs = zip(message.body.name, message.body.position, strict=False)
    return {str(joint): float(x) for joint, x in pairs if np.isfinite(x)}


def _same_stamp(messages: Sequence[Message]) -> str:
    """Messages with one stamp that give a joint two positions."""
    if len({m.stamp for m in messages}) == len(messages):
        return ""
    seen: dict[int, dict[str, float]] = {}
    for message in messages:
        own = _positions(message)
        before = seen.setdefault(message.stamp, {})
        for joint, x in own.items():
            if joint in before and abs(before[joint] - x) > 1e-9:
                return f"messages with the same stamp give {joint!r} the positions {before[joint]:.6g} and {x:.6g}"
        before |= own
    return ""


Tracks = Mapping[str, tuple[Array, Array]]


def _tracks(messages: Sequence[Message], received: bool) -> Tracks:
    """{joint: (stamps [s, from 1e6 s before], positions)}, in the order of the stamps."""
    stamps = [m.received if received else m.stamp for m in messages]
    origin = min(stamps) // 10**15 * 10**15
    own = {id(m): (at - origin) * 1e-9 for m, at in zip(messages, stamps, strict=True)}
    found = tracks(messages, "position", lambda m: own[id(m)])
    return {joint: (time[order], x[order]) for joint, (time, x) in found.items() for order in [np.lexsort((x, time))]}


def _apart(ranked: Sequence[tuple[_Form, Sequence[Message]]], received: bool) -> str:
    """Find publishers of other forms whose positions lie off those of the first, interleaved with it."""
    if len(ranked) < 2:
        return ""
    each = [_tracks(messages, received) for _, messages in ranked]
    for i, many in enumerate(each):
        for few in each[i + 1 :]:
            for joint in sorted(set(many) & set(few)):
                found = _off(many[joint], few[joint], joint)
                if found:
                    return found
    return ""


def _off(many: tuple[Array, Array], few: tuple[Array, Array], joint: str) -> str:
    (time, x), (at, y) = many, few
    inside = (at > time[0]) & (at < time[-1])
    if len(x) < 3 or not inside.any():
        return ""
    steps = np.abs(np.diff(x))
    usual = max(LEAST, COUNTS * quantum(x), STEPS * float(np.median(steps)))
    between = np.interp(at[inside], time, x)
    after = np.clip(np.searchsorted(time, at[inside]) - 1, 0, len(steps) - 1)
    near = np.max([steps[np.clip(after + k, 0, len(steps) - 1)] for k in (-1, 0, 1)], axis=0)  # a fast stretch
    off = np.abs(y[inside] - between) > np.maximum(usual, 2.0 * near)
    if off.sum() < min(3, len(off)):
        return ""
    row = int(np.flatnonzero(off)[0])
    return f"between messages with {joint!r} near {between[row]:.6g} others have it at {y[inside][row]:.6g}"


def _two_tracks(messages: Sequence[Message], received: bool) -> str:
    """Values that leave the motion for one sample and come back, again and again."""
    every = _tracks(messages, received) if messages else {}
    for joint in _positions(messages[0]) if messages else ():
        x = every[joint][1]
        if len(x) < 10:
            continue
        steps = np.abs(np.diff(x))
        across = np.abs(x[2:] - x[:-2])
        usual = max(LEAST, COUNTS * quantum(x), STEPS * float(np.median(across)))
        out = (steps[:-1] > usual) & (steps[1:] > usual) & (across < 0.2 * np.minimum(steps[:-1], steps[1:]))
        apart = x[1:-1][out]
        if out.sum() >= FEW and np.median(np.abs(np.diff(apart))) < 0.2 * np.median(steps[:-1][out]):
            return f"positions of {joint!r} jump to and fro, as from {x[:-2][out][0]:.6g} to {apart[0]:.6g} and back"
        if out.sum() >= 0.5 * len(out):
            return f"positions of {joint!r} jump to and fro at every sample"
    return ""


def better_order(
    sent: Mapping[str, Stream], measured: Mapping[str, Mapping[str, Stream]]
) -> tuple[list[str], list[str], tuple[float, float]] | None:
    """Return (joints as given, in the order that fits the motion far better, shares explained by both), or None.

    Each command is explained by a linear combination of one joint's position, its sine and cosine, velocity and its
    sign, acceleration and effort; of all orders the one that explains most is compared with the given one (Kuhn 1955,
    linear assignment).

    Args:
        sent: commands by joint, as the given order has them. measured: position, velocity, effort by joint.
    """
    joints = [j for j in sent if j in measured["position"]]
    clock = measured["position"][joints[0]].sorted().time if len(joints) > 1 else np.zeros(0)
    if len(joints) < 2 or len(clock) < WINDOW * len(joints):
        return None
    commands, places = ([x[j].on(clock) for j in joints] for x in (sent, measured["position"]))
    if max(map(_unexplained, commands, map(_of_place, places))) < FAR:
        return None  # with further features a part of the given order leaves less still, and these are dear
    features = [_features(measured, joint, q, clock) for joint, q in zip(joints, places, strict=True)]
    left = np.array([[_unexplained(x, f) for f in features] for x in commands])
    rows, best = linear_sum_assignment(np.log(np.maximum(left, np.finfo(np.float32).eps)))
    moved = rows != best
    given, other = (float(left[rows, k][moved].mean()) if moved.any() else 0.0 for k in (rows, best))
    if given < FAR or other > FAR * given:
        return None
    return joints, [joints[j] for j in best], (1.0 - given, 1.0 - other)


def _of_place(q: Array) -> Array:
    return np.stack([np.ones_like(q), q, np.sin(q), np.cos(q)], 1)


def _features(measured: Mapping[str, Mapping[str, Stream]], joint: str, q: Array, clock: Array) -> Array:
    """Return [T, n] of what one joint at q [T] shows at the times [T], as far as it was sampled there."""
    seen = np.isfinite(q)
    if seen.sum() < len(seen):
        q = np.interp(clock, clock[seen], q[seen])
    speed, _ = derivative(clock, q, noise_level(q))
    change, _ = derivative(clock, speed, noise_level(speed))
    effort = [measured["effort"][joint].on(clock)] if joint in measured["effort"] else []
    return np.column_stack([_of_place(q), speed, np.sign(speed), change, *effort])


def _unexplained(x: Array, features: Array) -> float:
    """Share of the variance of x [T] that no combination of the features [T, n] explains."""
    each = -(-len(x) // ENOUGH)
    x, features = x[::each], features[::each]
    known = np.isfinite(x) & np.isfinite(features).all(axis=1)
    x, features = x[known], features[known]
    if len(x) <= features.shape[1] or np.ptp(x) == 0:
        return 1.0
    residual = x - features @ np.linalg.lstsq(features, x, rcond=None)[0]
    return float(np.var(residual) / np.var(x))


def several_senders(name: str, topics: Iterable[str], by_topic: Mapping[str, Sequence[Any]]) -> list[str]:
    """Note topics of commands that several nodes sent to: a drive acts on all of them."""
    out = []
    for topic in topics:
        senders = sorted({m.publisher for m in by_topic[topic]})
        if len(senders) > 1:
            text = f"{name}: {topic}: commands of {len(senders)} publishers are taken together"
            out.append(f"{text}, as a drive gets them")
    return out


__all__ = ["of_one_publisher", "better_order", "several_senders"]
