"""Commands that fit the motion of another joint: columns under each other's names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco

from bayessim_mjx.logs.importers.publishers import better_order
from bayessim_mjx.logs.importers.streams import Stream
from bayessim_mjx.logs.log import Channels, Log
from bayessim_mjx.logs.names import drives
from bayessim_mjx.logs.vendors import hinges
from bayessim_mjx.quantities import percent

SWAPPED = "are the columns swapped?"


@dataclass(frozen=True, eq=False)
class Exchange:
    """One order of the commands that fits the motion far better than the given one, in some logs.

    Attributes:
        logs: where; given, better: share of the commands that the motion explains in either order, for each.
        commands: {actuator: the one whose column fits its joint}; joints: {joint: the one whose column fits its drive}.
    """

    logs: tuple[Log, ...]
    commands: Mapping[str, str]
    joints: Mapping[str, str]
    given: tuple[float, ...]
    better: tuple[float, ...]

    @property
    def sentence(self) -> str:
        """The same for all of its logs."""
        named, fit = ", ".join(self.commands.values()), ", ".join(self.commands)
        now, then = (_span(shares) for shares in (self.given, self.better))
        why = f"they explain {then} in place of {now}"
        return f"the commands {named} fit the motion far better as those of {fit} ({why}): {SWAPPED}"


def exchanges(logs: Sequence[Log], model: mujoco.MjModel) -> tuple[Exchange, ...]:
    """Orders of the commands of joints with one drive that fit the motion far better; logs of one order together."""
    channels = Channels.of(model)
    drive_of = {j: own[0] for j in hinges(model) if len(own := drives(model, channels.joints.index(j))) == 1}
    found: dict[tuple[tuple[str, str], ...], list[tuple[Log, tuple[float, float]]]] = {}
    for log in logs:
        kinds = {"position": (log.qpos, log.channels.qpos, "qpos"), "velocity": (log.qvel, log.channels.qvel, "qvel")}
        measured = {
            kind: {j: Stream(log.time, x[:, names.index(j)]) for j in drive_of if f"{stream}:{j}" not in log.absent}
            for kind, (x, names, stream) in kinds.items()
        }
        sent = {j: Stream(log.time, log.ctrl[:, i], "held") for j, i in drive_of.items()}
        if (order := better_order(sent, {**measured, "effort": {}})) is not None:
            moved = tuple((a, b) for a, b in zip(*order[:2], strict=True) if a != b)
            found.setdefault(moved, []).append((log, order[2]))
    names = {j: channels.actuators[i] for j, i in drive_of.items()}
    return tuple(
        Exchange(
            tuple(log for log, _ in own),
            {names[b]: names[a] for a, b in moved},
            dict(moved),
            *(tuple(share[k] for _, share in own) for k in (0, 1)),
        )
        for moved, own in found.items()
    )


def _span(shares: Sequence[float]) -> str:
    low, high = percent(min(shares)), percent(max(shares))
    return low if low == high else f"{low} to {high}"


__all__ = ["Exchange", "exchanges"]
