"""Planted faults of units: degrees, percent, counts, currents, registers and whole turns."""

from __future__ import annotations

import numpy as np

from tests.logs.dialects import HEADER, SERVO_HEADER, TRUTH, Case, servo_truth, text, with_column

DEGREES = "huggingface/lerobot#1259: joints in degrees or percent, the gripper always 0 to 100"
PERCENT = "huggingface/lerobot#607: a gripper in percent of its range"
SUFFIX = "stackoverflow.com, tag csv: numbers with their unit in the same field"
MILLIMETRES = "TrossenRobotics/trossen_arm#57: the gripper in other units than the joints"
COUNTS = "ROBOTIS-GIT/dynamixel-workbench#315: raw counts of one turn, or of many"
REGISTER = "resibots/libdynamixel#64: signed positions read as unsigned"
CURRENT = "ROBOTIS-GIT/DynamixelSDK#173: current against torque"
TURN = "almond-bot/axol#208: after a power cycle a joint reads 360 degrees off"
SPLIT = "adityakamath/sts_hardware_interface#5: readings 0 to 2 pi, targets -pi to pi"
WRAPS = "Kinovarobotics/ros2_kortex#32: command 3.142, actual -3.141, error 6.283"

S = servo_truth()
DEG = 180 / np.pi
T = 2 * np.pi
ARM = {"time": "time", "ctrl": {"m_shoulder": "ctrl:m_shoulder", "m_elbow": "ctrl:m_elbow"},
       "qpos": {"shoulder": "qpos:shoulder", "elbow": "qpos:elbow"}}  # fmt: skip
RIG = {"time": "time", "ctrl": {"servo": "ctrl:servo"},
       "qpos": {n: f"qpos:{n}" for n in ("horn", "wrist", "jaw", "finger")}}  # fmt: skip


def arm(**qpos: object) -> dict:
    return {**ARM, "qpos": {**ARM["qpos"], **qpos}}  # type: ignore[dict-item]


def rig(**qpos: object) -> dict:
    return {**RIG, "qpos": {**RIG["qpos"], **qpos}}  # type: ignore[dict-item]


def servo(index: int, values: np.ndarray, table: np.ndarray = S) -> bytes:
    return text(with_column(index, values, table), SERVO_HEADER, form="%.9g").encode()


def mapped(entry: dict) -> dict:
    return {**ARM, "ctrl": {**ARM["ctrl"], "m_elbow": {"column": "ctrl:m_elbow", **entry}}}  # type: ignore[dict-item]


NAMED = text(with_column(3, DEG * TRUTH[:, 3], TRUTH), HEADER.replace("qpos:shoulder", "shoulder_deg")).encode()
MILLI = text(with_column(2, 1000 / 0.5 * TRUTH[:, 2], TRUTH), HEADER.replace("ctrl:m_elbow", "i_mA")).encode()
COUNTED = (2048 + np.round(4096 / T * TRUTH[:, 4])) % 4096
RAW = text(with_column(4, COUNTED, TRUTH)).encode()
WIDE = np.round(4096 / T * S[:, 3]) + 2048
AROUND = 2.5 * S[:, 0] + 0.4  # turns on and on
FOLLOWS = with_column(2, AROUND - 0.05, with_column(1, AROUND, S))


def in_wrist(by: float) -> np.ndarray:
    return servo(3, S[:, 3] + by)


