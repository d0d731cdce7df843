"""A menu of motions inside a robot's limits that excite one joint, or all together.

Slow triangles show dry friction and play, staircases of speeds what grows with speed, chirps and multisines timing and
inertia, steps the limits of drives and deadbands, fast strokes the speed-torque curve.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayessim_mjx.logs.log import Array


@dataclass(frozen=True, eq=False)
class Excitation:
    """One motion of the menu.

    Attributes:
        kind: its name in the menu; where: joint, or "all".
        offset: `[T, nv]`, reference motion relative to the middle position, at full amplitude.
        live: `[T, nv]`, 0 while the joint's drive is to be off.
        sharp: jumps are meant, and not smoothed away.
    """

    kind: str
    where: str
    offset: Array
    live: Array
    sharp: bool = False

    @property
    def name(self) -> str:
        return f"{self.kind} on {'all joints together' if self.where == 'all' else self.where}"


@dataclass(frozen=True, eq=False)
class Room:
    """What motions have: time `[T]` s, and of each degree of freedom `[nv]` the usable half range and largest speed."""

    time: Array
    half: Array
    speed: Array


def menu(
    room: Room, joints: Mapping[str, int], alone: Sequence[str], release: Sequence[str], seed: int
) -> list[Excitation]:
    """Every kind of motion on single joints, and on all together.

    Args:
        joints: {name: dof} that are concerned; alone: names of those moved one at a time.
        release: names of the joints whose drive can be switched off.
    """
    places = [*alone, *(["all"] if len(joints) > 1 else [])]
    each = [(kind, place) for kind in SHAPES for place in places if kind != RELEASE or place in release]
    return [_of(kind, place, room, joints, seed) for kind, place in each]


def _of(kind: str, place: str, room: Room, joints: Mapping[str, int], seed: int) -> Excitation:
    rng, time = np.random.default_rng(seed), room.time
    offset, live = np.zeros((len(time), len(room.half))), np.ones((len(time), len(room.half)))
    own = joints if place == "all" else {place: joints[place]}
    for k, v in enumerate(own.values()):
        # together, each joint at a pace of its own, so that their motions are not alike
        pace = 1.0 if len(own) == 1 else 0.55 + 0.45 * ((k * 0.618) % 1.0)
        reach = room.half[v] if len(own) == 1 else 0.7 * room.half[v]
        offset[:, v] = SHAPES[kind](time, reach, pace * room.speed[v], rng)
        if kind == RELEASE:
            live[:, v] = _held(time)
    return Excitation(kind, place, offset, live, kind == "steps of three sizes")


def _triangle(way: Array, a: float) -> Array:
    """Position `a`-bounded after a way travelled back and forth, starting in the middle."""
    return 2 * a / np.pi * np.arcsin(np.sin(np.pi / 2 * way / a))


def _slow(t: Array, a: float, v: float, rng: Any) -> Array:
    return _triangle(max(0.06 * v, 1.5 * a / t[-1]) * t, a)


def _staircase(t: Array, a: float, v: float, rng: Any) -> Array:
    level = np.array([0.06, 0.12, 0.25, 0.5, 0.85])[np.minimum((5 * t / t[-1]).astype(int), 4)]
    return _triangle(np.cumsum(level * v) * (t[1] - t[0]), a)


def _strokes(t: Array, a: float, v: float, rng: Any) -> Array:
    """At top speed from end to end with a rest of 0.2 s at every turn."""
    stroke, dt = 2 * a / (0.9 * v), t[1] - t[0]
    moving = np.mod(t + stroke / 2, stroke + 0.2) < stroke
    return _triangle(np.cumsum(0.9 * v * moving) * dt, a)


def _fastest(t: Array) -> float:
    """Hz, the highest frequency worth sending."""
    return float(min(8.0, 0.1 / (t[1] - t[0])))


def _chirp(t: Array, a: float, v: float, rng: Any) -> Array:
    low, high = 0.15, _fastest(t)
    f = low * (high / low) ** (t / t[-1])
    phase = 2 * np.pi * np.concatenate([[0.0], np.cumsum((f[1:] + f[:-1]) / 2 * np.diff(t))])
    return np.minimum(0.8 * a, 0.7 * v / (2 * np.pi * f)) * np.sin(phase)


def _multisine(t: Array, a: float, v: float, rng: Any) -> Array:
    f = np.round(np.geomspace(0.2, _fastest(t), 10) * t[-1]) / t[-1]
    lines = np.sin(2 * np.pi * np.outer(t, f) + rng.uniform(0, 2 * np.pi, len(f))) / f**0.8
    x = lines.sum(1) - lines[0].sum()
    return x * min(0.8 * a / np.abs(x).max(), 0.8 * v / np.abs(np.gradient(x, t)).max())


def _steps(t: Array, a: float, v: float, rng: Any) -> Array:
    levels = a * np.array([0.0, 0.15, -0.15, 0.4, -0.4, 0.8, -0.8, 0.0])
    wanted, out = levels[np.minimum((8 * t / t[-1]).astype(int), 7)], np.zeros(len(t))
    reach = 0.9 * v * (t[1] - t[0])
    for k in range(1, len(t)):
        out[k] = out[k - 1] + np.clip(wanted[k] - out[k - 1], -reach, reach)
    return out


def _holds(t: Array, a: float, v: float, rng: Any) -> Array:
    levels = a * np.array([0.0, 0.45, 0.9, 0.45, 0.0, -0.45, -0.9, -0.45])
    knots = np.linspace(0, t[-1], 2 * len(levels))
    return np.interp(t, knots, np.repeat(levels, 2))


def _reversals(t: Array, a: float, v: float, rng: Any) -> Array:
    """Small slow strokes that grow from 1 % to 12 % of the range: presliding, play and deadband."""
    size = a * 0.01 * 12 ** (t / t[-1])
    return size * _triangle(4 * t, 1.0)


RELEASE = "hold and release"


def _held(t: Array) -> Array:
    return (np.mod(t, t[-1] / 3) < 0.6 * t[-1] / 3).astype(float)


def _hold(t: Array, a: float, v: float, rng: Any) -> Array:
    return np.interp(t, np.linspace(0, t[-1], 7), a * np.array([0.0, 0.35, 0.35, -0.6, -0.6, 0.85, 0.85]))


SHAPES = {
    "slow triangle": _slow,
    "staircase of speeds": _staircase,
    "chirp": _chirp,
    "multisine": _multisine,
    "steps of three sizes": _steps,
    "ramps and holds": _holds,
    "small reversals": _reversals,
    RELEASE: _hold,
    "fast driving and braking": _strokes,
}
