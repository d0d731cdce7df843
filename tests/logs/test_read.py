"""Logs as they are read: CSV and NPZ hold the same, side files and odd columns mean what they say."""

import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_mjx.logs import read_logs, segments, write_log
from tests.logs.log_files import HEADER, refused, rows, write


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
        ("controller: {law: position, kp: 3, ki: 2}", ("controller.ki = 2", "allowed: 0", "with law: direct")),
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
