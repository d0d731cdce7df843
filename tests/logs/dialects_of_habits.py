"""Planted faults of habits: counters that wrap, rows in reverse, signs, gears, and units that few tools know."""

from __future__ import annotations

from datetime import datetime

import numpy as np

from tests.logs.dialects import (
    HEADER,
    NAMES,
    PLAIN,
    SERVO_HEADER,
    TRUTH,
    Case,
    changed,
    dated,
    servo_truth,
    stamped,
    text,
    with_column,
)

COUNTER = "forum.arduino.cc: millis() and micros() roll over in the middle of a log"
NEWEST = "grafana/grafana#28532: exports have the newest row first"
MATLAB = "mathworks.com/matlabcentral/answers: a timetable writes '0.01 sec' in its time column"
SLOW = "cvg/px-ros-pkg#4: a fast log in ms passes for a slow one in s"
FRAMES = "huggingface/lerobot#2107: frame numbers in the place of stamps"
COMPACT = "pandas-dev/pandas#19067: 20260304101502 is read as a number"
MIRRORED = "TheRobotStudio/SO-ARM100#141: a servo that is mounted the other way round"
GEAR = "odriverobotics/ODrive#588: positions at the motor, targets at the output of the gear"
TURNS = "discourse.odriverobotics.com: positions in turns since firmware 0.5"
ORDER = "ros-controls/ros2_controllers#159: joint_states are in alphabetical order, commands are not"
HOBBY = "forum.pololu.com: torques of hobby servos in kg cm and oz in"
UNKNOWN = "stackoverflow.com, tag units-of-measurement: units that only the name knows"
INTEGERS = "ROBOTIS-GIT/dynamixel-workbench#315: raw counts of a joint that hardly moves"
JSON = "stackoverflow.com/questions/7889006: decimal commas of a locale in JSON texts"
ZONES = "pandas-dev/pandas#15986: names of time zones behind dates"

SHEETS = "elysiate.com/blog: what a spreadsheet shows is no format of interchange"
DROPPED = "ROBOTIS-GIT/DynamixelSDK#288: a read that failed is logged as 0 or -1"

S = servo_truth()
T = 2 * np.pi
K = np.arange(200)
DEG = 180 / np.pi
ARM = {"time": "time", "ctrl": {"m_shoulder": "ctrl:m_shoulder", "m_elbow": "ctrl:m_elbow"},
       "qpos": {"shoulder": "qpos:shoulder", "elbow": "qpos:elbow"}}  # fmt: skip
RIG = {"time": "time", "ctrl": {"servo": "ctrl:servo"},
       "qpos": {n: f"qpos:{n}" for n in ("horn", "wrist", "jaw", "finger")}}  # fmt: skip


def rig(**qpos: object) -> dict:
    return {**RIG, "qpos": {**RIG["qpos"], **qpos}}  # type: ignore[dict-item]


def arm(ctrl: object) -> dict:
    return {**ARM, "ctrl": {**ARM["ctrl"], "m_elbow": ctrl}}  # type: ignore[dict-item]


def servo(index: int, values: np.ndarray) -> bytes:
    return text(with_column(index, values, S), SERVO_HEADER, form="%.9g").encode()


def counter(per_row: int, start: int, wrap: int) -> bytes:
    return stamped(lambda i: str((start + per_row * i) % wrap)).encode()


def torque(unit: str, per_nm: float) -> bytes:
    return text(with_column(2, per_nm * TRUTH[:, 2], TRUTH), HEADER.replace("ctrl:m_elbow", f"torque {unit}")).encode()


OVER = np.where(TRUTH[:, 3] < 0, TRUTH[:, 3] + 6.5536, TRUTH[:, 3])
SMALL = with_column(4, np.round(3 * np.sin(3 * TRUTH[:, 0])), TRUTH)  # a joint that moves by six counts
LOOSE = with_column(3, np.round(3 * np.sin(3 * TRUTH[:, 0])), TRUTH)