CASES = [
    Case("degrees of a joint without a range, stated", DEGREES,
         text(with_column(3, DEG * TRUTH[:, 3], TRUTH)).encode(), arm(shoulder={"column": "qpos:shoulder",
         "unit": "deg"})),
    Case("a unit behind each number", SUFFIX, text(TRUTH, form=lambda i, j, x: f"{x:.6f} rad" if j == 3 else f"{x:.6f}")
         .encode(), ARM, ("suffix: ' rad'",), True, arm(shoulder={"column": "qpos:shoulder", "suffix": " rad"})),
    Case("a degree sign behind each number", SUFFIX,
         text(TRUTH, form=lambda i, j, x: f"{x * DEG:.6f}\u00b0" if j == 3 else f"{x:.6f}").encode(), ARM,
         ("suffix: '\u00b0'",), True, arm(shoulder={"column": "qpos:shoulder", "suffix": "\u00b0", "unit": "deg"})),
    Case("degrees by the column's name", DEGREES, NAMED, arm(shoulder="shoulder_deg"), ("unit: deg", "scale: 1"), True,
         arm(shoulder={"column": "shoulder_deg", "unit": "deg"})),
    Case("degrees beyond the joint's range", DEGREES, servo(3, DEG * S[:, 3]), None, ("qpos:wrist", "unit: deg"), True,
         rig(wrist={"column": "qpos:wrist", "unit": "deg"}), "servo", S),
    Case("degrees from 0 to 360", DEGREES, servo(3, np.mod(DEG * S[:, 3], 360)), None, ("qpos:wrist", "unit: deg"),
         True,
         rig(wrist={"column": "qpos:wrist", "unit": "deg"}), "servo", S),
    Case("a gripper's jaw in percent", DEGREES, servo(4, 50 * (S[:, 4] + 0.2)), None,
         ("qpos:jaw", "unit: deg", "unit: percent"), True,
         rig(jaw={"column": "qpos:jaw", "unit": "percent", "range": [-0.2, 1.8]}), "servo", S),
    Case("a gripper's finger in percent", PERCENT, servo(5, S[:, 5] / 0.0004), None, ("qpos:finger", "unit: percent"),
         True,
         rig(finger={"column": "qpos:finger", "unit": "percent", "range": [0.0, 0.04]}), "servo", S),
    Case("percent without a range", PERCENT, servo(5, S[:, 5] / 0.0004),
         rig(finger={"column": "qpos:finger", "unit": "percent"}), ("finger.unit", "range"), True,
         rig(finger={"column": "qpos:finger", "unit": "percent", "range": [0.0, 0.04]}), "servo", S),
    Case("a gripper's finger in mm", MILLIMETRES, servo(5, 1000 * S[:, 5]), None, ("qpos:finger", "unit: mm"), True,
         rig(finger={"column": "qpos:finger", "unit": "mm"}), "servo", S),
    Case("mm of a hinge", MILLIMETRES, text(TRUTH).encode(), arm(elbow={"column": "qpos:elbow", "unit": "mm"}),
         ("qpos.elbow.unit = 'mm'", "hinge"), True, arm()),
    Case("a map of one command of two", DEGREES, text(TRUTH).encode(), {**ARM, "ctrl": {"m_elbow": "ctrl:m_elbow"}},
         ("the map leaves out ctrl:m_shoulder, which the file has",), True, ARM),
    Case("targets in degrees of a motor", DEGREES, text(TRUTH).encode(),
         {**ARM, "ctrl": {**ARM["ctrl"], "m_elbow": {"column": "ctrl:m_elbow", "unit": "deg"}}},
         ("m_elbow.unit = 'deg'", "a motor", "law: position"), True, arm()),
    Case("targets in degrees, readings in rad", DEGREES, servo(1, DEG * S[:, 1]), None, ("ctrl:servo", "unit: deg"),
         True,
         {**RIG, "ctrl": {"servo": {"column": "ctrl:servo", "unit": "deg"}}}, "servo", S),
    Case("readings in degrees, targets in rad", DEGREES, servo(2, DEG * S[:, 2]), None, ("qpos:horn", "unit: deg"),
         True,
         rig(horn={"column": "qpos:horn", "unit": "deg"}), "servo", S),
    Case("counts with a resolution", COUNTS, RAW,
         arm(elbow={"column": "qpos:elbow", "unit": "counts", "resolution": 4096, "zero": 2048}), within=1e-3),
    Case("counts without a word", COUNTS, servo(3, WIDE), None, ("qpos:wrist", "unit: counts"), True,
         rig(wrist={"column": "qpos:wrist", "unit": "counts", "resolution": 4096, "zero": 2048}), "servo", S, 1e-3),
    Case("counts without a resolution", COUNTS, RAW, arm(elbow={"column": "qpos:elbow", "unit": "counts"}),
         ("elbow.unit", "resolution"), True,
         arm(elbow={"column": "qpos:elbow", "unit": "counts", "resolution": 4096, "zero": 2048}), within=1e-3),
    Case("hexadecimal counts", COUNTS, text(with_column(4, COUNTED, TRUTH), form=lambda i, j, x: (
         hex(int(x)) if j == 4 else f"{x:.6f}")).encode(),
         arm(elbow={"column": "qpos:elbow", "unit": "counts", "resolution": 4096, "zero": 2048}), within=1e-3),
    Case("a register of 16 bits", REGISTER, text(with_column(2, np.round(1000 * np.cos(3 * TRUTH[:, 0])) % 65536,
         TRUTH))
         .encode(), mapped({"scale": 0.001, "signed": 16}), truth=with_column(2, np.cos(3 * TRUTH[:, 0]), TRUTH),
         within=1e-3),
    Case("a register of 16 bits without a word", REGISTER,
         text(with_column(2, np.round(1000 * np.cos(3 * TRUTH[:, 0])) % 65536, TRUTH)).encode(), None, ("signed: 16",),
         True,
         mapped({"scale": 0.001, "signed": 16}), truth=with_column(2, np.cos(3 * TRUTH[:, 0]), TRUTH), within=1e-3),
    Case("mA by the column's name", CURRENT, MILLI, {**ARM, "ctrl": {"m_shoulder": "ctrl:m_shoulder",
         "m_elbow": "i_mA"}},
         ("unit: mA", "torque_constant"), True,
         {"ctrl": {"m_shoulder": "ctrl:m_shoulder", "m_elbow": {"column": "i_mA", "unit": "mA",
         "torque_constant": 0.5}}}),
    Case("mA without a torque constant", CURRENT, MILLI,
         {**ARM, "ctrl": {"m_shoulder": "ctrl:m_shoulder", "m_elbow": {"column": "i_mA", "unit": "mA"}}},
         ("m_elbow.unit", "torque_constant"), True,
         {"ctrl": {"m_shoulder": "ctrl:m_shoulder", "m_elbow": {"column": "i_mA", "unit": "mA",
         "torque_constant": 0.5}}}),
    Case("a turn from the target", SPLIT, servo(2, S[:, 2] + T), words=("1 turn(s) from 'ctrl:servo'",
         "offset: -6.283185"),
         model="servo", truth=S),
    Case("three turns from the target", TURN, servo(2, S[:, 2] - 3 * T), words=("offset: 18.849556",), model="servo",
         truth=S),
    Case("0 to 2 pi, across 0", SPLIT, servo(2, np.mod(S[:, 2] + 0.9, T), with_column(1, S[:, 1] + 0.9, S)),
         words=("wraps by 2 pi",), model="servo", truth=with_column(1, S[:, 1] + 0.9, with_column(2, S[:, 2] + 0.9,
         S))),
    Case("a turn from the range", TURN, in_wrist(T), words=("outside the model's range", "offset: -6.283185"),
         model="servo", truth=S),
    Case("-pi to pi, always beyond", TURN, in_wrist(-T), words=("offset: 6.283185",), model="servo", truth=S),
    Case("targets that wrap", WRAPS, text(with_column(1, np.mod(AROUND + np.pi, T) - np.pi, FOLLOWS), SERVO_HEADER,
         form="%.9g").encode(), words=("'ctrl:servo' wraps by 2 pi",), model="servo", truth=FOLLOWS),
    Case("a turn in the middle of the log", TURN, servo(2, S[:, 2] + T * (S[:, 0] > 1.0)), words=("wraps by 2 pi",),
         model="servo", truth=S),
]  # fmt: skip
