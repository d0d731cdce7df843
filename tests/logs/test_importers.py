"""Recordings of other tools, written by their own libraries, come back as the logs that they are."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from bayessim_mjx.logs import Log, read_logs
from tests.logs.importing import START, call, error, model_of, read
from tests.logs.log_files import ARM

JOINTS = ("shoulder", "elbow")
STATES, SENT, FELT = "/joint_states", "/effort_controller/commands", "/imu/data"


def angle(joint: str, t: np.ndarray | float) -> Any:
    return 0.4 * np.sin(3 * t) if joint == "shoulder" else 0.3 * np.cos(5 * t)


def command(t: np.ndarray | float) -> Any:
    return np.round(np.sin(2 * t), 2), np.round(np.cos(3 * t), 2)


def events() -> Iterator[tuple[str, int, Any]]:
    """(topic, ns of receipt, content): states every 5 ms, joints in any order; commands; an IMU."""
    for k in range(80):
        order = JOINTS if k % 2 else JOINTS[::-1]
        t, ns = 0.005 * k, START + 5_000_000 * k
        body = {
            "name": list(order),
            "position": [angle(j, t) for j in order],
            "velocity": [],
            "effort": [k * 1.0, -k * 1.0],
        }
        yield STATES, ns + 300_000, {"header": ns, **body}  # received 0.3 ms after it was measured
        if k % 2 == 0:
            yield SENT, ns, {"data": [float(u) for u in command(t)]}
    for k in range(57):
        yield FELT, START + 7_000_000 * k, {"header": START + 7_000_000 * k, "gyro": 0.007 * k, "accelerometer": 9.81}


def as_sent(log: Log, dt: float = 0.005, rows: int = 80) -> None:
    """Return the log of `events`: positions at their own times, commands held for two rows, the IMU interpolated."""
    t = dt * np.arange(rows)
    np.testing.assert_allclose(log.time, t, atol=1e-9)
    np.testing.assert_allclose(log.qpos, np.stack([angle(j, t) for j in JOINTS], 1), atol=1e-9)
    held = command(0.01 * (np.arange(rows) // 2))
    np.testing.assert_allclose(log.ctrl, np.stack(held, 1), atol=1e-9)


MCAP = {
    STATES: ("sensor_msgs/msg/JointState", "std_msgs/Header header\nstring[] name\nfloat64[] position\n"
             "float64[] velocity\nfloat64[] effort\n"),
    SENT: ("std_msgs/msg/Float64MultiArray", "std_msgs/MultiArrayLayout layout\nfloat64[] data\n"),
    FELT: ("sensor_msgs/msg/Imu", "std_msgs/Header header\ngeometry_msgs/Vector3 angular_velocity\n"
           "geometry_msgs/Vector3 linear_acceleration\n"),
}  # fmt: skip
PARTS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n",
    "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride\n",
}


def write_mcap(path: Path) -> None:
    writer_of = pytest.importorskip("mcap_ros2.writer", reason="the extra [logs] is not installed")
    parts = "".join(f"{'=' * 80}\nMSG: {name}\n{text}" for name, text in PARTS.items())
    with path.open("wb") as file:
        writer = writer_of.Writer(file)
        schemas = {topic: writer.register_msgdef(kind, text + parts) for topic, (kind, text) in MCAP.items()}
        for topic, ns, content in events():
            body = dict(content)
            if "header" in body:
                body["header"] = {
                    "stamp": {"sec": body["header"] // 10**9, "nanosec": body["header"] % 10**9},
                    "frame_id": "",
                }
            if topic == SENT:
                body["layout"] = {"dim": [{"label": ",".join(JOINTS), "size": 2, "stride": 2}], "data_offset": 0}
            if topic == FELT:
                body["angular_velocity"] = {"x": body.pop("gyro"), "y": 0.0, "z": 0.0}
                body["linear_acceleration"] = {"x": 0.0, "y": 0.0, "z": body.pop("accelerometer")}
            writer.write_message(topic, schemas[topic], body, ns, ns)
        writer.finish()


def write_rosbag(path: Path) -> None:
    """Write a bag of ROS 2 (a folder), or of ROS 1 (a file)."""
    pytest.importorskip("rosbags", reason="the extra [logs] is not installed")
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    first = path.suffix == ".bag"
    store: Any = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
    types = store.types
    more = {"seq": 0} if first else {}

    def header(ns: int) -> Any:
        moment = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        return types["std_msgs/msg/Header"](stamp=moment, frame_id="", **more)

    def array(values: list[float]) -> np.ndarray:
        return np.array(values, float)

    def body(topic: str, content: dict) -> Any:
        if topic == STATES:
            fields = {f: array(content[f]) for f in ("position", "velocity", "effort")}
            return types["sensor_msgs/msg/JointState"](header(content["header"]), content["name"], **fields)
        layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
        return types["std_msgs/msg/Float64MultiArray"](layout, array(content["data"]))

    kinds = {STATES: "sensor_msgs/msg/JointState", SENT: "std_msgs/msg/Float64MultiArray"}
    with Writer1(path) if first else Writer2(path, version=9) as writer:
        connections = {t: writer.add_connection(t, kind, typestore=store) for t, kind in kinds.items()}
        for topic, ns, content in events():
            if topic in kinds:
                raw = store.serialize_ros1 if first else store.serialize_cdr
                writer.write(connections[topic], ns, raw(body(topic, content), kinds[topic]))


def test_an_mcap_file_is_the_log_that_was_sent(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    write_mcap(tmp_path / "run.mcap")
    told = call(capsys, "from-mcap", tmp_path / "run.mcap", "--out", tmp_path / "logs", "--model", model_of(tmp_path))
    assert STATES in told and SENT in told and "diagnose --model" in told
    log = read(tmp_path / "logs")
    as_sent(log)
    np.testing.assert_allclose(log.streams["effort:m_elbow"][1:4], [-1, 2, -3])  # by name, whatever the order
    np.testing.assert_allclose(log.streams["imu.gyro.x"][:79], log.time[:79], atol=1e-9)
    assert "exists" not in (text := error(capsys, "from-mcap", tmp_path / "run.mcap", "--out", tmp_path / "logs"))
    assert "--out" in text and "a new folder" in text
    (tmp_path / "no.mcap").write_bytes(b"no mcap at all")
    assert "not a readable MCAP" in error(capsys, "from-mcap", tmp_path / "no.mcap", "--out", tmp_path / "x")


@pytest.mark.parametrize("name", ["run.bag", "run"])
def test_a_ros_bag_is_the_log_that_was_sent(tmp_path: Path, capsys: pytest.CaptureFixture, name: str) -> None:
    write_rosbag(tmp_path / name)
    start = ("from-rosbag", tmp_path / name, "--out", tmp_path / "logs", "--model", model_of(tmp_path))
    text = error(capsys, *start)
    assert f"{SENT} does not say which of its 2 values is whose" in text and "--commands" in text
    call(capsys, *start, "--commands", f"{SENT}=shoulder,elbow")
    as_sent(read(tmp_path / "logs"))


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_a_lerobot_data_set_is_a_log_per_episode(tmp_path: Path, capsys: pytest.CaptureFixture, version: str) -> None:
    pyarrow = pytest.importorskip("pyarrow", reason="the extra [logs] is not installed")
    parquet = pytest.importorskip("pyarrow.parquet")
    names = [f"{j}.pos" for j in JOINTS] if version == "v3.0" else {"motors": list(JOINTS)}
    feature = {"dtype": "float32", "shape": [2], "names": names}
    info = {"codebase_version": version, "fps": 200, "total_episodes": 2}
    (tmp_path / "set" / "meta").mkdir(parents=True)
    features = {"observation.state": feature, "action": feature}
    (tmp_path / "set" / "meta" / "info.json").write_text(json.dumps({**info, "features": features}))
    t, tables = 0.005 * np.arange(80), []
    for episode in range(2):
        state = np.degrees(np.stack([angle(j, t + episode) for j in JOINTS], 1))
        action = np.degrees(np.stack(command(0.01 * (np.arange(80) // 2)), 1))
        index = {"episode_index": [episode] * 80, "frame_index": list(range(80)), "timestamp": t.astype(np.float32)}
        tables.append(pyarrow.table({"observation.state": state.tolist(), "action": action.tolist(), **index}))
    data = tmp_path / "set" / "data" / "chunk-000"
    data.mkdir(parents=True)
    if version == "v3.0":
        parquet.write_table(pyarrow.concat_tables(tables), data / "file-000.parquet")
    else:
        for episode, table in enumerate(tables):
            parquet.write_table(table, data / f"episode_{episode:06d}.parquet")
    start = ("from-lerobot", tmp_path / "set", "--model", model_of(tmp_path))
    told = call(capsys, *start, "--out", tmp_path / "logs", "--scale", repr(np.pi / 180))
    assert "2 log(s)" in told
    logs = read_logs(tmp_path / "logs", mujoco.MjModel.from_xml_string(ARM))
    as_sent(logs[0])
    assert "degrees" in call(capsys, *start, "--out", tmp_path / "one", "--episodes", "1")
    assert len(list((tmp_path / "one").glob("*.csv"))) == 1
    assert "no episode 7" in error(capsys, *start, "--out", tmp_path / "none", "--episodes", "7")
    assert "meta/info.json" in error(capsys, "from-lerobot", tmp_path, "--out", tmp_path / "x")


def test_arrays_of_an_hdf5_file_are_logs(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    h5py = pytest.importorskip("h5py", reason="the extra [logs] is not installed")
    t = 0.005 * np.arange(80)
    state, action = np.stack([angle(j, t) for j in JOINTS], 1), np.stack(command(0.01 * (np.arange(80) // 2)), 1)
    with h5py.File(tmp_path / "run.hdf5", "w") as file:
        for path, values in (("observations/qpos", state), ("observations/effort", state), ("action", action)):
            file[path] = values
        for run in (2, 10):
            file[f"data/demo_{run}/q"], file[f"data/demo_{run}/u"], file[f"data/demo_{run}/t"] = state, action, t
    start = ("from-hdf5", tmp_path / "run.hdf5", "--model", model_of(tmp_path), "--joints", *JOINTS)
    arrays = ("--positions", "observations/qpos", "--efforts", "observations/effort", "--commands", "action")
    call(capsys, *start, *arrays, "--rate", "200", "--out", tmp_path / "logs")
    log = read(tmp_path / "logs")
    as_sent(log)
    np.testing.assert_allclose(log.streams["effort:m_elbow"], state[:, 1], atol=1e-9)
    runs = ("--positions", "data/*/q", "--commands", "data/*/u", "--time", "data/*/t")
    call(capsys, *start, *runs, "--out", tmp_path / "runs")
    assert [p.name for p in sorted((tmp_path / "runs").glob("*.csv"))] == ["run_demo_10.csv", "run_demo_2.csv"]
    as_sent(
        read_logs(
            tmp_path / "runs" / "run_demo_2.csv", mujoco.MjModel.from_xml_string(ARM), tmp_path / "runs" / "map.yaml"
        )[0]
    )
    call(capsys, *start, "--rate", "200", "--out", tmp_path / "usual")  # of ALOHA's paths, without velocities
    as_sent(read(tmp_path / "usual"))
    assert "no array at 'a/b'" in error(capsys, *start, "--velocities", "a/b", "--rate", "200", "--out", tmp_path / "x")
    assert "neither --time nor --rate" in error(capsys, *start, "--out", tmp_path / "x")
    assert "has 1" in error(capsys, *start[:-1], *arrays, "--rate", "200", "--out", tmp_path / "x")


LOW = {
    "/lowstate": ("unitree_hg/msg/LowState", "uint32 tick\nIMUState imu_state\nMotorState[35] motor_state\n"),
    "/lowcmd": ("unitree_hg/msg/LowCmd", "uint8 mode_pr\nMotorCmd[35] motor_cmd\n"),
}
MOTORS = (
    f"{'=' * 80}\nMSG: unitree_hg/IMUState\nfloat32[3] gyroscope\nfloat32[3] accelerometer\n"
    f"{'=' * 80}\nMSG: unitree_hg/MotorState\nuint8 mode\nfloat32 q\nfloat32 dq\nfloat32 tau_est\n"
    f"{'=' * 80}\nMSG: unitree_hg/MotorCmd\nuint8 mode\nfloat32 q\nfloat32 dq\nfloat32 tau\nfloat32 kp\nfloat32 kd\n"
)
NAMES = {18: "shoulder", 25: "elbow"}  # numbers among 35 motors


def test_an_mcap_file_of_unitrees_messages_is_read(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    writer_of = pytest.importorskip("mcap_ros2.writer", reason="the extra [logs] is not installed").Writer
    with (tmp_path / "low.mcap").open("wb") as file:
        writer = writer_of(file)
        schemas = {topic: writer.register_msgdef(kind, text + MOTORS) for topic, (kind, text) in LOW.items()}
        for k in range(80):
            q = {i: float(angle(joint, 0.005 * k)) for i, joint in NAMES.items()}
            imu = {"gyroscope": [0.5, 0.0, 0.0], "accelerometer": [0.0, 0.0, 9.5]}
            seen = [{"mode": 1, "q": q.get(i, 0.0), "dq": 0.0, "tau_est": 0.0} for i in range(35)]
            goal = [
                {"mode": 1, "q": 0.5 * q.get(i, 0.0), "dq": 0.0, "tau": 0.0, "kp": 30.0, "kd": 1.0} for i in range(35)
            ]
            for topic, body in (
                ("/lowstate", {"tick": k, "imu_state": imu, "motor_state": seen}),
                ("/lowcmd", {"motor_cmd": goal}),
            ):
                writer.write_message(topic, schemas[topic], body, START + 5_000_000 * k, START + 5_000_000 * k)
        writer.finish()
    start = ("from-mcap", tmp_path / "low.mcap", "--model", model_of(tmp_path), "--out")
    assert "`--joints`" in error(capsys, *start, tmp_path / "no")
    joints = [NAMES.get(i, f"motor{i}") for i in range(26)]
    out = call(capsys, *start, tmp_path / "logs", "--joints", *joints)
    assert "low.yaml declares the position law of m_shoulder, m_elbow" in out
    (log,) = read_logs(tmp_path / "logs", mujoco.MjModel.from_xml_string(ARM))
    t = 0.005 * np.arange(80)
    np.testing.assert_allclose(log.qpos, np.stack([angle(j, t) for j in JOINTS], 1), atol=1e-6)
    np.testing.assert_allclose(log.ctrl, 0.5 * log.qpos, atol=1e-6)
    assert set(log.streams["imu.accelerometer.z"]) == {9.5} and set(log.streams["imu.gyro.x"]) == {0.5}
    assert log.metadata["controller"]["m_elbow"] == {"law": "position", "kp": 30.0, "kd": 1.0}
