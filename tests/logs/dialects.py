"""Planted faults of logs' dialects: small files whose truth is known, each from a kind of public complaint."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from tests.logs.log_files import HEADER, rows

SERVO = """
<mujoco><compiler angle="radian" autolimits="true"/><option timestep="0.005"/>
  <worldbody>
    <body><joint name="horn" axis="0 1 0"/><geom size=".02" mass="1" pos="0 0 -.2"/></body>
    <body><joint name="wrist" axis="0 1 0" range="-2 2"/><geom size=".02" mass="1" pos="0 0 -.2"/></body>
    <body><joint name="jaw" axis="0 1 0" range="-0.2 1.8"/><geom size=".02" mass="1" pos="0 0 -.2"/></body>
    <body><joint name="finger" type="slide" axis="0 1 0" range="0 0.04"/><geom size=".02" mass="1"/></body>
  </worldbody>
  <actuator><position name="servo" joint="horn" kp="7"/></actuator>
</mujoco>"""
SERVO_HEADER = "time,ctrl:servo,qpos:horn,qpos:wrist,qpos:jaw,qpos:finger"
TRUTH = rows(200)
NAMES = {"ctrl": {"m_shoulder": "ua", "m_elbow": "ub"}, "qpos": {"shoulder": "qa", "elbow": "qb"}}
PLAIN = "t,ua,ub,qa,qb"
DAY = datetime(2026, 3, 4, 10, 15, 2, 250000)


def servo_truth() -> np.ndarray:
    """[200, 6]: time, target, then horn, wrist, jaw and finger; the horn follows its target."""
    t = 0.01 * np.arange(200)
    target = -0.9 + 0.5 * np.sin(3 * t)
    finger = 0.02 + 0.015 * np.sin(3 * t)
    return np.stack(
        [t, target, target - 0.02 * np.cos(3 * t), 0.6 * np.sin(2 * t), 0.8 + 0.7 * np.sin(3 * t), finger], 1
    )


@dataclass(frozen=True)
class Case:
    """One file.

    Attributes:
        name: of the fault; complaint: where its kind was complained of.
        content: of the file. log_map: that is used, besides `mend`. model: arm or servo.
        words: of the refusal, or of the warnings; mend: keys that then read it rightly, "": none does.
        refused: whether it has to be.
        truth: [T, n], time and channels. within: of the numbers that are read.
    """

    name: str
    complaint: str
    content: bytes
    log_map: Mapping[str, Any] | None = None
    words: Sequence[str] = ()
    refused: bool = False
    mend: Any = None
    model: str = "arm"
    truth: Any = None
    within: float = 2e-6


Cells = Callable[[int, int, float], str]


def text(table: np.ndarray, header: str = HEADER, sep: str = ",", form: str | Cells = "%.6f", end: str = "\n") -> str:
    """Write a table as text; `form` is a format, or what makes a field of (row, column, value)."""
    make: Cells = form if callable(form) else lambda i, j, x: form % x
    lines = [sep.join(make(i, j, x) for j, x in enumerate(row)) for i, row in enumerate(table)]
    return end.join([*([header] if header else []), *lines]) + end


def comma(i: int, j: int, x: float) -> str:
    return f"{x:.6f}".replace(".", ",")


def stamped(make: Callable[[int], str], table: np.ndarray = TRUTH, header: str = HEADER, sep: str = ",") -> str:
    """Return the table with other texts in its first column."""
    return text(table, header, sep, lambda i, j, x: make(i) if j == 0 else f"{x:.6f}")


def dated(form: str, start: datetime = DAY) -> Callable[[int], str]:
    return lambda i: (start + timedelta(milliseconds=10 * i)).strftime(form)


def with_column(index: int, values: np.ndarray, table: np.ndarray) -> np.ndarray:
    out = table.copy()
    out[:, index] = values
    return out


def changed(content: str, line: int, row: str) -> str:
    lines = content.splitlines()
    lines[line] = row
    return "\n".join(lines) + "\n"
