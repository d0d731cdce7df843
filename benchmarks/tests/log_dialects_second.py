"""A second list of faults, written after the first was mended and before any of it was tried."""

import json

import numpy as np
from log_dialects import A, Fault, S, csv, plain, put, text
from log_dialects_imports import H5, MCAP, START, hdf5, lines, mcap, npz
from log_dialects_names import DEG, HEAD, named

UNITS = "stackoverflow.com, tag units-of-measurement: units in the names of columns"
CURRENT = "ROBOTIS-GIT/DynamixelSDK#173: current against torque"
TICKS = "ROBOTIS-GIT/dynamixel-workbench#315: raw counts"
CLOCKS = "stackoverflow.com, tag timestamp: clocks of instruments"
LATE = "ros2/rosbag2#1240: rows out of order"
TABLES = "stackoverflow.com, tag csv: tables of other programs"
OBJECTS = "stackoverflow.com, tag ndjson: other forms of objects"
BAGS = "foxglove/mcap: the wrong command for a file, other names"
ROWS = plain(A).splitlines()


def stamped(make, head: str = "time", table: np.ndarray = A) -> dict[str, bytes]:  # noqa: ANN001
    rest = [line.split(",", 1)[1] for line in plain(table).splitlines()]
    return csv("\n".join([f"{head},{rest[0]}", *(f"{make(i)},{row}" for i, row in enumerate(rest[1:]))]) + "\n")


def prefixed(i: int, body: dict) -> dict:
    return {**body, "name": [f"robot1/{n}" for n in body["name"]]}


def turned(i: int, body: dict) -> dict:
    return {**body, "position": [DEG * x for x in body["position"]]}


SWAPPED = [ROWS[0], *(ROWS[1 + (i ^ 1 if i in (80, 81) else i)] for i in range(200))]
RECORDS = np.array([tuple(row) for row in A], [(n, float) for n in ROWS[0].split(",")])

