"""Foreign logs by a map: units, signs, registers, constants; bad maps are refused."""

import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_mjx.logs import Channels, Log, read_logs, resample, segments
from bayessim_mjx.logs.csv_files import read_csv
from bayessim_mjx.logs.mapping import Source
from tests.logs.log_files import FREE, GOOD_MAP, refused, rows, write

WHOLE = {"ctrl": {"m_shoulder": 1, "m_elbow": 2}, "qpos": {"shoulder": 3, "elbow": 4}}


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"qpos": {"elbow": {"column": "q", "signed": 5000}}}, ("qpos.elbow.signed = 5000", "2 to 64")),
        ({**WHOLE, "time": {"column": "time", "scale": 1e-320}}, ("median step", "at least 1e-06 s per row")),
        (
            {**WHOLE, "qpos": {"shoulder": 3, "elbow": {"column": 4, "scale": 1e299}}},
            ("'qpos:elbow'", "finite numbers below 1e+15"),
        ),
        ({"files": "/etc/*"}, ("files = '/etc/*'", "inside the folder")),
        ({"files": "../*"}, ("files = '../*'", "inside the folder")),
        ({"files": ""}, ("files = ''", "inside the folder")),
    ],
)
def test_maps_that_once_ended_in_a_traceback(tmp_path: Path, arm: mujoco.MjModel, entry: dict, words: tuple) -> None:
    write(tmp_path, rows())
    refused(tmp_path, arm, *words, map=entry)


def test_free_joint_by_index_and_quaternion_velocity(tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_string(FREE)
    channels = Channels.of(model)
    assert channels.qpos == tuple(f"root[{i}]" for i in range(7)) and len(channels.qvel) == 6
    data = mujoco.MjData(model)
    data.qvel[:] = [0.3, -0.1, 2.0, 0.4, 1.5, -0.7]
    recorded = []
    for _ in range(200):
        recorded.append(np.r_[data.time, data.qpos, data.qvel])
        mujoco.mj_step(model, data)
    table = np.array(recorded)
    table[100:, 4:8] *= -1  # the same attitude with the other sign
    write(tmp_path, table[:, :8], "time," + ",".join(f"qpos:{c}" for c in channels.qpos))
    (log,) = read_logs(tmp_path, model)
    # MuJoCo's velocity lies half a step behind its position (semi-implicit Euler)
    truth = 0.5 * (table[1:, 8:] + table[:-1, 8:])
    np.testing.assert_allclose(log.qvel[5:-5], truth[5:-4], atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(resample(log, 0.003).qpos[:, 3:], axis=1), 1.0, atol=1e-12)
    bad = table[:, :8].copy()
    bad[7, 4:8] *= 1.1
    write(tmp_path, bad, "time," + ",".join(f"qpos:{c}" for c in channels.qpos))
    refused(tmp_path, model, "run.csv", "'root'", "line 9", "norm 1.1")


def test_quaternions_in_the_order_of_ros_are_warned_of(tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_string(FREE)
    half = 0.3 * np.sin(0.05 * np.arange(100))
    table = np.zeros((100, 8))
    table[:, 0], table[:, 6], table[:, 7] = 0.01 * np.arange(100), np.sin(half), np.cos(half)
    write(tmp_path, table, "time," + ",".join(f"qpos:root[{i}]" for i in range(7)))
    with pytest.warns(UserWarning, match=r"'root' is \d+ degrees or more .*x y z w: `qpos: \{root\[3\]: COLUMN_OF_W"):
        read_logs(tmp_path, model)
    entries = {f"root[{i}]": f"qpos:root[{j}]" for i, j in enumerate((0, 1, 2, 6, 3, 4, 5))}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (log,) = read_logs(tmp_path, model, {"qpos": entries})
    np.testing.assert_allclose(log.qpos[:, 3], np.cos(half), atol=1e-9)


def test_map_changes_unit_sign_offset_and_register(tmp_path: Path, arm: mujoco.MjModel) -> None:
    table = rows()
    degrees = np.degrees(table[:, 3]) + 90.0
    register = (-1000 * table[:, 1]).round() % 65536
    counts = (4096 + table[:, 4] * 4096 / (2 * np.pi)) % 4096
    foreign = np.stack([table[:, 0] * 1000, degrees, register, table[:, 2], counts], 1)
    path = tmp_path / "foreign.txt"
    np.savetxt(path, foreign, "%.12g", ";", header="ms;deg;reg;u;enc", comments="")
    (tmp_path / "map.yaml").write_text("""
files: "*.txt"
delimiter: ";"
time: {column: ms, scale: 0.001}
ctrl:
  m_shoulder: {column: reg, signed: 16, scale: 0.001, sign: -1}
  m_elbow: u
qpos:
  shoulder: {column: 1, scale: 0.017453292519943295, offset: -1.5707963267948966}
  elbow: {column: enc, wrap: 4096, scale: 0.0015339807878856412}
metadata: {operating_condition: foreign}
""")
    (log,) = read_logs(tmp_path, arm)
    np.testing.assert_allclose(log.time, table[:, 0], atol=1e-12)
    np.testing.assert_allclose(log.ctrl, table[:, 1:3], atol=6e-4)
    np.testing.assert_allclose(log.qpos[:, 0], table[:, 3], atol=1e-9)
    turns = (log.qpos[:, 1] - table[:, 4]) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns[0]), atol=1e-9)
    assert log.metadata["operating_condition"] == "foreign"


