"""Columns and motors that a vendor's tools number: which of them is which joint of a model."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Channels
from bayessim_mjx.logs.table import Table

_LEGS = tuple(f"{leg}_{part}" for leg in ("FR", "FL", "RR", "RL") for part in ("hip", "thigh", "calf"))
_SIDES = ("left", "right")


def _both(*parts: str) -> tuple[str, ...]:
    return tuple(f"{side}_{part}" for side in _SIDES for part in parts)


_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")
# names in the order of the motors, "" for none. Source: the enumerations of unitree_sdk2's examples (low level of Go2,
# G1, H1-2 and H1); of UR's RTDE the order of the joints from the base
ORDERS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "Unitree": {
        "Go2, B2, A1": _LEGS,
        "G1": (
            *_both("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll"),
            "waist_yaw", "waist_roll", "waist_pitch", *_both(*_ARM),
        ),
        "H1-2": (*_both("hip_yaw", "hip_pitch", "hip_roll", "knee", "ankle_pitch", "ankle_roll"), "torso",
                 *_both(*_ARM)),
        "H1": (
            "right_hip_roll", "right_hip_pitch", "right_knee", "left_hip_roll", "left_hip_pitch", "left_knee", "torso",
            "left_hip_yaw", "right_hip_yaw", "", "left_ankle", "right_ankle",
            *(f"{side}_{part}" for side in _SIDES[::-1] for part in _ARM[:4]),
        ),
    },
    "UR": {"UR": ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")},
    "Franka": {"Panda, FR3": tuple(f"joint{i}" for i in range(1, 8))},
}  # fmt: skip
_MOTOR = r"(?i)(?:.*[./:])?motor_?{}s?[\[_./]?(\d+)\]?[./:_]{}"


@dataclass(frozen=True)
class Dialect:
    """Columns of one vendor's tool.

    Attributes:
        vendor: key of `ORDERS`.
        columns: patterns of whole names, with the number from 0 as their group, by kind: qpos, qvel, effort, target,
            torque, and of a law in the drive kp, kd, ahead (a torque) and speed.
        clock: pattern of the time's column, and its unit.
        notes: what the columns are not, by kind.
    """

    vendor: str
    columns: Mapping[str, str]
    clock: tuple[str, str]
    notes: Mapping[str, str]


DIALECTS = (
    Dialect(
        "Unitree",
        {
            **{k: _MOTOR.format("state", n) for k, n in (("qpos", "q"), ("qvel", "dq"), ("effort", "tau_est"))},
            **{k: _MOTOR.format("(?:cmd|command)", n) for k, n in (("target", "q"), ("speed", "dq"), ("ahead", "tau"))},
            **{k: _MOTOR.format("(?:cmd|command)", k) for k in ("kp", "kd")},
        },
        (r"(?:.*[./:_])?tick", "ms"),
        {},
    ),
    Dialect(
        "Franka",
        {
            "qpos": r"state\.q\[(\d)\]", "qvel": r"state\.dq\[(\d)\]", "effort": r"state\.tau_J\[(\d)\]",
            "target": r"cmd\.q_d\[(\d)\]", "torque": r"cmd\.tau_J_d\[(\d)\]",
        },
        ("time", "ms"),
        {"torque": "cmd.tau_J_d is without the gravity that the robot adds itself: compensate it in the model too"},
    ),
    Dialect(
        "UR",
        {
            "qpos": r"actual_q_(\d)", "qvel": r"actual_qd_(\d)", "effort": r"actual_current_(\d)",
            "target": r"target_q_(\d)",
        },
        ("timestamp", "s"),
        {"effort": "actual_current is in A, and RTDE has no command of a torque"},
    ),
)  # fmt: skip


def words(name: str) -> str:
    """Strip a joint's name of marks, prefixes of arms and the word joint."""
    plain = re.sub(r"[^a-z0-9]", "", name.lower().replace("joint", ""))
    plain = re.sub(r"^(?:panda|fr3|ur\d+e?)", "", plain)
    return {"waistyaw": "torso"}.get(plain, plain)


