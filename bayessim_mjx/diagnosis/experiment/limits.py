"""What a robot may do: limits of the model or given ones, else a little more than the logs already did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.simulable import AXIAL
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Channels, Log
from bayessim_mjx.parameters.attributes import suggest

Array = NDArray[np.float64]
BEYOND = 1.1  # of what the logs already did, where nothing else is said
_KEYS = {"joints": ("range", "speed"), "actuators": ("command", "effort")}


@dataclass(frozen=True, eq=False)
class Limits:
    """What must not be left.

    Attributes:
        low, high, speed: `[nv]`, rad or m, and per s; infinite where nothing limits (what nothing drives, bases).
        command_low, command_high: `[nu]`, units of ctrl; effort: `[nu]`, largest |force| of the actuator.
        source: {joint or actuator: where the limits come from}.
    """

    low: Array
    high: Array
    speed: Array
    command_low: Array
    command_high: Array
    effort: Array
    source: dict[str, str]


def limits_of(model: mujoco.MjModel, logs: Sequence[Log], given: Mapping[str, Any] | None = None) -> Limits:
    """Ranges of the model where it has some, else 110 % of what the logs did; `given` has the last word.

    Args:
        given: {"joints": {name: {"range": [low, high], "speed": v}}, "actuators": {name: {"command": [low, high],
            "effort": f}}}.

    Raises:
        UserError: unknown keys or names, a range upside down.
    """
    given = given or {}
    channels = Channels.of(model)
    _known(given, {"joints": channels.joints, "actuators": channels.actuators})
    source: dict[str, str] = {}
    low, high, speed = np.full(model.nv, -np.inf), np.full(model.nv, np.inf), np.full(model.nv, np.inf)
    for j, name in enumerate(channels.joints):
        if int(model.jnt_type[j]) in AXIAL:
            v = int(model.jnt_dofadr[j])
            own = given.get("joints", {}).get(name, {})
            low[v], high[v], speed[v], source[name] = _of_joint(model, j, logs, own)
    bounds = given.get("actuators", {})
    rows = [_of_actuator(model, i, logs, bounds.get(n, {})) for i, n in enumerate(channels.actuators)]
    source |= {n: row[3] for n, row in zip(channels.actuators, rows, strict=True)}
    commands = np.array([row[:3] for row in rows], float).reshape(-1, 3)
    return Limits(low, high, speed, commands[:, 0], commands[:, 1], commands[:, 2], source)


def _known(given: Mapping[str, Any], names: Mapping[str, Sequence[str]]) -> None:
    for section, entries in given.items():
        if section not in _KEYS:
            raise UserError(f"limits.{section}: {suggest(section, list(_KEYS))}")
        for name, own in entries.items():
            if name not in names[section]:
                raise UserError(f"limits.{section}.{name}: not in the model; {suggest(name, names[section])}")
            for key, value in own.items():
                if key not in _KEYS[section]:
                    raise UserError(f"limits.{section}.{name}.{key}: allowed: {', '.join(_KEYS[section])}")
                if np.ndim(value) and not value[0] < value[1]:
                    raise UserError(f"limits.{section}.{name}.{key} = {list(value)}: allowed: low < high")


def _of_joint(model: mujoco.MjModel, j: int, logs: Sequence[Log], own: Mapping[str, Any]) -> tuple:
    q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
    moved = np.concatenate([log.qpos[:, q] for log in logs])
    fast = np.percentile(np.abs(np.concatenate([log.qvel[:, v] for log in logs])), 99.5)
    driven = bool(np.any((model.actuator_trnid[:, 0] == j) & (model.actuator_trntype <= 1)))
    speed = float(own.get("speed", BEYOND * fast if driven else np.inf))
    if "range" in own:
        return float(own["range"][0]), float(own["range"][1]), speed, "given"
    if model.jnt_limited[j]:
        return (
            float(model.jnt_range[j, 0]),
            float(model.jnt_range[j, 1]),
            speed,
            "range of the model, speed of the logs",
        )
    if not driven:
        return -np.inf, np.inf, speed, "not driven: free"
    middle, half = (moved.max() + moved.min()) / 2, BEYOND * np.ptp(moved) / 2
    return middle - half, middle + half, speed, "110 % of the logs"


def _of_actuator(model: mujoco.MjModel, i: int, logs: Sequence[Log], own: Mapping[str, Any]) -> tuple:
    sent = np.concatenate([log.ctrl[:, i] for log in logs])
    middle, half = (sent.max() + sent.min()) / 2, BEYOND * np.ptp(sent) / 2
    low, high, source = middle - half, middle + half, "110 % of the logs"
    if "command" in own:
        (low, high), source = own["command"], "given"
    elif model.actuator_ctrllimited[i]:
        (low, high), source = model.actuator_ctrlrange[i], "range of the model"
    if "effort" in own:
        return low, high, float(own["effort"]), source
    if model.actuator_forcelimited[i]:
        return low, high, float(np.abs(model.actuator_forcerange[i]).max()), source
    if model.actuator_biasprm[i, 1] == 0 and model.actuator_biasprm[i, 2] == 0:  # force proportional to the command
        return low, high, float(max(abs(low), abs(high)) * abs(model.actuator_gainprm[i, 0])), source
    return low, high, BEYOND * _pull(model, i, logs), source


def _pull(model: mujoco.MjModel, i: int, logs: Sequence[Log]) -> float:
    """Largest force of a servo on the logs: gain * command + bias of position and speed."""
    j, gear = int(model.actuator_trnid[i, 0]), float(model.actuator_gear[i, 0])
    q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
    b = model.actuator_biasprm[i]
    forces = [
        model.actuator_gainprm[i, 0] * x.ctrl[:, i] + b[0] + gear * (b[1] * x.qpos[:, q] + b[2] * x.qvel[:, v])
        for x in logs
    ]
    return float(np.abs(np.concatenate(forces)).max())