def test_map_holds_an_unrecorded_joint_constant(tmp_path: Path, arm: mujoco.MjModel) -> None:
    write(tmp_path, rows())
    (log,) = read_logs(tmp_path, arm, GOOD_MAP)
    assert not log.qpos[:, 1].any() and log.qpos[:, 0].any()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tme": "t"}, ("unknown key 'tme'", "did you mean 'time'")),
        ({"ctrl": {"m_elbow": {"column": 1, "scle": 2}}}, ("ctrl.m_elbow.scle", "did you mean 'scale'")),
        ({"ctrl": {"m_elbow": {"column": 1, "scale": "big"}}}, ("ctrl.m_elbow.scale = 'big'", "a number")),
        ({"ctrl": {"m_elbow": {"column": 1, "sign": 2}}}, ("sign = 2", "1 or -1")),
        ({"ctrl": {"m_elbow": {"scale": 1}}}, ("either column or value",)),
        ({"ctrl": {"m_elbo": "u"}}, ("ctrl.m_elbo", "did you mean 'm_elbow'")),
        ({"ctrl": {**GOOD_MAP["ctrl"], "m_elbow": "u"}}, ("no column 'u'", "ctrl.m_elbow", "run.csv")),
        ({"ctrl": {**GOOD_MAP["ctrl"], "m_elbow": 9}}, ("no column 9", "0 to 4")),
        ({"qpos": "elbow"}, ("qpos is 'elbow'", "mapping")),
        ({"delimiter": "tab"}, ("delimiter = 'tab'", "one character")),
    ],
)
def test_bad_maps_are_refused(tmp_path: Path, arm: mujoco.MjModel, change: dict, words: tuple[str, ...]) -> None:
    write(tmp_path, rows())
    refused(tmp_path, arm, *words, map={**GOOD_MAP, **change})


def test_map_files_that_cannot_be_read(tmp_path: Path, arm: mujoco.MjModel) -> None:
    write(tmp_path, rows())
    refused(tmp_path, arm, "nowhere.yaml", map=tmp_path / "nowhere.yaml")
    (tmp_path / "map.yaml").write_text("a: [1\n")
    refused(tmp_path, arm, "map.yaml", "YAML")


DFKI = Path(__file__).resolve().parents[3] / "shared" / "data" / "dfki_simple_pendulum"


@pytest.mark.skipif(not DFKI.is_dir(), reason="the DFKI pendulum's logs are not in ../shared/data")
def test_foreign_logs_of_the_dfki_pendulum_by_map() -> None:
    xml = """<mujoco>
    <worldbody><body><joint name="hinge" axis="0 1 0"/><geom size=".05" mass=".5" pos="0 0 -.5"/></body></worldbody>
    <actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
    log_map = {
        "files": "*ddp_data_measured.csv",
        "ctrl": {"motor": "torque"},
        "qpos": {"hinge": "position"},
        "qvel": {"hinge": "velocity"},
    }
    (log,) = read_logs(DFKI, mujoco.MjModel.from_xml_string(xml), log_map)
    assert isinstance(log, Log) and log.has_qvel and 1e-3 < log.period < 6e-3 and log.duration > 5
    assert segments(log, 50, dt=0.005)["qpos"].shape[1:] == (51, 1)


@pytest.mark.parametrize("sign", [1, -1])
def test_an_offset_is_in_the_models_unit_whatever_the_sign(sign: int, tmp_path: Path) -> None:
    """value = sign * scale * raw + offset."""
    np.savetxt(tmp_path / "t.csv", [[1.0], [2.0]], header="deg", comments="")
    found = Source("deg", sign=sign, scale=10.0, offset=3.0).read(read_csv(tmp_path / "t.csv"), "here")
    np.testing.assert_allclose(found, [3.0 + sign * 10.0, 3.0 + sign * 20.0])
