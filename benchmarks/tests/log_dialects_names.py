"""Faults of names, units and values: what a column is, in which unit, and numbers that no motion makes."""

import numpy as np
from log_dialects import A, Fault, S, csv, plain, put, text

PLOTJUGGLER = "facontidavide/PlotJuggler#236: __time, and names with the path of the topic"
CAMEL = "stackoverflow.com, tag simulink: names in CamelCase, with the unit at their end"
PREFIX = "ArduPilot/ardupilot: TimeUS, and units before or within the names"
BAGPY = "jmscslgroup/bagpy#30: position_0 beside a column of names"
ECHO = "ros2/ros2cli#622: topic echo --csv has neither names nor joints"
OTHERS = "ROBOTIS-GIT/dynamixel-workbench#315: a servo reports temperature, voltage and load beside its position"
QUANTITY = "ros-controls/ros2_controllers#159: a velocity is commanded, not a position"
ERRORS = "ros-controls/ros_controllers#174: error beside desired and actual"
BRACKETS = "stackoverflow.com, tag units-of-measurement: 0.1 degrees, millidegrees, degrees in words"
GRAVITY = "jrowberg/i2cdevlib#255: an MPU6050 gives g and degrees per second"
MOCAP = "ros-drivers/mocap_optitrack#29: poses in mm, y upwards"
RESET = "odriverobotics/ODrive#412: the position is 0 again after an encoder's index, in the middle of a log"
SPIKE = "ROBOTIS-GIT/DynamixelSDK#288: single samples that are far off, by an error of a bit"
FROZEN = "huggingface/lerobot#1220: the same observation for some frames, then a jump"
RADIANS = "ros-planning/moveit#1181: one joint in degrees, the others in radians"
SHARE = "odriverobotics/ODrive: a command as a share of the rated torque"
SCALED = "unitreerobotics/unitree_legged_sdk#24: readings in 1/1000 rad"
MIX = "stackoverflow.com/questions/38134643: text among the numbers, an object column"
STATES = "frankaemika/libfranka#49: a column of modes in words"
CASES = "stackoverflow.com/questions/19726029: other letters, other blanks in the names"
DEG = 180 / np.pi
K = np.arange(200)
ARM = {"ctrl": {"m_shoulder": "ctrl:m_shoulder", "m_elbow": "ctrl:m_elbow"},
       "qpos": {"shoulder": "qpos:shoulder", "elbow": "qpos:elbow"}}  # fmt: skip
CTRL = {"m_shoulder": "shoulder_torque_cmd", "m_elbow": "elbow_torque_cmd"}
HEAD = "t,shoulder_torque_cmd,elbow_torque_cmd"
SMALL = put(A, 3, 0.05 * A[:, 3])  # a joint without a range that hardly moves: nothing but its name says degrees
SMALL_DEG = put(SMALL, 3, DEG * SMALL[:, 3])


def named(shoulder: str, elbow: str, table: np.ndarray = A, more: str = "", extra: tuple = ()) -> dict[str, bytes]:
    """Return a folder of the arm's log with these names of positions, and further columns."""
    return csv(text(np.column_stack([table, *extra]), f"{HEAD},{shoulder},{elbow}{more}", form="%.9g"))


def in_degrees(name: str) -> Fault:
    """Return a shoulder in degrees under this name, which moves by 3 degrees alone."""
    return Fault(f"degrees by the name {name}", CAMEL if name[0].isupper() or "Deg" in name else PREFIX,
                 named(name, "elbow_pos", SMALL_DEG), ("unit: deg",), {"time": "t", "ctrl": CTRL, "qpos": {"shoulder":
                 {"column": name, "unit": "deg"}, "elbow": "elbow_pos"}}, truth=SMALL)  # fmt: skip


