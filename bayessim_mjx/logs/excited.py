"""What commands move: coherence of each command with each joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import signal

from bayessim_mjx.logs.exchanged import SWAPPED
from bayessim_mjx.logs.log import Array
from bayessim_mjx.logs.views import LEAST, SEGMENT, Sheet, even, joints, velocity


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
    return f"{joint} moves with {command} and {other} with {its_command}: {SWAPPED}"


def moved_most(sheet: Sheet, command: str, but: str) -> str:
    """Name the joint, other than `but`, that a command moves most; "" if there is none."""
    found = excitation([sheet])
    if found is None or command not in found.commands:
        return ""
    own = dict(zip(found.joints, np.nan_to_num(found.coherence[found.commands.index(command)]), strict=True))
    own.pop(but, None)
    return max(own, key=own.__getitem__, default="")
