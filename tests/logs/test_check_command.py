"""`bayessim-mjx logs check`: what it shows, the map that it writes, and what it says is missing."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_mjx import import_logs
from bayessim_mjx.diagnosis.logcheck import gate
from bayessim_mjx.logs import read_logs
from bayessim_mjx.logs.names import parts
from bayessim_mjx.logs.proposal import propose
from tests.logs.importing import error, model_of
from tests.logs.log_files import ARM, HEADER, rows, write

MODEL = mujoco.MjModel.from_xml_string(ARM)


def check(capsys: pytest.CaptureFixture, *argv: str | Path) -> tuple[int, str]:
    code = import_logs.main(["check", *map(str, argv)])
    out = capsys.readouterr()
    assert not out.err, out.err
    return code, out.out


def logs_of(tmp_path: Path, table: np.ndarray, header: str, name: str = "run.csv") -> Path:
    (tmp_path / "logs").mkdir(exist_ok=True)
    write(tmp_path / "logs", table, header, name)
    return tmp_path / "logs"


def test_joints_names_give_a_map_and_missing_commands_are_said_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    folder = logs_of(tmp_path, rows(400)[:, [0, 3, 4]], "t,shoulder,elbow")
    code, out = check(capsys, folder, "--model", model_of(tmp_path))
    assert code == 2 and "qpos:shoulder" in out and "100 Hz" in out
    assert out.splitlines()[-1].startswith("missing: commands: ctrl:m_shoulder, ctrl:m_elbow")
    text = (folder / "map.yaml").read_text()
    assert "time: t" in text and "elbow: elbow" in text and "# ctrl: {m_shoulder: COLUMN, m_elbow: COLUMN}" in text
    before = text
    code, out = check(capsys, folder, "--model", model_of(tmp_path))
    assert code == 2 and "is written" not in out and (folder / "map.yaml").read_text() == before
    (folder / "map.yaml").unlink()
    with pytest.raises(Exception, match=r"`time: t`, `qpos: .*also missing, and needed: commands \(ctrl:m_shoulder"):
        read_logs(folder, MODEL, partial=True)


def test_units_that_are_taken_as_the_models_are_shown_and_a_refusal_is_no_missing_channel(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    names = "time,ctrl:m_shoulder,ctrl:m_elbow,qpos:shoulder,qpos:elbow"
    folder, model = logs_of(tmp_path, rows(400) * np.array([1, 1, 1, 300, 300]), names), model_of(tmp_path)
    code, out = check(capsys, folder, "--model", model)
    assert code == 2 and out.splitlines()[-1].startswith("refused: ") and "missing" not in out
    units = {row[1]: row[2] for row in (line.split() for line in out.splitlines()) if len(row) > 2}
    assert units["time"] == "s" and units["qpos:shoulder"] == "rad" and units["ctrl:m_elbow"] == "N", units
    (folder / "map.yaml").write_text("time: time\nqpos: {elbow: {column: qpos:elbow, scale: 0.01}}\n")
    _, out = check(capsys, folder, "--model", model)
    assert "scale 0.01" in out and "qpos:elbow   rad" not in out  # a column that is scaled has a unit of its own


def test_a_spreadsheet_becomes_a_log_by_the_map_that_is_proposed(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    table = moved() * np.array([1000, 1, 1, 180 / np.pi, 180 / np.pi])
    (tmp_path / "logs").mkdir()
    names = "t [ms];ShoulderTorqueCommand;elbow_cmd;shoulder pos [\u00b0];elbow_actual_deg;note"
    lines = [";".join(f"{x:.6f}".replace(".", ",") for x in row) + ";ok" for row in table]
    (tmp_path / "logs" / "run.txt").write_text("\n".join(["Recorder 3", names, *lines]), encoding="utf-8-sig")
    code, out = check(capsys, tmp_path / "logs", "--model", model_of(tmp_path))
    assert code == 0, out
    assert "unused: text" in out and "nothing is missing" in out and "unit" in out
    (log,) = read_logs(tmp_path / "logs", MODEL)
    np.testing.assert_allclose(log.time, moved()[:, 0], atol=1e-9)
    np.testing.assert_allclose(np.c_[log.ctrl, log.qpos], moved()[:, 1:], atol=1e-6)


def test_logs_of_the_librarys_own_form_need_no_map(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = logs_of(tmp_path, np.delete(moved(8.0), range(390, 410), axis=0), HEADER)
    before = read_some(folder)
    code, out = check(capsys, folder, "--model", model_of(tmp_path))
    assert code == 0 and "1, longest 0.21 s" in out and "cut into 2" in out
    assert (folder / "map.yaml").is_file() and read_some(folder) == before


def read_some(folder: Path) -> list[float]:
    with pytest.warns(UserWarning, match="gap"):
        return [float(log.qpos.sum()) for log in read_logs(folder, MODEL)]


def test_a_folder_that_is_read_only_gets_no_map(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = logs_of(tmp_path, rows(400)[:, [0, 3, 4]], "t,shoulder,elbow")
    folder.chmod(0o555)
    try:
        _, out = check(capsys, folder, "--model", model_of(tmp_path))
    finally:
        folder.chmod(0o755)
    assert "cannot be written" in out and "time: t" in out and not (folder / "map.yaml").exists()


def test_what_cannot_be_checked_says_the_way_on(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert "no such file" in error(capsys, "check", tmp_path / "nowhere")
    assert "no log; it holds nothing" in error(capsys, "check", tmp_path)
    (tmp_path / "run.mcap").touch()
    assert "logs from-mcap" in error(capsys, "check", tmp_path)
    folder = logs_of(tmp_path, rows(400), "t,ua,ub,qa,qb")
    code, out = check(capsys, folder)
    assert code == 2 and "missing: --model FILE" in out and "100 Hz" in out
    (folder / "map.yaml").unlink()
    code, out = check(capsys, folder, "--model", model_of(tmp_path))
    assert code == 2 and "ctrl:m_shoulder" in out and "positions: qpos:shoulder, qpos:elbow" in out


@pytest.mark.parametrize(
    ("column", "channel"),
    [
        ("shoulder", ("qpos", "shoulder")),
        ("elbow.pos", ("qpos", "elbow")),
        ("dq_elbow", ("qvel", "elbow")),
        ("ElbowVelocity", ("qvel", "elbow")),
        ("target_elbow", ("ctrl", "m_elbow")),
        ("m_elbow", ("ctrl", "m_elbow")),
        ("m_elbow.current_mA", ("streams", "effort:m_elbow")),
        ("elbow_torque", ("streams", "effort:m_elbow")),
        ("wrist", None),
        ("elbows", None),
    ],
)
def test_names_of_columns_suggest_channels(column: str, channel: tuple[str, str] | None) -> None:
    found = propose([column], MODEL).blocks()
    assert [(kind, name) for kind, block in found.items() for name in block] == ([channel] if channel else [])


def test_two_columns_for_one_channel_are_asked_about() -> None:
    found = propose(["time", "elbow_pos", "elbow_position", "stamp"], MODEL)
    assert not found.qpos and any("elbow_pos or elbow_position" in question for question in found.questions)
    assert any("time or stamp" in question for question in found.questions)


def test_words_of_a_name_come_without_its_unit() -> None:
    assert parts("shoulderPos_deg") == ("shoulder", "pos")
    assert parts("angle A [\u00b0]") == ("angle", "a")
    assert parts("leg2HipPos") == ("leg", "2", "hip", "pos")


def test_stamps_in_two_columns_and_names_in_columns_of_their_own_are_understood(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """Of `rostopic echo -p`: a stamp of sec and nsec, and `field.name0` beside `field.position0`."""
    names = "field.name0,field.name1,field.position0,field.position1"
    head = f"header.stamp.secs,header.stamp.nsecs,{names},Soll shoulder,u_elbow"
    lines = [
        f"{1772619302 + i // 100},{i % 100 * 10**7},elbow,shoulder,{r[4]:.6f},{r[3]:.6f},{r[1]:.6f},{r[2]:.6f}"
        for i, r in enumerate(moved())
    ]
    folder = tmp_path / "logs"
    folder.mkdir()
    (folder / "run.csv").write_text("\n".join([head, *lines]))
    code, out = check(capsys, folder, "--model", model_of(tmp_path))
    assert code == 0, out
    (log,) = read_logs(folder, MODEL)
    np.testing.assert_allclose(np.c_[log.time - log.time[0], log.ctrl, log.qpos], moved(), atol=1e-6)
    (folder / "map.yaml").unlink()
    lines[7] = lines[7].replace("elbow,shoulder", "shoulder,elbow")  # another publisher
    (folder / "run.csv").write_text("\n".join([head, *lines]))
    code, out = check(capsys, folder, "--model", model_of(tmp_path))
    assert code == 2 and "positions: qpos:shoulder, qpos:elbow" in out


def test_commands_that_fit_the_other_joint_are_noted(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    t = 0.01 * np.arange(200)
    q = np.stack([0.5 * np.sin(3 * t), 0.3 * np.sin(5 * t + 1)], 1)
    table = np.c_[t, q[:, ::-1], q]
    _, out = check(capsys, logs_of(tmp_path, table, HEADER), "--model", model_of(tmp_path))
    assert "the commands m_shoulder, m_elbow fit the motion far better as those of m_elbow, m_shoulder" in out, out
    _, out = check(capsys, logs_of(tmp_path, np.c_[t, q, q], HEADER), "--model", model_of(tmp_path))
    assert "far better" not in out


def moved(seconds: float = 4.0) -> np.ndarray:
    """[T, 5]: time, two torques, two angles of the arm that they drive."""
    data, table = mujoco.MjData(MODEL), []
    for k in range(int(100 * seconds)):
        t = 0.01 * k
        data.ctrl[:] = np.sin(4 * t) - 0.3 * data.qvel[0], 0.4 * np.sin(6 * t) - 0.1 * data.qvel[1]
        table.append([t, *data.ctrl, *data.qpos])
        mujoco.mj_step(MODEL, data, 2)
    return np.array(table)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ([1, 1, 1, 1, 1], ""),
        ([1, -1, -1, 1, 1], "the opposite sign would"),
        ([1, 1, 1, 1, -1], "the opposite sign of the position of elbow would"),
        ([1, 1, 1, 40, 1], "unexplained by any model"),
    ],
    ids=["right", "mirrored", "encoder", "unit"],
)
def test_what_a_diagnosis_refuses_by_the_model_is_refused_here(
    tmp_path: Path, capsys: pytest.CaptureFixture, change: list[float], said: str
) -> None:
    folder = logs_of(tmp_path, moved() * np.array(change), HEADER)
    code, out = check(capsys, folder, "--model", model_of(tmp_path))
    assert code == (2 if said else 0), out
    assert ("nothing is missing" in out) is not bool(said)
    assert not said or ("refused: run.csv: effort unrelated" in out and said in out), out


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0.4, "the longest log has 0.39 s; diagnose needs windows of 0.5 s"),
        (2.4, "the logs hold 4 windows of 0.5 s; diagnose needs 6, or 3 s of motion"),
        (3.2, ""),
    ],
)
def test_logs_that_hold_too_few_windows_for_a_diagnosis_are_refused_with_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture, seconds: float, said: str
) -> None:
    code, out = check(capsys, logs_of(tmp_path, moved(seconds), HEADER), "--model", model_of(tmp_path))
    assert code == (2 if said else 0) and ("nothing is missing" in out) is not bool(said), out
    assert not said or out.splitlines()[-1].startswith(f"refused: {said}"), out


def test_what_a_map_names_in_vain_is_said_as_a_diagnosis_says_it(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A column that the file lacks, and an actuator that the model lacks; no channel is missing in the map."""
    folder, model = logs_of(tmp_path, moved(), "t,ua,ub,qa,qb"), model_of(tmp_path)
    text = "time: t\nctrl: {m_shoulder: ua, m_elbow: uc}\nqpos: {shoulder: qa, elbow: qb}\n"
    (folder / "map.yaml").write_text(text)
    code, out = check(capsys, folder, "--model", model)
    assert code == 2 and "no column 'uc' (" in out and "ctrl.m_elbow" in out and "missing: " not in out, out
    (folder / "map.yaml").write_text(text.replace("uc", "ub").replace("m_elbow", "m_ellbow"))
    code, out = check(capsys, folder, "--model", model)
    assert code == 2 and "ctrl.m_ellbow is no channel of the model; did you mean 'm_elbow'?" in out, out
    assert "missing: " not in out


