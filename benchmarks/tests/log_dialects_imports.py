"""Faults of other files: JSON lines, NPZ, tables of Parquet and spreadsheets, bags, HDF5 and checkpoints."""

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from log_dialects import A, Fault, S, plain, put

LINES = "stackoverflow.com/questions/12451431: a list of objects in place of one object a line"
TEXTS = "stackoverflow.com/questions/4005318: numbers as texts in JSON"
NAN = "stackoverflow.com/questions/6601812: NaN in JSON"
OBJECTS = "numpy/numpy#12889: arrays of objects need pickle"
TRANSPOSED = "stackoverflow.com, tag numpy: joints along the first axis"
SINGLE = "numpy/numpy: stamps since 1970 in float32"
PARQUET = "huggingface/lerobot: a table of Parquet outside of a data set"
SHEET = "stackoverflow.com/questions/20105118: a spreadsheet in place of a text"
PACKED = "pandas-dev/pandas#26237: compressed CSV"
KILLED = "foxglove/mcap#1038: a recorder that was killed leaves no end of the file"
ENCODED = "foxglove/mcap#850: messages in JSON or protobuf"
ORDER = "ros-controls/ros2_controllers#159: joint_states are in alphabetical order, commands are not"
EMPTY = "ros2/rosbag2#617: messages whose arrays are empty or NaN"
JUMP = "ros-simulation/gazebo_ros_pkgs#1214: the clock of a simulation begins again"
BARE = "ros2/rosbag2#1175: a db3 without its metadata.yaml"
ROWS = "tonyzhaozh/aloha#14: as many actions as states, or one more"
HALF = "h5py/h5py#1283: times as a column, numbers of half precision"
OLD = "pytorch/pytorch#52181: a file of the old form, or of a whole module"
START = 1_700_000_000_000_000_000  # ns
NAMES = ("m_shoulder", "m_elbow"), ("shoulder", "elbow")


def rows_of(value: Callable[[float], Any] = lambda x: x) -> list[dict[str, Any]]:
    """Return the arm's log as objects."""
    ctrl, qpos = NAMES
    return [{"time": value(float(t)), "ctrl": dict(zip(ctrl, map(value, map(float, r[:2])), strict=True)),
             "qpos": dict(zip(qpos, map(value, map(float, r[2:])), strict=True))} for t, *r in A]  # fmt: skip


def lines(objects: list[Any]) -> bytes:
    return "\n".join(json.dumps(o) for o in objects).encode()


def npz(**arrays: Any) -> dict[str, bytes]:
    """Return a folder of one NPZ file: the arm's log with some arrays replaced."""
    own = {"time": A[:, 0], "ctrl": A[:, 1:3], "qpos": A[:, 3:], "joints": NAMES[1], "actuators": NAMES[0]}
    file = io.BytesIO()
    np.savez(file, **{k: np.asarray(v) for k, v in {**own, **arrays}.items() if v is not None})
    return {"run.npz": file.getvalue()}


def parquet(folder: Path) -> None:
    import pyarrow
    from pyarrow import parquet as writer

    table = {n: A[:, i] for i, n in enumerate(plain(A).splitlines()[0].split(","))}
    writer.write_table(pyarrow.table(table), folder / "run.parquet")


def xlsx() -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("[Content_Types].xml", "<Types/>")
        archive.writestr("xl/workbook.xml", "<workbook/>")
    return file.getvalue()


def packed() -> bytes:
    import gzip

    return gzip.compress(plain(A).encode())


HEADER = "std_msgs/Header header\n"
PARTS = "".join(f"{'=' * 80}\nMSG: {name}\n{content}" for name, content in {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n",
    "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride\n",
}.items())  # fmt: skip
STATE = HEADER + "string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n" + PARTS
ARRAY = "std_msgs/MultiArrayLayout layout\nfloat64[] data\n" + PARTS