CASES = [
    Case("a counter of us that wraps", COUNTER, counter(10_000, 2**32 - 300_000, 2**32), {"time": {"column": "time",
         "unit": "us"}}, ("wrap: 4294967296",), True, {"time": {"column": "time", "unit": "us", "wrap": 4294967296}}),
    Case("a counter of 16 bits in ms", COUNTER, counter(10, 65_000, 2**16), {"time": {"column": "time", "unit": "ms"}},
         ("wrap: 65536",), True, {"time": {"column": "time", "unit": "ms", "wrap": 65536}}),
    Case("newest row first", NEWEST, text(TRUTH[::-1]).encode(), None, ("newest row first",)),
    Case("a unit behind each time", MATLAB, stamped(lambda i: f"{0.01 * i:.2f} sec").encode(), None,
         ("suffix: ' sec'",), True, {"time": {"column": "time", "suffix": " sec"}}),
    Case("milliseconds at 2 kHz", SLOW, stamped(lambda i: f"{0.5 * i:.1f}").encode(), None, ("unit: ms",),
         truth=with_column(0, 0.5 * K, TRUTH)),
    Case("days of MATLAB", SHEETS, stamped(lambda i: f"{740045.427 + 0.01 * i / 86400:.11f}").encode(),
         words=("unit: days",), within=2e-5),
    Case("ticks of Windows", SHEETS, stamped(lambda i: str(134171123022500000 + 100000 * i)).encode(), None,
         ("scale: 1.0e-07",), True, {"time": {"column": "time", "scale": 1e-7}}, within=1e-5),
    Case("a register of an angle that runs over", INTEGERS, text(with_column(3, OVER, TRUTH)).encode(), None,
         ("qpos:shoulder", "wrap"), True, {**ARM, "qpos": {"elbow": "qpos:elbow",
         "shoulder": {"column": "qpos:shoulder", "wrap": 6.5536}}}),
    *(Case(f"{value:g} for what is missing", DROPPED, text(with_column(3, np.where(K % 40 == 20, value, TRUTH[:, 3]),
           TRUTH)).encode(), None, ("qpos:shoulder", "missing", "bad_rows: drop"), True, {**ARM, "bad_rows": "drop",
           "qpos": {"elbow": "qpos:elbow", "shoulder": {"column": "qpos:shoulder", "missing": value}}},
           truth=TRUTH[K % 40 != 20]) for value in (-1.0, 2.5)),
    Case("a word of C for what is missing", DROPPED, changed(text(TRUTH), 200, "1.99,0,0,1.#QNAN,0").encode(), None,
         ("bad_rows",), True, {"bad_rows": "drop"}, truth=TRUTH[:199]),
    Case("signs behind the numbers", DROPPED, text(TRUTH, form=lambda i, j, x: f"{-x:.6f}-" if x < 0 else f"{x:.6f}")
         .encode(), None, ("is not a number; `bad_rows",), True),
    Case("frame numbers as floats", FRAMES, stamped(lambda i: f"{i:.1f}").encode(), None, ("unit: ms", "unit: s"), True,
         {"time": {"column": "time", "unit": "s"}}, truth=with_column(0, K, TRUTH)),
    Case("dates without marks", COMPACT, stamped(dated("%Y%m%d%H%M%S.%f", datetime(2026, 3, 4, 10, 15, 59))).encode(),
         None, ("format",), True, {"time": {"column": "time", "format": "%Y%m%d%H%M%S.%f"}}),
    Case("dates with one mark", COMPACT, stamped(dated("%Y%m%d_%H%M%S.%f")).encode(), None, ("format",), True,
         {"time": {"column": "time", "format": "%Y%m%d_%H%M%S.%f"}}),
    Case("dates as in C", COMPACT, stamped(dated("%a %b %d %H:%M:%S.%f %Y")).encode(), None, ("format",), True,
         {"time": {"column": "time", "format": "%a %b %d %H:%M:%S.%f %Y"}}),
    Case("dates with a zone's name", ZONES, stamped(dated("%Y-%m-%d %H:%M:%S.%f UTC")).encode(), None, ("format",),
         True, {"time": {"column": "time", "format": "%Y-%m-%d %H:%M:%S.%f UTC"}}),
    Case("milliseconds behind a colon", COMPACT, stamped(lambda i: f"10:15:{i // 100:02d}:{i % 100 * 10:03d}").encode(),
         None, ("format",), True, {"time": {"column": "time", "format": "%H:%M:%S:%f"}}),
    Case("epoch in single precision", SLOW, stamped(lambda i: f"{float(np.float32(1772619302 + 0.01 * i)):.1f}")
         .encode(), {"time": "time"}, ("rate",), True),
    Case("a mirrored servo", MIRRORED, servo(2, -S[:, 2]), None, ("qpos:horn", "sign: -1"), True,
         rig(horn={"column": "qpos:horn", "sign": -1}), "servo", S),
    Case("readings before the gear", GEAR, servo(2, 9 * S[:, 2]), None, ("qpos:horn", "scale"),
         model="servo", truth=with_column(2, 9 * S[:, 2], S)),
    Case("readings in turns", TURNS, servo(2, S[:, 2] / T), None, ("qpos:horn", "unit: rev"), True,
         rig(horn={"column": "qpos:horn", "unit": "rev"}), "servo", S),
    Case("turns by the column's name", TURNS, text(with_column(4, TRUTH[:, 4] / T, TRUTH), HEADER.replace("qpos:elbow",
         "elbow [turns]"), form="%.9f").encode(), {**ARM, "qpos": {"shoulder": "qpos:shoulder",
         "elbow": "elbow [turns]"}}, ("unit: rev",), True, {"qpos": {"shoulder": "qpos:shoulder",
         "elbow": {"column": "elbow [turns]", "unit": "rev"}}}),
    Case("kgf cm by the column's name", HOBBY, torque("[kgcm]", 1 / 0.0980665), arm("torque [kgcm]"),
         ("unit: kgf cm",), True, arm({"column": "torque [kgcm]", "unit": "kgf cm"})),
    Case("oz in by the column's name", HOBBY, torque("(oz-in)", 1 / 0.00706155), arm("torque (oz-in)"),
         ("unit: ozf in",), True, arm({"column": "torque (oz-in)", "unit": "ozf in"})),
    Case("kNm, stated by nobody", UNKNOWN, torque("[kNm]", 1e-3), arm("torque [kNm]"), ("[kNm]", "scale"), True,
         arm({"column": "torque [kNm]", "scale": 1000}), within=1e-3),
    Case("gon", UNKNOWN, text(with_column(4, 200 / np.pi * TRUTH[:, 4], TRUTH), HEADER.replace("qpos:elbow",
         "elbow [gon]")).encode(), {**ARM, "qpos": {"shoulder": "qpos:shoulder", "elbow": "elbow [gon]"}},
         ("[gon]", "scale"), True, {"qpos": {"shoulder": "qpos:shoulder",
         "elbow": {"column": "elbow [gon]", "scale": np.pi / 200}}}),
    Case("a degree sign that was read in another encoding", UNKNOWN, text(with_column(4, DEG * TRUTH[:, 4], TRUTH),
         HEADER.replace("qpos:elbow", "elbow [\u00c2\u00b0]")).encode(),
         {**ARM, "qpos": {"shoulder": "qpos:shoulder", "elbow": "elbow [\u00c2\u00b0]"}}, ("unit",), True,
         {"qpos": {"shoulder": "qpos:shoulder", "elbow": {"column": "elbow [\u00c2\u00b0]", "unit": "deg"}}}),
    Case("a name in brackets that is no unit", UNKNOWN, text(TRUTH, "t,ua,ub,q[0],q[1]").encode(),
         {**NAMES, "time": "t", "qpos": {"shoulder": "q[0]", "elbow": "q[1]"}}),
    Case("a bracket that says rad", UNKNOWN, text(TRUTH, "t [s],ua [Nm],ub [N\u00b7m],qa [rad],qb (rad)").encode(),
         {"time": "t [s]", "ctrl": {"m_shoulder": "ua [Nm]", "m_elbow": "ub [N\u00b7m]"},
          "qpos": {"shoulder": "qa [rad]", "elbow": "qb (rad)"}}),
    Case("few counts of a joint with a range", INTEGERS, text(SMALL).encode(), None, ("qpos:elbow", "unit: counts"),
         True,
         {**ARM, "qpos": {"shoulder": "qpos:shoulder", "elbow": {"column": "qpos:elbow", "unit": "rad"}}}, truth=SMALL),
    Case("few counts of a joint without a range", INTEGERS, text(LOOSE).encode(), None, ("qpos:shoulder",
         "unit: counts"), True, {**ARM, "qpos": {"elbow": "qpos:elbow", "shoulder": {"column": "qpos:shoulder",
         "unit": "rad"}}}, truth=LOOSE),
    Case("blank lines between rows", INTEGERS, text(TRUTH, end="\r\r\n").encode()),
    Case("names in quotes with blanks", INTEGERS, text(TRUTH, ", ".join(f'"{n}"' for n in PLAIN.split(",")), ", ")
         .encode(), {**NAMES, "time": "t"}),
]  # fmt: skip
