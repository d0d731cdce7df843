"""Logs: the reader recovers what was written, refuses what cannot be meant, and replays what MuJoCo did."""

import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import Channels, Log, estimate_velocity, noise, read_logs, resample, segments, write_log
from bayessim_mjx.logs.signals import noise_level, quantum

ARM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body><joint name="shoulder" type="hinge" axis="0 1 0"/><geom size=".02" mass="1" pos="0 0 -.2"/>
      <body pos="0 0 -.4"><joint name="elbow" type="hinge" axis="0 1 0" range="-170 170" limited="true"/>
        <geom size=".02" mass="1" pos="0 0 -.2"/></body></body>
  </worldbody>
  <actuator>
    <motor name="m_shoulder" joint="shoulder" ctrllimited="true" ctrlrange="-2 2"/>
    <motor name="m_elbow" joint="elbow"/>
  </actuator>
</mujoco>"""
FREE = """
<mujoco><option timestep="0.005"/><worldbody><body><freejoint name="root"/>
  <geom type="box" size=".1 .2 .3" mass="1"/></body></worldbody></mujoco>"""
HEADER = "time,ctrl:m_shoulder,ctrl:m_elbow,qpos:shoulder,qpos:elbow"


@pytest.fixture(scope="module")
def arm() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM)


def rows(count: int = 40, dt: float = 0.01) -> np.ndarray:
    """[count, 5]: time, two commands, two angles; smooth, known."""
    t = dt * np.arange(count)
    return np.stack([t, np.sin(t), np.cos(t), 0.5 * np.sin(3 * t), 0.2 * np.cos(2 * t)], 1)


def write(folder: Path, table: np.ndarray, header: str = HEADER, name: str = "run.csv") -> Path:
    path = folder / name
    np.savetxt(path, table, "%.12g", ",", header=header, comments="")
    return path


def refused(folder: Path, model: mujoco.MjModel, *words: str, map: object = None) -> None:
    with pytest.raises(UserError) as error:
        read_logs(folder, model, map)  # type: ignore[arg-type]
    text = str(error.value)
    assert "\n" not in text
    for word in words:
        assert word in text, text


# Reading


def test_csv_and_npz_hold_the_same_log(tmp_path: Path, arm: mujoco.MjModel) -> None:
    table = rows()
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    write(tmp_path / "a", table[:, [4, 0, 2, 1, 3]], "qpos:elbow,time,ctrl:m_elbow,ctrl:m_shoulder,qpos:shoulder")
    np.savez(
        tmp_path / "b" / "run.npz",
        time=table[:, 0],
        ctrl=table[:, [2, 1]],
        qpos=table[:, [4, 3]],
        joints=["elbow", "shoulder"],
        actuators=["m_elbow", "m_shoulder"],
    )
    (a,), (b,) = read_logs(tmp_path / "a", arm), read_logs(str(tmp_path / "b"), arm)
    for log in (a, b):
        assert log.joints == ("shoulder", "elbow") and log.actuators == ("m_shoulder", "m_elbow")
        np.testing.assert_allclose(log.qpos, table[:, 3:5], atol=1e-11)
        np.testing.assert_allclose(log.ctrl, table[:, 1:3], atol=1e-11)
        assert not log.has_qvel
    np.testing.assert_allclose(a.qvel, b.qvel, atol=1e-6)
    with pytest.raises(ValueError):
        a.qpos[0] = 0.0  # read-only


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_a_written_log_reads_back(tmp_path: Path, arm: mujoco.MjModel, suffix: str) -> None:
    write(tmp_path, np.c_[rows(), np.ones(40), np.linspace(7, 8, 40)], HEADER + ",enabled:m_elbow,voltage")
    (log,) = read_logs(tmp_path, arm)
    again = read_logs(write_log(tmp_path / "out" / f"copy{suffix}", log, velocity=True), arm)[0]
    assert again.has_qvel
    for key in ("time", "ctrl", "qpos", "qvel"):
        np.testing.assert_allclose(getattr(again, key), getattr(log, key), rtol=1e-7, atol=1e-9)
    assert set(again.streams) == {"enabled:m_elbow", "voltage"}


def test_streams_and_side_yaml_are_kept(tmp_path: Path, arm: mujoco.MjModel) -> None:
    table = [
        ",".join(f"{x:.6g}" for x in r) + f",{'' if i % 4 else 30 + i},{i % 2 == 0},run" for i, r in enumerate(rows())
    ]
    (tmp_path / "run.csv").write_text("\n".join([HEADER + ",temperature,enabled:m_elbow,mode", *table]))
    (tmp_path / "run.yaml").write_text("operating_condition: cold\npayload: 0.5\nsigma: {elbow: 0.25}\n")
    with pytest.warns(UserWarning, match="'mode'.*'run' is not a number.*left out"):
        (log,) = read_logs(tmp_path, arm)
    assert set(log.streams) == {"temperature", "enabled:m_elbow"}
    assert np.isnan(log.streams["temperature"][1]) and log.streams["temperature"][4] == 34
    assert log.metadata["operating_condition"] == "cold" and log.metadata["source"].endswith("run.csv")
    assert log.sigma_qpos[1] == 0.25
    assert log.enabled.tolist() == [i % 2 == 0 for i in range(40)]


def test_side_yaml_declares_condition_noise_and_quantum(tmp_path: Path, arm: mujoco.MjModel) -> None:
    table = np.c_[rows(), rows()[:, 3:5], rows()[:, 1]]
    write(tmp_path, table, HEADER + ",qvel:shoulder,qvel:elbow,effort:m_elbow")
    side = tmp_path / "run.yaml"
    side.write_text("""