def stamp(ns: int) -> dict[str, Any]:
    return {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": ""}


def mcap(
    state: Callable[[int, dict[str, Any]], dict[str, Any] | None] = lambda i, body: body,
    label: str = "shoulder,elbow", when: Callable[[int], int] = lambda i: 10_000_000 * i,
    received: Callable[[int], int] | None = None, cut: int | None = None,
) -> Callable[[Path], None]:  # fmt: skip
    """Return what writes run.mcap: states and torques of the arm, both at 100 Hz.

    Args:
        state: (row, message) -> the message that is sent, or None. label: of the array's layout.
        when: (row) -> ns of the header; received: ns of the receipt. cut: bytes from the end that are lost.
    """

    def write(folder: Path) -> None:
        from mcap_ros2.writer import Writer

        with (folder / "run.mcap").open("wb") as file:
            writer = Writer(file)
            states = writer.register_msgdef("sensor_msgs/msg/JointState", STATE)
            arrays = writer.register_msgdef("std_msgs/msg/Float64MultiArray", ARRAY)
            layout = {"dim": [{"label": label, "size": 2, "stride": 2}] if label else [], "data_offset": 0}
            for i, row in enumerate(A):
                at = START + (received or when)(i)
                body = {"header": stamp(START + when(i)), "name": ["shoulder", "elbow"], "position": list(row[3:]),
                        "velocity": [], "effort": []}  # fmt: skip
                sent = state(i, body)
                if sent is not None:
                    writer.write_message("/joint_states", states, sent, at, at)
                writer.write_message("/effort/commands", arrays, {"layout": layout, "data": list(row[1:3])}, at, at)
            writer.finish()
        if cut:
            path = folder / "run.mcap"
            path.write_bytes(path.read_bytes()[:-cut])

    return write


def swapped(i: int, body: dict[str, Any]) -> dict[str, Any]:
    return body if i % 2 else {**body, "name": body["name"][::-1], "position": body["position"][::-1]}


def blank(i: int, body: dict[str, Any]) -> dict[str, Any]:
    return {**body, "name": [], "position": []} if i == 60 else body


def shorter(i: int, body: dict[str, Any]) -> dict[str, Any]:
    return {**body, "position": body["position"][:1]} if i == 60 else body


def in_json(folder: Path) -> None:
    """Messages in JSON, as Foxglove's own schemas have them."""
    from mcap.writer import Writer

    with (folder / "run.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("sensor_msgs/JointState", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/joint_states", "json", schema)
        for i, row in enumerate(A):
            data = json.dumps({"name": NAMES[1], "position": list(row[3:])}).encode()
            writer.add_message(channel, START + 10_000_000 * i, data, START + 10_000_000 * i)
        writer.finish()


def bare(folder: Path) -> None:
    """A bag of ROS 2 of which only the data base was copied."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store: Any = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    with Writer(folder / "bag", version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        kind = "sensor_msgs/msg/JointState"
        topics = [writer.add_connection(t, kind, typestore=store) for t in ("/joint_states", "/joint_commands")]
        for i, row in enumerate(A):
            ns = START + 10_000_000 * i
            moment = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
            header = types["std_msgs/msg/Header"](stamp=moment, frame_id="")
            for topic, x, u in zip(topics, (row[3:].copy(), np.zeros(0)), (np.zeros(0), row[1:3].copy()), strict=True):
                body = types[kind](header, list(NAMES[1]), x, np.zeros(0), u)
                writer.write(topic, ns, store.serialize_cdr(body, kind))
    next((folder / "bag").glob("*.db3")).rename(folder / "run.db3")
    for path in (folder / "bag").iterdir():
        path.unlink()
    (folder / "bag").rmdir()


def hdf5(**arrays: Any) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        import h5py

        own = {"observations/qpos": A[:, 3:], "action": A[:, 1:3]}
        with h5py.File(folder / "run.hdf5", "w") as file:
            for name, values in {**own, **arrays}.items():
                file[name] = values

    return write


def old_pt() -> bytes:
    """The magic number with which files of the old form begin."""
    import pickle

    return pickle.dumps(0x1950A86A20F9469CFC6C, protocol=2) + pickle.dumps(1001, protocol=2)


MCAP = {"convert": ("from-mcap",), "paths": ("run.mcap",)}
H5 = ("from-hdf5", "--joints", "shoulder", "elbow")
HELD = np.delete(A, 60, 0)  # commands are means over rows, and row 59 lasts for two periods
HELD[59, 1:3] = A[59:61, 1:3].mean(axis=0)
OBJECT = np.empty(2, object)
OBJECT[:] = [A[:, 3], A[:, 4]]

FAULTS = [
    Fault("a list of objects", LINES, {"run.json": json.dumps(rows_of()).encode()}, (".jsonl",), lambda folder:
          (folder / "run.jsonl").write_bytes(lines(rows_of()))),
    Fault("a list of objects that is called jsonl", LINES, {"run.jsonl": json.dumps(rows_of(), indent=1).encode()},
          ("one object per line",), lambda folder: (folder / "run.jsonl").write_bytes(lines(rows_of()))),
    Fault("numbers as texts", TEXTS, {"run.jsonl": lines(rows_of(str))}),
    Fault("NaN for what is missing in one line", NAN, {"run.jsonl": lines([{**o, "qpos": {"shoulder": float("nan"),
          "elbow": None}} if i == 33 else o for i, o in enumerate(rows_of())])}, ("bad_rows",), {"bad_rows": "drop"},
          truth=np.delete(A, 33, 0)),
    Fault("lists for joints", TEXTS, {"run.jsonl": lines([{"t": t, "tau": [a, b], "q": [c, d]} for t, a, b, c, d in
          A.tolist()])}, ("qpos",), {"time": "t", "ctrl": {"m_shoulder": "tau[0]", "m_elbow": "tau[1]"},
          "qpos": {"shoulder": "q[0]", "elbow": "q[1]"}}),
    Fault("the last line cut off", TEXTS, {"run.jsonl": lines(rows_of())[:-30]}, ("bad_rows",), {"bad_rows": "drop"},
          truth=A[:-1]),
    Fault("arrays of objects", OBJECTS, npz(qpos=OBJECT), ("plain arrays",), lambda folder: [(folder / n).write_bytes(b)
          for n, b in npz().items()]),
    Fault("joints along the first axis", TRANSPOSED, npz(qpos=A[:, 3:].T, ctrl=A[:, 1:3].T), ("as many as 'time'",),
          lambda folder: [(folder / n).write_bytes(b) for n, b in npz().items()]),
    Fault("stamps in float32", SINGLE, npz(time=(1.7e9 + A[:, 0]).astype(np.float32)), ("rate",),
          {"time": None, "rate": 100}),
    Fault("stamps in ns as whole numbers", SINGLE, npz(time=START + (1e9 * A[:, 0]).astype(np.int64))),
    Fault("stamps as datetime64", SINGLE, npz(time=np.datetime64("2026-03-04T10:15:02.25") + (1e6 * A[:, 0]).round()
          .astype("timedelta64[us]"))),
    Fault("no names of joints", OBJECTS, npz(joints=None), ("joints",), lambda folder: [(folder / n).write_bytes(b)
          for n, b in npz().items()]),
    Fault("a table of Parquet", PARQUET, parquet, ("CSV",), lambda folder: (folder / "run.csv").write_text(plain(A))),
    Fault("a spreadsheet", SHEET, {"run.xlsx": xlsx()}, ("CSV",), lambda folder: (folder / "run.csv").write_text(
          plain(A))),
    Fault("a spreadsheet that is called csv", SHEET, {"run.csv": xlsx()}, ("CSV",), lambda folder: (folder / "run.csv")
          .write_text(plain(A))),
    Fault("a packed file", PACKED, {"run.csv.gz": packed()}, (".csv", "gunzip"), lambda folder: (folder / "run.csv")
          .write_text(plain(A))),
    Fault("a packed file that is called csv", PACKED, {"run.csv": packed()}, ("gunzip",), lambda folder:
          (folder / "run.csv").write_text(plain(A))),
    Fault("joints that change places from message to message", ORDER, mcap(swapped), **MCAP),
    Fault("one message without joints", EMPTY, mcap(blank), truth=HELD, **MCAP),
    Fault("one message with fewer positions than names", EMPTY, mcap(shorter), ("left out", "elbow"),
          within=2e-3, **MCAP),
    Fault("a label that is one word", ORDER, mcap(label="data"), ("--commands",), again=("--commands",
          "/effort/commands=shoulder,elbow"), **MCAP),
    Fault("a label with other joints", ORDER, mcap(label="hip,knee"), ("--commands", "--rename"), again=("--commands",
          "/effort/commands=shoulder,elbow"), **MCAP),
    Fault("a file without its end", KILLED, mcap(cut=300), ("recover", "mcap"), "nothing", **MCAP),
    Fault("a file that ends in the middle", KILLED, mcap(cut=20_000), ("recover",), "nothing", **MCAP),
    Fault("a file of no bytes", KILLED, {"run.mcap": b""}, ("MCAP",), "nothing", **MCAP),
    Fault("messages in JSON", ENCODED, in_json, ("/joint_states",), "nothing", **MCAP),
    Fault("a clock that begins again", JUMP, mcap(when=lambda i: 10_000_000 * (i % 120), received=lambda i:
          10_000_000 * i), ("--stamps received", "begins again", "runs back"), again=("--stamps", "received"), **MCAP),
    Fault("a data base without its metadata", BARE, bare, ("metadata.yaml", "reindex"), "nothing",
          convert=("from-rosbag",), paths=("run.db3",)),
    Fault("times as a column, half precision", HALF, hdf5(**{"t": A[:, :1], "observations/qpos": A[:, 3:].astype(
          np.float16)}), within=2e-3, convert=(*H5, "--commands_of", "m_shoulder", "m_elbow", "--time", "t"),
          paths=("run.hdf5",)),
    Fault("one action more than states", ROWS, hdf5(action=np.vstack([A[:, 1:3], A[:1, 1:3]])), ("rows", "action"),
          "nothing", convert=(*H5, "--commands_of", "m_shoulder", "m_elbow", "--rate", "100"), paths=("run.hdf5",)),
    Fault("joints along the first axis of an HDF5 file", TRANSPOSED, hdf5(**{"observations/qpos": A[:, 3:].T, "action":
          A[:, 1:3].T}), ("columns",), "nothing", convert=(*H5, "--commands_of", "m_shoulder", "m_elbow", "--rate",
          "100"), paths=("run.hdf5",)),
    Fault("stamps in ns in an HDF5 file", HALF, hdf5(t=START + (1e9 * A[:, 0]).astype(np.int64)), ("unit: ns",),
          {"time": {"column": "time", "unit": "ns"}}, convert=(*H5, "--commands_of", "m_shoulder", "m_elbow", "--time",
          "t"), paths=("run.hdf5",)),
    Fault("a checkpoint of the old form", OLD, {"run.pt": old_pt()}, ("PyTorch 1.6",), "nothing", convert=("from-pace",
          "--joints", "shoulder", "elbow"), paths=("run.pt",)),
    Fault("duty cycles as a servo's targets", ORDER, {"run.csv": plain(put(S, 1, np.round(512 + 100 * np.cos(A[:, 0]))
          ), "servo").encode()}, ("`scale`",), "nothing", "servo"),
]  # fmt: skip
