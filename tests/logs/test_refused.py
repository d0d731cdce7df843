"""What cannot be a log is refused with file, column and row; what can be mended is, with a warning."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import read_logs
from tests.logs.log_files import GOOD_MAP, HEADER, refused, rows, write


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