FAULTS = [
    Fault("degree signs behind the names", UNITS, named("shoulder(°)", "elbow(°)", A * [1, 1, 1, DEG, DEG])),
    Fault("radians in words", UNITS, named("shoulder_angle_radians", "elbow_angle_radians")),
    Fault("words parted by hyphens", UNITS, named("shoulder-position-deg", "elbow-position-deg",
          A * [1, 1, 1, DEG, DEG])),
    Fault("mrad", UNITS, named("q_shoulder_mrad", "q_elbow_mrad", A * [1, 1, 1, 1e3, 1e3])),
    Fault("blanks and middle dots", UNITS, csv(text(A, "time (s),shoulder torque command (N·m),elbow torque command "
          "(N·m),shoulder position (rad),elbow position (rad)"))),
    Fault("N mm by the name's end", UNITS, csv(text(A * [1, 1e3, 1e3, 1, 1], "t,shoulder_cmd_Nmm,elbow_cmd_Nmm,"
          "shoulder_pos,elbow_pos")), ("scale", "Nmm"), {"time": "t", "ctrl": {f"m_{j}": {"column": f"{j}_cmd_Nmm",
          "scale": 1e-3} for j in ("shoulder", "elbow")}, "qpos": {j: f"{j}_pos" for j in ("shoulder", "elbow")}}),
    Fault("currents as the commands of torques", CURRENT, csv(text(A * [1, 2, 2, 1, 1], "t,shoulder_current_cmd,"
          "elbow_current_cmd,shoulder_pos,elbow_pos")), ("torque_constant",), {"time": "t", "ctrl": {f"m_{j}": {
          "column": f"{j}_current_cmd", "unit": "A", "torque_constant": 0.5} for j in ("shoulder", "elbow")},
          "qpos": {j: f"{j}_pos" for j in ("shoulder", "elbow")}}),
    Fault("setpoints and feedback", UNITS, csv(text(S, "t,pan_pos_setpoint,tilt_pos_setpoint,pan_pos_feedback,"
          "tilt_pos_feedback")), model="servo"),
    Fault("ticks of a servo", TICKS, csv(text(np.c_[S[:, 0], 2048 + np.round(S[:, 1:] * 4096 / (2 * np.pi))],
          "t,pan_goal_ticks,tilt_goal_ticks,pan_present_ticks,tilt_present_ticks")), ("resolution",), {"time": "t", **{
          s: {j: {"column": f"{j}_{w}_ticks", "unit": "counts", "resolution": 4096, "zero": 2048} for j in ("pan",
          "tilt")} for s, w in (("ctrl", "goal"), ("qpos", "present"))}}, "servo", within=1e-3),
    Fault("velocities in rpm beside positions", UNITS, csv(text(np.c_[A, 30 / np.pi * np.gradient(A[:, 3:], 0.01,
          axis=0)], f"{HEAD},shoulder_pos,elbow_pos,shoulder_vel_rpm,elbow_vel_rpm", form="%.9g"))),
    Fault("minutes", CLOCKS, csv(text(put(A, 0, A[:, 0] / 60), "Time [min],shoulder_torque_cmd,elbow_torque_cmd,"
          "shoulder_pos,elbow_pos", form="%.12g"))),
    Fault("dates with nanoseconds", CLOCKS, stamped(lambda i: f"2026-03-04T10:15:{2 + i // 100:02d}.{i % 100:02d}"
          "0000001")),
    Fault("days of the year", CLOCKS, stamped(lambda i: f"2026-063T10:15:{2 + i // 100:02d}.{i % 100:02d}"),
          ("format",), {"time": {"column": "time", "format": "%Y-%jT%H:%M:%S.%f"}}),
    Fault("hours, minutes and seconds with letters", CLOCKS, stamped(lambda i: f"10h15m{2 + i // 100:02d}."
          f"{i % 100:02d}s"), ("format",), {"time": {"column": "time", "format": "%Hh%Mm%S.%fs"}}),
    Fault("seconds and milliseconds in two columns", CLOCKS, stamped(lambda i: f"{17 + i // 100},{i % 100 * 10}",
          "sec,msec"), ("time",), "nothing"),
    Fault("a clock that counts down", CLOCKS, stamped(lambda i: f"{1.99 - 0.01 * i:.2f}", "remaining"), ("time",),
          "nothing"),
    Fault("seconds since 1904", CLOCKS, stamped(lambda i: f"{3855464102 + 0.01 * i:.2f}")),
    Fault("two rows in the wrong order", LATE, csv("\n".join(SWAPPED) + "\n"), ("bad_rows",), {"bad_rows": "drop"},
          truth=np.delete(A, 80, 0)),
    Fault("five rows of the run before", LATE, csv(plain(np.r_[put(A[:5], 0, 771.5 + A[:5, 0]), A])), ("begins anew",
          "cut the file", "bad_rows"), lambda folder: (folder / "run.csv").write_text(plain(A))),
    Fault("semicolons at the end of lines, decimal commas", TABLES, csv(text(A, HEAD.replace(",", ";")
          + ";shoulder_pos;elbow_pos;", ";", lambda i, j, x: f"{x:.9g}".replace(".", ",") + (";" if j == 4 else "")))),
    Fault("a table of Markdown", TABLES, csv(f"| {' | '.join(ROWS[0].split(','))} |\n|---|---|---|---|---|\n" + "".join(
          f"| {' | '.join(row.split(','))} |\n" for row in ROWS[1:])), ("delimiter", "skip_after_header"), {
          "delimiter": "|", "skip_after_header": 1}),
    Fault("numbers in quotes", TABLES, csv(plain(A, form=lambda i, j, x: f'"{x:.9g}"'))),
    Fault("exponents behind decimal commas", TABLES, csv(text(A, f"{HEAD},shoulder_pos,elbow_pos".replace(",", ";"),
          ";", lambda i, j, x: f"{x:.8E}".replace(".", ",")))),
    Fault("a list of joints in each object", OBJECTS, {"run.jsonl": lines([{"time": t, "joints": [{"name": "shoulder",
          "pos": c, "tau": a}, {"name": "elbow", "pos": d, "tau": b}]} for t, a, b, c, d in A.tolist()])}, ("qpos",), {
          "ctrl": {"m_shoulder": "joints[0]:tau", "m_elbow": "joints[1]:tau"}, "qpos": {"shoulder": "joints[0]:pos",
          "elbow": "joints[1]:pos"}}),
    Fault("a stamp as an object", OBJECTS, {"run.jsonl": lines([{"stamp": {"sec": 17 + i // 100, "nanosec": i % 100
          * 10**7}, "shoulder": {"torque_cmd": r[1], "pos": r[3]}, "elbow": {"torque_cmd": r[2], "pos": r[4]}} for i, r
          in enumerate(A.tolist())])}),
    Fault("a structured array", OBJECTS, npz(time=RECORDS, ctrl=None, qpos=None, joints=None, actuators=None),
          ("time", "real numbers"), "nothing"),
    Fault("arrays by other names", OBJECTS, npz(time=None, ctrl=None, qpos=None, joints=None, actuators=None, t=A[:, 0],
          q=A[:, 3:], tau=A[:, 1:3]), ("time", "qpos"), {"time": "t", "ctrl": {"m_shoulder": "tau[0]", "m_elbow":
          "tau[1]"}, "qpos": {"shoulder": "q[0]", "elbow": "q[1]"}}),
    Fault("one array alone", OBJECTS, {"run.npy": b"\x93NUMPY\x01\x00"}, (".npz", "NPZ"), "nothing"),
    Fault("joints with a prefix", BAGS, mcap(prefixed), ("--rename",), again=("--rename", "robot1/shoulder=shoulder",
          "robot1/elbow=elbow"), **MCAP),
    Fault("states in degrees", BAGS, mcap(turned), ("--scale", "unit: deg"), {"qpos": {j: {"column": f"position:{j}",
          "unit": "deg"} for j in ("shoulder", "elbow")}}, **MCAP),
    Fault("an MCAP file as a ROS bag", BAGS, mcap(), ("from-mcap", ".bag"), "nothing", convert=("from-rosbag",), paths=(
          "run.mcap",)),
    Fault("fewer times than states", BAGS, hdf5(t=A[:150, 0]), ("150",), "nothing", convert=(*H5, "--commands_of",
          "m_shoulder", "m_elbow", "--time", "t"), paths=("run.hdf5",)),
    Fault("stamps of a recorder that jumped to the right time", BAGS, mcap(when=lambda i: 10_000_000 * i - (START
          if i < 50 else 0) + (10**9 if i < 50 else 0), received=lambda i: 10_000_000 * i), ("--stamps received",
          "gap"), again=("--stamps", "received"), **MCAP),
    Fault("json objects over some lines", OBJECTS, {"run.jsonl": json.dumps({"time": A[:, 0].tolist(), "q":
          A[:, 3:].tolist()}).encode()}, ("one object per line", "qpos", "time"), "nothing"),
]  # fmt: skip