def floating(scale: float = 1.0, upright: bool = False, g: float = 1.0, rate: float = 1.0) -> dict[str, bytes]:
    """Return a floating robot's log: positions times `scale`, y up, an accelerometer over g, a gyroscope times rate."""
    t = 0.01 * K
    z, y = 0.42 + 0.05 * np.sin(2 * t), 0.1 * np.sin(t)
    lift = -0.2 * np.sin(2 * t)
    pose = [0.02 * t, z if upright else y, -y if upright else z]
    yaw = 0.5 * np.sin(t)
    quat = [np.cos(yaw / 2), *np.zeros((2, 200)), np.sin(yaw / 2)]
    imu = [*np.zeros((2, 200)), rate * 0.5 * np.cos(t), *np.zeros((2, 200)), (9.81 + lift) / g]
    table = np.column_stack([t, np.cos(3 * t), *(scale * np.array(pose)), *quat, 0.4 * np.sin(3 * t), *imu])
    names = ["time", "ctrl:m_knee", *(f"qpos:root[{i}]" for i in range(7)), "qpos:knee",
             *(f"gyro:imu_gyro[{i}]" for i in range(3)), *(f"accel:imu_accel[{i}]" for i in range(3))]  # fmt: skip
    return csv(text(table, ",".join(names), form="%.9g"))


def _float_truth() -> np.ndarray:
    content = floating()["run.csv"].decode().splitlines()
    return np.array([[float(x) for x in line.split(",")[:10]] for line in content[1:]])


def elbow(values: np.ndarray) -> dict[str, bytes]:
    return csv(plain(put(A, 4, values)))


BASE = _float_truth()
RESETS = np.where(K < 100, A[:, 4], A[:, 4] - A[100, 4])  # the encoder says 0 from row 100 on
SPIKED = np.where(K == 90, A[:, 4] + 0.61, np.where(K == 141, A[:, 4] - 0.83, A[:, 4]))
FROZE = np.where((K >= 80) & (K < 110), A[80, 4], A[:, 4])

