"""What the name of a column says: of which joint or drive it is, and which quantity; nothing is guessed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import mujoco
import numpy as np

from bayessim_mjx.logs import units
from bayessim_mjx.logs.log import Channels

_WORDS = {  # of a column's name, besides that of the joint; the first kind that has one of them wins
    "ctrl": "cmd command commands commanded target goal desired des ctrl control setpoint sp ref reference action u "
    "soll sollwert consigne",
    "effort": "effort torque tau current load force iq moment",
    "qvel": "vel velocity velocities speed qd dq qvel omega rate",
    "qpos": "pos position positions q angle qpos actual measured meas present state joint encoder enc ist istwert "
    "winkel",
}
KINDS = {kind: frozenset(words.split()) for kind, words in _WORDS.items()}
# words of a name that say nothing of the quantity; those of no reading; quantities of a joint that are no channel of a
# model, though a voltage may command a drive; and those of clocks
_PLAIN = {
    "fillers": "joint joints link arm leg robot raw filtered filt smooth value values data axis",
    "errors": "error errors err deviation diff difference residual limit limits min max",
    "others": "temp temperature voltage volt volts status mode fault faults flag flags acc accel acceleration jerk "
    "power energy humidity pressure id",
    "clock": "t time timestamp timestamps stamp stamps zeit clock sec secs seconds",
}
_FILLERS, _ERRORS, _OTHERS, _CLOCK = (frozenset(words.split()) for words in _PLAIN.values())
_OF_UNIT = {
    **dict.fromkeys((*units.TURNING, *units.MOVING), "qvel"),
    **dict.fromkeys((*units.ANGLES, units.COUNTS), "qpos"),
    **dict.fromkeys((*units.FORCES, *units.CURRENTS), "effort"),
}
_CURRENTS = frozenset(("current", "iq"))
_TAKEN = {"qpos": "position", "qvel": "velocity", "effort": "torque or force"}


def parts(name: str) -> tuple[str, ...]:
    """Words of a name without its unit: `shoulderPos_deg` -> shoulder, pos."""
    return tuple(units.words_of(units.bare(name)))


def is_clock(column: str) -> bool:
    """Whether a column's name is that of a clock."""
    words = parts(column)
    return bool(words) and (set(words) <= _CLOCK or (len(words) == 1 and units.of_name(column) in units.TIMES))


def channel(column: str, model: mujoco.MjModel) -> tuple[str, str] | None:
    """(kind, channel) that a column's name suggests, or None.

    The kind is `""` where a joint is named, and nothing says which of its quantities it is.
    """
    channels = Channels.of(model)
    words = parts(column)
    single = [j for j, kind in zip(channels.joints, channels.kinds, strict=True) if kind in ("hinge", "slide")]
    joint, actuator = _longest(words, single), _longest(words, channels.actuators)
    if joint is None and actuator is None:
        return None
    by_drive = actuator is not None and (joint is None or len(parts(actuator)) > len(parts(joint)))
    own_name = str(actuator if by_drive else joint)
    rest = set(words) - set(parts(own_name))
    kind = _kind(column, words, own_name, "ctrl" if by_drive else "qpos")
    if kind is None or (rest & _ERRORS):
        return None
    if kind in ("qpos", "qvel"):
        own = joint if joint is not None else _joint_of(model, channels, str(actuator))
        return None if own is None else (kind, own)
    drive = actuator if by_drive else drive_of(model, channels, str(joint))
    return (kind, own_name) if not kind else None if drive is None else (kind, drive)


def _kind(column: str, words: Sequence[str], name: str, usual: str) -> str | None:
    """Kind of a column's quantity; "" where an unknown word stands behind the name, None of another quantity."""
    own = parts(name)
    start = next(i for i in range(len(words)) if tuple(words[i : i + len(own)]) == own)
    rest = set(words) - set(own)
    kind = next((k for k, known in KINDS.items() if rest & known), None)
    if kind != "ctrl" and rest & _OTHERS:
        return None
    if kind is not None:
        return kind
    behind = [w for w in words[start + len(own) :] if w not in _FILLERS and not w.isdigit()]
    of_unit = _OF_UNIT.get(str(units.of_name(column)))
    return of_unit if of_unit is not None and usual == "qpos" else "" if behind else usual


def mismatch(column: str, drive: str, model: mujoco.MjModel) -> str:
    """Say why a column that commands a drive is not what the drive takes, or "".

    A position servo takes a position, a drive whose bias grows with the speed alone a velocity, another one an effort.
    """
    words = set(parts(column)) - set(parts(drive))
    named = [kind for kind in _TAKEN if words & (KINDS[kind] - {"joint", "state"})]
    unit = _OF_UNIT.get(str(units.of_name(column)))
    said = next(iter([*named, *([unit] if unit else [])]), None)
    i = Channels.of(model).actuators.index(drive)
    bias = model.actuator_biasprm[i]
    taken = "qpos" if bias[1] < 0 else "qvel" if bias[2] < 0 else "effort"
    if taken == "effort" == said and unit is None and not words & (KINDS["effort"] - _CURRENTS):
        entry = f"`ctrl: {{{drive}: {{column: {column!r}, unit: A, torque_constant: NM_PER_A}}}}`"
        return f"ctrl.{drive}: the model takes a torque or force, and {column} names a current; {entry} converts it"
    if said is None or said == taken:
        return ""
    law = f"; `metadata: {{controller: {{{drive}: {{law: {_TAKEN[said]}, ...}}}}}}` declares the law that follows it"
    own = f"`ctrl: {{{drive}: {column}}}` takes it as it is"
    return (
        f"ctrl.{drive}: the model takes a {_TAKEN[taken]}, and {column} names a {_TAKEN[said]}"
        f"{law if taken == 'effort' else ''}; {own}"
    )


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


def drive_of(model: mujoco.MjModel, channels: Channels, joint: str) -> str | None:
    """Return the only actuator on a joint, or None."""
    own = drives(model, channels.joints.index(joint))
    return channels.actuators[own[0]] if len(own) == 1 else None


def _joint_of(model: mujoco.MjModel, channels: Channels, actuator: str) -> str | None:
    own = [j for j in range(model.njnt) if channels.actuators.index(actuator) in drives(model, j)]
    return channels.joints[own[0]] if len(own) == 1 else None


__all__ = ["KINDS", "channel", "drive_of", "drives", "is_clock", "mismatch", "parts"]