def test_a_stray_file_is_named_beside_the_others_columns(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = logs_of(tmp_path, moved(), HEADER)
    (folder / "a.csv").write_text("hello\nthis is a note\n")
    (folder / "map.yaml").write_text("files: '*.csv'\ntime: time\nctrl: {m_shoulder: ctrl:m_shoulder}\n")
    code, out = check(capsys, folder, "--model", model_of(tmp_path))
    assert (
        code == 2
        and "\nrun.csv:\n" in out
        and "\na.csv:\n" in out
        and "qpos:elbow" in out
        and "a.csv: no column" in out
    ), out


def test_the_mend_of_degrees_names_the_files_column(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = logs_of(tmp_path, rows(400) * np.array([1, 1, 1, 1, 300]), "t,ua,ub,qa,qb")
    (folder / "map.yaml").write_text("time: t\nctrl: {m_shoulder: ua, m_elbow: ub}\nqpos: {shoulder: qa, elbow: qb}\n")
    code, out = check(capsys, folder, "--model", model_of(tmp_path))
    assert code == 2 and "elbow: {column: 'qb', unit: deg}" in out, out


def test_a_log_that_a_diagnosis_leaves_out_is_the_last_word(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    logs_of(tmp_path, moved(), HEADER)
    folder = logs_of(tmp_path, moved() * np.array([1, -1, -1, 1, 1]), HEADER, "wrong.csv")
    code, out = check(capsys, folder, "--model", model_of(tmp_path))
    assert code == 2 and "refused: wrong.csv: effort unrelated" in out and "nothing is missing" not in out
    assert out.splitlines()[-1].startswith("1 of 2 logs refused: wrong.csv;")


def test_a_log_that_is_doubted_is_not_passed_without_a_word(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The gate takes it, and so does the check; its last line sends the reader to the map."""
    monkeypatch.setattr(gate.Gate, "doubts", ("are the columns swapped?",))
    code, out = check(capsys, logs_of(tmp_path, moved(), HEADER), "--model", model_of(tmp_path))
    last = out.splitlines()[-1]
    assert code == 0 and "note: are the columns swapped?" in out
    assert last.startswith("no channel is missing; check the map against 1 note above, then: bayessim-mjx diagnose"), (
        last
    )