FAULTS = [
    Fault("names of PlotJuggler", PLOTJUGGLER, csv(text(A, "__time,/arm/command/shoulder/effort,"
          "/arm/command/elbow/effort,/joint_states/shoulder/position,/joint_states/elbow/position"))),
    Fault("names of a robot's namespace", PLOTJUGGLER, csv(text(A, "timestamp,/robot/shoulder/torque_command,"
          "/robot/elbow/torque_command,/robot/shoulder/position,/robot/elbow/position"))),
    Fault("other letters", CASES, csv(text(A, "Time,Ctrl:m_shoulder,CTRL:m_elbow,QPos:shoulder,qPos:elbow")),
          ("did you mean",), {"time": "Time", "ctrl": {"m_shoulder": "Ctrl:m_shoulder", "m_elbow": "CTRL:m_elbow"},
          "qpos": {"shoulder": "QPos:shoulder", "elbow": "qPos:elbow"}}),
    Fault("blanks behind the colons", CASES, csv(text(A, "time,ctrl: m_shoulder,ctrl: m_elbow,qpos: shoulder,"
          "qpos: elbow")), ("did you mean", "in a map takes it"), {"ctrl": {"m_shoulder": "ctrl: m_shoulder",
          "m_elbow": "ctrl: m_elbow"}, "qpos": {"shoulder": "qpos: shoulder", "elbow": "qpos: elbow"}}),
    Fault("names of bagpy", BAGPY, csv("\n".join(["Time,name,position_0,position_1,effort_0,effort_1", *(
          f"{t:.6g},\"['shoulder', 'elbow']\",{q1:.9g},{q2:.9g},{u1:.9g},{u2:.9g}" for t, u1, u2, q1, q2 in A)])),
          ("`qpos: {",), "nothing"),
    Fault("joints that change places from row to row", BAGPY, csv("\n".join(["%time,field.name0,field.name1,"
          "field.position0,field.position1,field.effort0,field.effort1", *(f"{t:.6g},shoulder,elbow,{q1:.9g},{q2:.9g},"
          f"{u1:.9g},{u2:.9g}" if i % 2 else f"{t:.6g},elbow,shoulder,{q2:.9g},{q1:.9g},{u2:.9g},{u1:.9g}" for i, (t,
          u1, u2, q1, q2) in enumerate(A))])), ("`qpos: {", "change"), "nothing"),
    Fault("what ros2 topic echo --csv writes", ECHO, csv("".join(f"{17 + i // 100},{i % 100 * 10_000_000},,shoulder,"
          f"elbow,{q1:.9g},{q2:.9g},{u1:.9g},{u2:.9g}\n" for i, (_, u1, u2, q1, q2) in enumerate(A))),
          ("header: false", "ACTUATOR: COLUMN"), {"header": False, "time": {"column": 0, "nanoseconds": 1}, "qpos": {
          "shoulder": 5, "elbow": 6}, "ctrl": {"m_shoulder": 7, "m_elbow": 8}}),
    in_degrees("shoulderPosDeg"), in_degrees("ShoulderDegrees"), in_degrees("shoulder_deg_filtered"),
    in_degrees("deg_shoulder"), in_degrees("shoulder angle in degrees"), in_degrees("shoulder_pos [deg] (raw)"),
    in_degrees("Shoulder Angle (Degrees)"),
    Fault("TimeUS", PREFIX, csv(text(put(A, 0, 500 * K), "TimeUS,shoulder_torque_cmd,elbow_torque_cmd,shoulder_pos,"
          "elbow_pos")), ("unit: us",), {"time": {"column": "TimeUS", "unit": "us"}}, truth=put(A, 0, 5e-4 * K)),
    Fault("timeMs", CAMEL, csv(text(put(A, 0, 0.5 * K), "timeMs,shoulder_torque_cmd,elbow_torque_cmd,shoulder_pos,"
          "elbow_pos")), ("unit: ms",), {"time": {"column": "timeMs", "unit": "ms"}}, truth=put(A, 0, 5e-4 * K)),
    Fault("a temperature in the place of a position", OTHERS, named("shoulder_pos", "elbow_temperature",
          put(A, 4, 31 + 0.01 * K)), ("elbow",), "nothing", absent=("qpos:elbow",)),
    Fault("a voltage in the place of a command", OTHERS, csv(text(A, "t,shoulder_voltage,elbow_voltage,shoulder_pos,"
          "elbow_pos")), ("ctrl",), {"ctrl": {"m_shoulder": "shoulder_voltage", "m_elbow": "elbow_voltage"}}),
    Fault("temperatures beside positions", OTHERS, named("shoulder_pos", "elbow_pos", A,
          ",shoulder_temp,elbow_temp,elbow_status", (31 + 0 * K, 32 + 0 * K, 0 * K))),
    Fault("an acceleration in the place of a position", OTHERS, named("shoulder_pos", "elbow_acc"), ("elbow",),
          "nothing", absent=("qpos:elbow",)),
    Fault("desired, actual and error", ERRORS, csv(text(np.c_[S, S[:, 1] - S[:, 3], S[:, 2] - S[:, 4]],
          "t,pan_desired,tilt_desired,pan_actual,tilt_actual,pan_error,tilt_error")), model="servo"),
    Fault("an error in the place of a reading", ERRORS, csv(text(put(put(S, 3, S[:, 1] - S[:, 3]), 4,
          S[:, 2] - S[:, 4]), "t,pan_desired,tilt_desired,pan_error,tilt_error")), ("qpos", "positions"), "nothing",
          model="servo"),
    Fault("commanded velocities of position servos", QUANTITY, csv(text(put(put(S, 1, np.gradient(S[:, 1], 0.01)), 2,
          np.gradient(S[:, 2], 0.01)), "t,pan_cmd_vel,tilt_cmd_vel,pan_pos,tilt_pos")), ("velocit",), "nothing",
          model="servo"),
    Fault("target positions of motors", QUANTITY, csv(text(put(put(A, 1, A[:, 3] + 0.02), 2, A[:, 4] - 0.01),
          "t,shoulder_target_pos,elbow_target_pos,shoulder_pos,elbow_pos")), ("law: position", "position"), "nothing"),
    Fault("tenths of a degree", BRACKETS, named("shoulder [0.1°]", "elbow_pos", put(SMALL, 3, 10 * SMALL_DEG[:, 3])),
          ("[0.1°]",), {"time": "t", "ctrl": CTRL, "qpos": {"shoulder": {"column": "shoulder [0.1°]",
          "scale": np.pi / 1800}, "elbow": "elbow_pos"}}, truth=SMALL),
    Fault("millidegrees", BRACKETS, named("shoulder_mdeg", "elbow_pos", put(SMALL, 3, 1000 * SMALL_DEG[:, 3])),
          ("mdeg", "unit: deg", "scale"), {"time": "t", "ctrl": CTRL, "qpos": {"shoulder": {"column": "shoulder_mdeg",
          "scale": np.pi / 180000}, "elbow": "elbow_pos"}}, truth=SMALL),
    Fault("one joint in degrees, under its channel's name", RADIANS, csv(plain(put(A, 3, DEG * A[:, 3]))),
          ("unit: deg",), {**ARM, "qpos": {"elbow": "qpos:elbow", "shoulder": {"column": "qpos:shoulder", "unit":
          "deg"}}}),
    Fault("thousandths of a rad as whole numbers", SCALED, csv(plain(put(A, 4, np.round(1000 * A[:, 4])))),
          ("scale", "unit: counts"), {**ARM, "qpos": {"shoulder": "qpos:shoulder", "elbow": {"column": "qpos:elbow",
          "scale": 0.001}}}, within=1e-3),
    Fault("commands in percent of the rated torque", SHARE, csv(text(put(A, 2, 100 / 3 * A[:, 2]),
          "t,shoulder_torque_cmd,elbow_torque_cmd [%],shoulder_pos,elbow_pos", form="%.9g")), ("range",),
          {"time": "t", "ctrl": {"m_shoulder": "shoulder_torque_cmd", "m_elbow": {"column": "elbow_torque_cmd [%]",
          "unit": "percent", "range": [0.0, 3.0]}}}),
    Fault("modes in words", STATES, csv("\n".join([plain(A).splitlines()[0] + ",mode", *(line + (",Idle" if i < 9 else
          ",Move") for i, line in enumerate(plain(A).splitlines()[1:]))]))),
    Fault("drives on and off in words", STATES, csv("\n".join([plain(A).splitlines()[0] + ",enabled:m_elbow", *(line + (
          ",disabled" if i < 9 else ",enabled") for i, line in enumerate(plain(A).splitlines()[1:]))])), ("enabled",),
          "nothing"),
    Fault("a word in one row", MIX, csv(plain(A, form=lambda i, j, x: "ERR" if (i, j) == (77, 4) else f"{x:.9g}")),
          ("bad_rows",), {"bad_rows": "drop"}, truth=np.delete(A, 77, 0)),
    Fault("rows without numbers", MIX, csv(plain(A, form=lambda i, j, x: "nan" if i in (50, 51) and j > 2 else
          f"{x:.9g}")), ("bad_rows",), {"bad_rows": "drop"}, truth=np.delete(A, [50, 51], 0)),
    Fault("a reading that is 0 again in the middle", RESET, elbow(RESETS), ("cut the file", "offset"),
          lambda folder: [(folder / f"run{k}.csv").write_text(plain(A[100 * k:][:100])) for k in (0, 1)],
          pieces=True),
    Fault("two samples far off", SPIKE, elbow(SPIKED), ("jumps",), "nothing"),
    Fault("0.3 s of one value", FROZEN, elbow(FROZE), ("jumps",), "nothing"),
    Fault("a floating base in mm", MOCAP, floating(1000.0), ("unit: mm", "scale"), None, "float", BASE, log_map=None),
    Fault("a floating base with y upwards", MOCAP, floating(upright=True), ("upward", "gravity", "axes"), None, "float",
          BASE),
    Fault("an accelerometer in g", GRAVITY, floating(g=9.80665), ("9.8", "unit"), "nothing", "float", BASE,
          streams={"accel:imu_accel[2]": 9.81 - 0.2 * np.sin(0.02 * K)}),
    Fault("a gyroscope in degrees per second", GRAVITY, floating(rate=DEG), ("rad/s", "deg/s"), "nothing", "float",
          BASE, streams={"gyro:imu_gyro[2]": 0.5 * np.cos(0.01 * K)}),
]  # fmt: skip