def motors(vendor: str, joints: Sequence[str]) -> dict[int, str]:
    """Return {number from 0: joint} of one robot of the vendor, where the names of the joints say which.

    Raises:
        UserError: no robot, or several that number them in different ways.
    """
    own = {words(joint): joint for joint in joints}
    found: dict[str, dict[int, str]] = {}
    for robot, names in ORDERS[vendor].items():
        numbered = {i: own[words(n)] for i, n in enumerate(names) if n and words(n) in own}
        if len(numbered) in (len(joints), sum(map(bool, names))):
            found[robot] = numbered
    whole = {r: each for r, each in found.items() if len(each) == len(joints) == sum(map(bool, ORDERS[vendor][r]))}
    found = whole or found
    if len({tuple(sorted(each.items())) for each in found.values()}) == 1:
        return next(iter(found.values()))
    why = f"those of {' or '.join(found)}" if found else f"none of {', '.join(ORDERS[vendor])}"
    raise UserError(
        f"motors of {vendor} are numbered, and the model's joints ({', '.join(joints)}) are {why}; "
        "allowed: `--joints` with the joints in the order of the motors, or a map by hand"
    )


def dialect_of(columns: Sequence[str]) -> Dialect | None:
    """Return the dialect that has positions of joints among the columns, or None."""
    for dialect in DIALECTS:
        if any(re.fullmatch(dialect.columns["qpos"], column) for column in columns):
            return dialect
    return None


def hinges(model: mujoco.MjModel) -> list[str]:
    """Names of the joints that have one number."""
    channels = Channels.of(model)
    return [j for j, kind in zip(channels.joints, channels.kinds, strict=True) if kind in ("hinge", "slide")]


def numbered(dialect: Dialect, columns: Sequence[str]) -> dict[str, dict[int, str]]:
    """{kind: {number: column}}."""
    every = {kind: [(re.fullmatch(p, c), c) for c in columns] for kind, p in dialect.columns.items()}
    return {kind: {int(m[1]): c for m, c in found if m} for kind, found in every.items()}


def is_servo(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether the actuator pulls its joint back by its gain, as a position servo does."""
    return bool(model.actuator_biasprm[actuator, 1] < 0)


def law_of(values: Mapping[str, np.ndarray]) -> tuple[str, dict[str, Any]]:
    """(which column alone is the command, its law) of a drive that sums kp (q - target), kd (dq - speed) and a torque.

    It is the `target` where the gains are constant and the two other terms 0; `shifted` where they are not 0, a target
    moved by (kd speed + ahead) / kp under the same law; the torque `ahead` where the gains are 0; and "" elsewhere.

    Args:
        values: columns [T] of kp, kd, speed and ahead, as far as there are some.
    """
    gains = {k: values[k] for k in ("kp", "kd") if k in values}
    rest = [values[k] for k in ("speed", "ahead") if k in values]
    constant = all(np.ptp(x) == 0 for x in gains.values())
    if len(gains) == 2 and not any(x.any() for x in gains.values()):
        return "ahead", {}
    if not constant or "kp" not in gains or not gains["kp"][0] > 0:
        return "", {}
    return "shifted" if any(x.any() for x in rest) else "target", {
        "law": "position",
        **{k: float(x[0]) for k, x in gains.items()},
    }


def laws(table: Table, columns: Mapping[str, Mapping[int, str]], number: int) -> tuple[str, dict[str, Any]]:
    """`law_of` the columns of one motor."""
    found = {k: columns[k][number] for k in ("kp", "kd", "speed", "ahead") if number in columns.get(k, {})}
    return law_of({k: table.numbers(c) for k, c in found.items()})


__all__ = ["DIALECTS", "Dialect", "dialect_of", "hinges", "is_servo", "law_of", "laws", "motors", "numbered"]