condition: warm
repeat_of: other.csv
payload: {mass: 0.3}
controller: {law: position, kp: 12, kd: 0.1, limit: 1.5, scale: 2}
sigma: {elbow: 0.25, "qvel:shoulder": 0.125, "effort:m_elbow": 0.5}
quantum: {"qpos:shoulder": 0.12}
""")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # these velocities are no derivatives
        (log,) = read_logs(tmp_path, arm)
    assert log.condition == "warm" == log.metadata["operating_condition"]
    assert log.metadata["controller"] == {"law": "position", "kp": 12, "kd": 0.1, "limit": 1.5, "scale": 2}
    assert log.metadata["repeat_of"] == "other.csv" and log.metadata["payload"] == {"mass": 0.3}
    np.testing.assert_allclose(log.sigma_qpos, [0.12 / np.sqrt(12), 0.25])
    assert log.sigma_qvel[0] == 0.125 and log.sigma_qvel[1] < 0.1
    for text, words in (
        ("sigma: {elbw: 1}", ("sigma.elbw", "'qpos:elbow'")),
        ("quantum: {elbow: big}", ("quantum.elbow = 'big'", "a number >= 0")),
        ("sigma: {elbow: -1}", ("sigma.elbow = -1", "a number > 0")),
        ("sigma: {elbow: 0}", ("sigma.elbow = 0", "a number > 0")),  # every gap would be infinitely significant
        ("controller: {law: positon, kp: 3}", ("controller.law = 'positon'", "did you mean position?", "note")),
        ("controller: {law: position, kp: 3, kv: 1}", ("controller.kv: there are: law, kp",)),
        ("controller: {kp: 3}", ("controller.kp = 3 without a loop", "law: position")),
        ("controller: {law: position, kp: .inf}", ("controller.kp = inf", "finite")),
        ("controller: {law: position, kp: 3, limit: 0}", ("controller.limit = 0", "a number > 0")),
        ("quantum: 3", ("quantum = 3", "mapping")),
    ):
        side.write_text(text)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            refused(tmp_path, arm, "run.csv", *words)


def test_columns_without_numbers_or_names_are_left_out(tmp_path: Path, arm: mujoco.MjModel) -> None:
    """A comma at the end of each line, the index column of pandas, an effort that was never sampled."""
    lines = [",".join(["7", *map(repr, map(float, r)), "", ""]) for r in rows()]
    (tmp_path / "run.csv").write_text("\n".join(["," + HEADER + ",effort:m_elbow,", *lines]))
    with pytest.warns(UserWarning, match="'effort:m_elbow' holds no finite number; it is left out"):
        (log,) = read_logs(tmp_path, arm)
    assert set(log.streams) == {"unnamed 0"}
    np.testing.assert_allclose(log.qpos, rows()[:, 3:5])


def test_enabled_says_yes_and_no(tmp_path: Path, arm: mujoco.MjModel) -> None:
    """Rows with the drive off must not count as rows of command 0 because of how "off" is spelt."""
    words = ["yes", "no", "On", "OFF"]
    lines = [",".join([*map(repr, map(float, r)), words[i % 4]]) for i, r in enumerate(rows())]
    (tmp_path / "run.csv").write_text("\n".join([HEADER + ",enabled:m_elbow", *lines]))
    (log,) = read_logs(tmp_path, arm)
    assert log.enabled.tolist() == [i % 2 == 0 for i in range(40)]
    (tmp_path / "run.csv").write_text("\n".join([HEADER + ",enabled:m_elbow", *lines]).replace("OFF", "idle"))
    refused(tmp_path, arm, "line 2", "'enabled:m_elbow'", "'yes' is not a number", "a column of true, false, yes, no")


@pytest.mark.parametrize("text", ["no", "true", "\u0661"])
def test_a_word_among_numbers_is_no_number(tmp_path: Path, arm: mujoco.MjModel, text: str) -> None:
    """Nor is a digit of another script, which Python would read."""
    path = write(tmp_path, rows())
    lines = path.read_text().splitlines()
    lines[3] = ",".join([*lines[3].split(",")[:-1], text])
    path.write_text("\n".join(lines), encoding="utf-8")
    refused(tmp_path, arm, "line 4", "'qpos:elbow'", f"{text!r} is not a number")


def test_a_misspelt_key_of_the_side_yaml_is_told(tmp_path: Path, arm: mujoco.MjModel) -> None:
    write(tmp_path, rows())
    (tmp_path / "run.yaml").write_text("controler: {law: position, kp: 3}\nroom: 7\n")
    with pytest.warns(UserWarning, match=r"run\.yaml: key 'controler' has no meaning here; did you mean 'controller'"):
        read_logs(tmp_path, arm)


def test_npz_with_a_channel_twice_or_complex_numbers(tmp_path: Path, arm: mujoco.MjModel) -> None:
    r = rows()
    plain = {"time": r[:, 0], "ctrl": r[:, 1:3], "qpos": r[:, 3:5], "actuators": ["m_shoulder", "m_elbow"]}
    np.savez(tmp_path / "run.npz", **plain, joints=["elbow", "elbow"])
    refused(tmp_path, arm, "run.npz", "'joints' names 'elbow' more than once")
    np.savez(tmp_path / "run.npz", **plain, joints=["shoulder", "elbow"], **{"qpos:elbow": r[:, 4]})
    refused(tmp_path, arm, "run.npz", "two columns are 'qpos:elbow'")
    np.savez(tmp_path / "run.npz", **{**plain, "qpos": r[:, 3:5] * (1 + 1j)}, joints=["shoulder", "elbow"])
    refused(tmp_path, arm, "run.npz", "'qpos[0]' holds complex128", "real numbers")


def test_the_same_recording_counts_once(tmp_path: Path, arm: mujoco.MjModel) -> None:
    first = write(tmp_path, rows())
    copy = write(tmp_path, rows(), name="tmp_copy.csv")
    for given in ([first, first], [tmp_path], [first, copy, tmp_path / ".." / tmp_path.name / "run.csv"]):
        with pytest.warns(UserWarning, match=r"\.csv: the same recording as .*run\.csv; it counts once"):
            logs = read_logs(given if len(given) > 1 else given[0], arm)
        assert [log.name for log in logs] == ["run.csv"]


def test_repeat_of_a_log_that_is_not_there(tmp_path: Path, arm: mujoco.MjModel) -> None:
    write(tmp_path, rows())
    (tmp_path / "run.yaml").write_text("repeat_of: nowhere.csv\n")
    with pytest.warns(UserWarning, match=r"run\.csv: repeat_of = 'nowhere\.csv'.*none of the logs.*allowed: run\.csv"):
        read_logs(tmp_path, arm)
    write(tmp_path, rows(41), name="nowhere.csv")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(read_logs(tmp_path, arm)) == 2


@pytest.mark.parametrize(("mark", "word"), [(";", "semicolons"), ("\t", "tabs"), (" ", "blanks")])
def test_another_delimiter_is_told(tmp_path: Path, arm: mujoco.MjModel, mark: str, word: str) -> None:
    path = write(tmp_path, rows())
    path.write_text(path.read_text().replace(",", mark))
    refused(tmp_path, arm, "run.csv", f"parted by {word}", "delimiter")


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


# The map


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


GOOD_MAP = {"ctrl": {"m_shoulder": 1, "m_elbow": 2}, "qpos": {"shoulder": "qpos:shoulder", "elbow": {"value": 0.0}}}


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


# Bad input


def broken(kind: str) -> tuple[np.ndarray, str]:
    table, header = rows(), HEADER
    if kind == "nan":
        table[6, 4] = np.nan
    if kind == "infinite":
        table[6, 2] = np.inf
    if kind == "time":
        table[9, 0] = table[7, 0]
    if kind == "still":
        table[9, 0] = table[8, 0]
    if kind == "milliseconds":
        table[:, 0] = 1e3 * np.arange(40) * 5
    if kind == "missing":
        table, header = table[:, :4], HEADER.rsplit(",", 1)[0]
    if kind == "joint":
        header = HEADER.replace("qpos:elbow", "qpos:elbw")
    if kind == "actuator":
        header = HEADER.replace("ctrl:m_elbow", "ctrl:m_elow")
    if kind == "prefix":
        header = HEADER.replace("qpos:elbow", "qpso:elbow")
    if kind == "capital":
        header = HEADER.replace("time", "Time")
    if kind == "twice":
        header = HEADER.replace("qpos:elbow", "qpos:shoulder")
    if kind == "short":
        table = table[:5]
    if kind == "unsigned":
        table[:, 2] = (-500 + 50 * np.arange(40)) % 65536
    if kind == "degrees":
        table[:, 3] = 100 * np.sin(10 * table[:, 0])
        table[20:, 3] += 50
    if kind == "millivolts":
        table[:, 1] *= 1000
    if kind == "qvel":
        table, header = np.c_[table, table[:, 3]], HEADER + ",qvel:elbow"
    if kind == "effort":
        table, header = np.c_[table, table[:, 3]], HEADER + ",effort:m_elbo"
    return table, header


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("nan", ("'qpos:elbow'", "line 8", "nan", "finite")),
        ("infinite", ("'ctrl:m_elbow'", "line 8", "inf", "finite")),
        ("time", ("'time'", "line 11", "0.07 s after 0.08 s", "strictly increasing")),
        ("still", ("'time'", "line 11", "strictly increasing")),
        ("milliseconds", ("'time'", "5000 s", "scale: 0.001")),
        ("missing", ("missing column(s) qpos:elbow", "ctrl:m_shoulder", "constant")),
        ("joint", ("'qpos:elbw'", "no such joint", "did you mean 'elbow'", "shoulder")),
        ("actuator", ("'ctrl:m_elow'", "no such actuator", "did you mean 'm_elbow'")),
        ("prefix", ("'qpso:elbow'", "did you mean 'qpos:elbow'")),
        ("capital", ("'Time'", "did you mean 'time'")),
        ("twice", ("'qpos:shoulder'", "more than once")),
        ("short", ("5 rows", "at least 10")),
        ("unsigned", ("'ctrl:m_elbow'", "line 12", "signed: 16")),
        ("degrees", ("'qpos:shoulder'", "rad in one step", "degrees")),
        ("millivolts", ("'ctrl:m_shoulder'", "ctrlrange [-2, 2]", "scale")),
        ("qvel", ("missing column(s) qvel:shoulder",)),
        ("effort", ("'effort:m_elbo'", "did you mean 'm_elbow'")),
    ],
)
def test_bad_columns_are_refused(tmp_path: Path, arm: mujoco.MjModel, kind: str, words: tuple[str, ...]) -> None:
    write(tmp_path, *broken(kind))
    refused(tmp_path, arm, "run.csv", *words)


def test_bad_files_are_refused(tmp_path: Path, arm: mujoco.MjModel) -> None:
    refused(tmp_path, arm, "no log matches", "nothing", "CSV with the columns")
    refused(tmp_path / "nowhere", arm, "nowhere", "no such file or folder")
    refused(tmp_path / "x", arm, map=GOOD_MAP)
    (tmp_path / "notes.txt").write_text("hello")
    refused(tmp_path, arm, "notes.txt")
    refused(tmp_path / "notes.txt", arm, "unknown kind of file '.txt'")
    with pytest.raises(UserError, match="empty"):
        read_logs([], arm)
    path = tmp_path / "run.csv"
    path.write_text(HEADER + "\n")
    refused(tmp_path, arm, "no data rows")
    path.write_text("")
    refused(tmp_path, arm, "no data rows")
    path.write_text(HEADER + "\n" + "0,1,2,3,4\n" * 3 + "0,1,2,3\n")
    refused(tmp_path, arm, "line 5 has 4 fields", "allowed: 5")
    path.write_text(HEADER + "\n" + "0,1,2,3,4\n" * 3 + "0,1,x,3,4\n")
    refused(tmp_path, arm, "line 5", "'ctrl:m_elbow'", "'x' is not a number")
    path.write_bytes(b"\xff\xfe\x00\x01")
    refused(tmp_path, arm, "not a text file")


def test_bad_npz_files_are_refused(tmp_path: Path, arm: mujoco.MjModel) -> None:
    table, path = rows(), tmp_path / "run.npz"
    good = {
        "time": table[:, 0],
        "ctrl": table[:, 1:3],
        "qpos": table[:, 3:],
        "joints": ["shoulder", "elbow"],
        "actuators": ["m_shoulder", "m_elbow"],
    }
    path.write_bytes(b"PK no archive")
    refused(tmp_path, arm, "run.npz", "not a readable NPZ")
    for change, words in (
        ({"joints": ["shoulder", "elbw"]}, ("'elbw'", "did you mean 'elbow'")),
        ({"actuators": ["m_shoulder"]}, ("'ctrl' has 2 columns", "names 1")),
        ({"qpos": table[:-3, 3:]}, ("'qpos' has shape (37, 2)", "40 rows")),
        ({"time": None}, ("missing column(s) time",)),
        ({"joints": None}, ("no array 'joints'", "qpos")),
        ({"actuators": ["m_shoulder", "elbow"]}, ("'ctrl:elbow'", "no such actuator")),
        ({"time": np.array(["a"] * 40)}, ("row 0", "'time'", "not a number")),
        ({"time": np.array([{}] * 40)}, ("not a readable NPZ",)),
    ):
        np.savez(path, **{k: v for k, v in {**good, **change}.items() if v is not None})  # type: ignore[arg-type]
        refused(tmp_path, arm, "run.npz", *words)
    bad = table[:, 3:].copy()
    bad[5, 1] = np.nan
    np.savez(path, **{**good, "qpos": bad})  # type: ignore[arg-type]
    refused(tmp_path, arm, "'qpos:elbow'", "row 5", "nan")


def test_odd_logs_are_mended_with_a_warning(tmp_path: Path, arm: mujoco.MjModel) -> None:
    table = rows(400)
    table[:, 3] = (4 * table[:, 0] + np.pi) % (2 * np.pi) - np.pi
    write(tmp_path, table)
    with pytest.warns(UserWarning, match="'qpos:shoulder' wraps by 2 pi 3 time"):
        (log,) = read_logs(tmp_path, arm)
    np.testing.assert_allclose(log.qpos[:, 0], 4 * table[:, 0], atol=1e-9)
    table = rows()
    table[:, 1] *= 3
    table[5, 1] = 2.5
    write(tmp_path, table)
    with pytest.warns(UserWarning, match="ctrlrange.*clamp"):
        read_logs(tmp_path, arm)
    table = np.c_[rows(200), np.degrees(1.5 * np.cos(3 * rows(200)[:, 0])), -0.4 * np.sin(2 * rows(200)[:, 0])]
    write(tmp_path, table, HEADER + ",qvel:shoulder,qvel:elbow")
    with pytest.warns(UserWarning, match="qvel:shoulder is about 57"):
        read_logs(tmp_path, arm)


def test_a_gap_cuts_the_file(tmp_path: Path, arm: mujoco.MjModel) -> None:
    table = np.delete(rows(100), range(50, 70), axis=0)
    write(tmp_path, table)
    with pytest.warns(UserWarning, match=r"largest 0.21 s after line 51.*cut into 2"):
        logs = read_logs(tmp_path, arm)
    assert [log.name for log in logs] == ["run.csv#0", "run.csv#1"] and [len(log) for log in logs] == [50, 30]
    table = rows(36)
    table[:, 0] += np.repeat(np.arange(4), 9)
    write(tmp_path, table)
    refused(tmp_path, arm, "gap(s)", "no run of 10 samples")


# Numbers


def test_irregular_log_is_resampled(tmp_path: Path, arm: mujoco.MjModel) -> None:
    rng = np.random.default_rng(0)
    t = np.sort(0.0053 * np.arange(600) + rng.uniform(-5e-4, 5e-4, 600))
    table = np.stack([t, np.sign(np.sin(9 * t)), t, np.sin(2 * np.pi * 2 * t), np.cos(5 * t)], 1)
    write(tmp_path, table)
    (log,) = read_logs(tmp_path, arm)
    even = resample(log, 0.005)
    grid = t[0] + 0.005 * np.arange(len(even))
    np.testing.assert_allclose(even.time, grid, atol=1e-9)
    np.testing.assert_allclose(even.qpos[:, 0], np.sin(2 * np.pi * 2 * grid), atol=2e-5)  # cubic: h^4 w^4 / 100
    assert np.abs(resample(log, 0.005, "linear").qpos[:, 0] - np.sin(4 * np.pi * grid)).max() < 1e-3
    inner = slice(4, -4)
    assert np.abs(even.qvel[inner, 0] - 4 * np.pi * np.cos(4 * np.pi * grid[inner])).max() < 0.02 * 4 * np.pi
    # the impulse of the held command is kept
    steps = np.diff(np.append(t, grid[-1] + 0.005))
    assert 0.005 * even.ctrl[:, 0].sum() == pytest.approx((table[:, 1] * steps)[: len(t)].sum(), abs=1e-9)
    assert np.abs(even.ctrl[:, 1] - grid).max() < 0.0053 * 1.5


def test_an_even_log_passes_unchanged(tmp_path: Path, arm: mujoco.MjModel) -> None:
    write(tmp_path, rows())
    (log,) = read_logs(tmp_path, arm)
    same = resample(log, 0.01)
    assert np.array_equal(same.ctrl, log.ctrl) and np.array_equal(same.qpos, log.qpos)
    coarse = resample(log, 0.02)  # commands of two rows are averaged over the step they share
    np.testing.assert_allclose(coarse.ctrl[:-1], 0.5 * (log.ctrl[0:-2:2] + log.ctrl[1:-1:2]), atol=1e-9)
    for bad in ({"dt": 0.0}, {"dt": 1e-4}, {"dt": 5.0}, {"dt": 0.005, "kind": "spline"}):
        with pytest.raises(UserError, match="allowed"):
            resample(log, **bad)  # type: ignore[arg-type]


def test_segments(tmp_path: Path, arm: mujoco.MjModel) -> None:
    for k in range(2):
        write(tmp_path, rows(50 - 20 * k), name=f"{k}.csv")
    logs = read_logs(tmp_path, arm)
    data = segments(logs, 10, stride=5)
    assert data["qpos"].shape == (8 + 4, 11, 2) and data["command"].shape == (12, 10, 2)
    assert data["run"].tolist() == [0] * 8 + [1] * 4 and data["start"][:3].tolist() == [0, 5, 10]
    np.testing.assert_array_equal(data["qpos0"], data["qpos"][:, 0])
    np.testing.assert_allclose(data["command"][1], logs[0].ctrl[5:15], rtol=1e-6)
    np.testing.assert_allclose(data["qpos"][9], logs[1].qpos[5:16], rtol=1e-6)
    assert all(v.dtype == np.float32 for k, v in data.items() if k not in ("run", "start"))
    # the recording around each start; beyond the ends of a log the end is held
    near = segments(logs, 10, stride=5, rows=3)
    for name, log, first in (("around_qpos", logs[0].qpos, 0), ("around_command", logs[1].ctrl, 8)):
        assert near[name].shape == (12, 7, 2)
        np.testing.assert_allclose(near[name][first], log[[0, 0, 0, 0, 1, 2, 3]], rtol=1e-6)
        np.testing.assert_allclose(near[name][first + 1], log[2:9], rtol=1e-6)
    assert len(segments(logs[0], 10)["qpos0"]) == 4
    assert segments(logs, 10, dt=0.005)["qpos"].shape == (9 + 5, 11, 2)
    with pytest.raises(UserError, match="no log holds 60 control steps.*'0.csv' with 49.*trainTrajLen"):
        segments(logs, 60)
    with pytest.raises(UserError, match="length = 0"):
        segments(logs, 0)
    with pytest.raises(UserError, match="no logs"):
        segments([], 5)
    with pytest.raises(UserError, match="'1.csv'.*not sampled evenly"):
        segments([logs[0], resample(logs[1], 0.005)], 5)


def test_windows_with_the_drive_off_are_left_out(tmp_path: Path, arm: mujoco.MjModel) -> None:
    on = (np.arange(60) < 33).astype(float)
    write(tmp_path, np.c_[rows(60), on], HEADER + ",enabled:m_elbow")
    (log,) = read_logs(tmp_path, arm)
    assert segments(log, 10)["start"].tolist() == [0, 10, 20]
    fine = resample(log, 0.004)
    assert fine.enabled[:82].all() and not fine.enabled[82:].any()  # rows 0..32 act until t = 0.33 = 82.5 steps
    with pytest.raises(UserError, match="drive switched off"):
        segments(log, 40)


def test_quantum_and_noise() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(2000) / 200
    clean = np.sin(2 * np.pi * t)
    step = 2 * np.pi / 4096
    assert quantum(np.round(clean / step) * step) == pytest.approx(step, rel=1e-6)
    assert quantum(clean) == 0.0 and quantum(np.zeros(50)) == 0.0
    assert noise_level(clean + 3e-3 * rng.standard_normal(2000)) == pytest.approx(3e-3, rel=0.1)
    assert step / np.sqrt(12) <= noise_level(np.round(clean / step) * step) < 1.3 * step / np.sqrt(12)
    assert noise_level(clean) < 1e-6


def test_velocity_from_noisy_positions(arm: mujoco.MjModel) -> None:
    rng = np.random.default_rng(2)
    t = np.arange(1000) / 200
    truth = np.stack([np.cos(6 * t) * 3, -np.sin(15 * t) * 3], 1)
    sigma = np.array([5e-4, 2e-3])
    seen = np.stack([0.5 * np.sin(6 * t), 0.2 * np.cos(15 * t)], 1) + sigma * rng.standard_normal((1000, 2))
    velocity, spread = estimate_velocity(t, seen, Channels.of(arm), sigma)
    rms = np.sqrt(np.mean((velocity - truth) ** 2, axis=0))
    assert (rms < [0.01, 0.04]).all(), rms  # a plain difference gives sigma sqrt(2) 200 = 0.14 and 0.57 rad/s
    assert (rms < 4 * spread).all() and (rms > 0.5 * spread).all()
    lag = np.argmax(np.correlate(velocity[:, 1], truth[:, 1], "full")) - 999
    assert lag == 0  # zero phase


def test_noise_pools_logs(tmp_path: Path, arm: mujoco.MjModel) -> None:
    rng = np.random.default_rng(3)
    for k, sigma in enumerate((1e-3, 3e-3)):
        table = rows(2000, 0.005)
        table[:, 3:] += sigma * rng.standard_normal((2000, 2))
        write(tmp_path, table, name=f"{k}.csv")
    level = noise(read_logs(tmp_path, arm))
    np.testing.assert_allclose(level["qpos"], np.sqrt(5) * 1e-3, rtol=0.1)
    assert level["qvel"].shape == (2,)


# Against the simulator


def test_a_log_of_mujoco_replays_exactly(tmp_path: Path, arm: mujoco.MjModel) -> None:
    data = mujoco.MjData(arm)
    rng = np.random.default_rng(4)
    commands = np.repeat(rng.uniform(-1, 1, (40, 2)), 5, axis=0)
    recorded = []
    for u in commands:
        recorded.append(np.r_[data.time, u, data.qpos, data.qvel])
        data.ctrl[:] = u
        mujoco.mj_step(arm, data)
    write(tmp_path, np.array(recorded), HEADER + ",qvel:shoulder,qvel:elbow")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (log,) = read_logs(tmp_path, arm)
    window = segments(log, 50, dt=0.005)
    for i in range(len(window["qpos0"])):
        mujoco.mj_resetData(arm, data)
        data.qpos[:], data.qvel[:] = window["qpos0"][i], window["qvel0"][i]
        for k, u in enumerate(window["command"][i]):
            data.ctrl[:] = u
            mujoco.mj_step(arm, data)
            np.testing.assert_allclose(data.qpos, window["qpos"][i, k + 1], atol=1e-5)


DFKI = Path(__file__).resolve().parents[2] / "shared" / "data" / "dfki_simple_pendulum"


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
