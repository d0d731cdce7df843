"""What commands move: coherence of each command with each joint, and columns that look exchanged."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal

from bayessim_mjx.logs.log import Array
from bayessim_mjx.logs.views import LEAST, SEGMENT, Sheet, even, joints, velocity

# Both of two crossed coherences are at least this large, and their product this many times that of the straight ones.
# Rules of thumb: of 50 logs of a two-joint arm none is so, with two columns exchanged all are
CROSSED, MORE = 0.4, 1.1


@dataclass(frozen=True)
class Excitation:
    """What commands move: coherence of each command with each joint's velocity.

    Attributes:
        commands, joints: names. coherence: [commands, joints] mean over frequencies, weighted by the command's power; 1
            where the joint follows this command alone by a linear law; NaN where the logs are too short.
    """

    commands: tuple[str, ...]
    joints: tuple[str, ...]
    coherence: Array


def excitation(sheets: Sequence[Sheet]) -> Excitation | None:
    """Compute what excites what over all logs; None without commands or motion."""
    commands = tuple(dict.fromkeys(n for s in sheets for n in s.names("ctrl")))
    moved = tuple(joint for joint in joints(sheets) if any(velocity(s, joint) is not None for s in sheets))
    if not commands or not moved:
        return None
    return Excitation(commands, moved, np.array([[_coherent(sheets, f"ctrl:{c}", j) for j in moved] for c in commands]))


def swapped(sheets: Sequence[Sheet], pairs: Mapping[str, Sequence[str]]) -> list[str]:
    """Return a sentence for each two joints that move with each other's command more than with their own.

    Args:
        pairs: {joint: actuators that drive it}; joints with one actuator are compared.
    """
    found = excitation(sheets) if len(pairs) > 1 else None
    if found is None:
        return []
    own = {j: c for j, (c, *more) in pairs.items() if not more and j in found.joints and c in found.commands}

    def moves(joint: str, command: str) -> float:
        return float(found.coherence[found.commands.index(command), found.joints.index(joint)])

    said = []
    for (a, of_a), (b, of_b) in itertools.combinations(own.items(), 2):
        crossed, straight = (moves(a, of_b), moves(b, of_a)), (moves(a, of_a), moves(b, of_b))
        more = crossed[0] > straight[0] and crossed[1] > straight[1]
        if more and min(crossed) > CROSSED and crossed[0] * crossed[1] > MORE * straight[0] * straight[1]:
            here = f"coherence {crossed[1]:.2f} and {crossed[0]:.2f}"
            own_ones = f"with their own {straight[1]:.2f} and {straight[0]:.2f}"
            said.append(f"{crossing(b, of_a, a, of_b)} ({here}, {own_ones})")
    return said


def _coherent(sheets: Sequence[Sheet], command: str, joint: str) -> float:
    """Coherence of a command with a joint's velocity: spectra are summed over the logs before they are divided."""
    length = min([SEGMENT, *(max(len(s.time) // 4, LEAST) for s in sheets)])
    power = np.zeros((3, length // 2 + 1), complex)
    for sheet in sheets:
        u, w = sheet.channels.get(command), velocity(sheet, joint)
        inside, outside = (None if x is None else even(sheet, x) for x in (u, w))
        if inside is None or outside is None or min(len(inside[0]), len(outside[0])) < 2 * length:
            continue
        rows = min(len(inside[0]), len(outside[0]))
        x, y, rate = inside[0][:rows], outside[0][:rows], 1 / inside[1]
        for k, (a, b) in enumerate(((x, x), (y, y), (x, y))):
            power[k] += rows * signal.csd(a, b, rate, nperseg=length)[1]
    driven, moving = power[0].real[1:], power[1].real[1:]
    if driven.sum() <= 0 or moving.sum() <= 0:
        return float("nan")
    share = np.abs(power[2][1:]) ** 2 / np.maximum(driven * moving, 1e-300)
    return float(np.sum(np.minimum(share, 1.0) * driven) / driven.sum())


def crossing(joint: str, command: str, other: str, its_command: str) -> str:
    """Ask whether two joints' columns are exchanged."""
    return f"{joint} moves with {command} and {other} with {its_command}: are the columns swapped?"


def moved_most(sheet: Sheet, command: str, but: str) -> str:
    """Name the joint, other than `but`, that a command moves most; "" if there is none."""
    found = excitation([sheet])
    if found is None or command not in found.commands:
        return ""
    own = dict(zip(found.joints, np.nan_to_num(found.coherence[found.commands.index(command)]), strict=True))
    own.pop(but, None)
    return max(own, key=own.__getitem__, default="")
