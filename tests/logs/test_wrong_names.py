"""Columns under each other's names, and columns under a name of their own: what is said, and the map that mends it."""

import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from bayessim_mjx import import_logs
from bayessim_mjx.diagnosis.logcheck import gate
from bayessim_mjx.logs import read_logs
from tests.logs.log_files import ARM, HEADER, write

SERVOS = ARM.replace("<motor", '<position kp="60" kv="4"').replace('ctrllimited="true" ctrlrange="-2 2"', "")
SERVOS = SERVOS.replace('timestep="0.005"', 'timestep="0.005" integrator="implicitfast"')
MODEL = mujoco.MjModel.from_xml_string(SERVOS)
EXCHANGED = "time,ctrl:m_shoulder,ctrl:m_elbow,qpos:elbow,qpos:shoulder"
SAID = "the commands m_shoulder, m_elbow fit the motion far better as those of m_elbow, m_shoulder (they explain 9"


def targets(seed: int = 0) -> np.ndarray:
    """[T, 5]: time, two targets, two angles of servos that follow them."""
    rng, data, table = np.random.default_rng(seed), mujoco.MjData(MODEL), []
    phase = rng.uniform(0, 6, 2)
    for k in range(500):
        data.ctrl[:] = 0.5 * np.sin(2.1 * 0.01 * k + phase[0]), 0.7 * np.sin(3.7 * 0.01 * k + phase[1])
        table.append([0.01 * k, *data.ctrl, *(data.qpos + 1e-4 * rng.normal(size=2))])
        mujoco.mj_step(MODEL, data, 2)
    return np.array(table)


@pytest.fixture
def place(tmp_path: Path) -> Path:
    (tmp_path / "logs").mkdir()
    (tmp_path / "arm.xml").write_text(SERVOS)
    return tmp_path


def check(place: Path, capsys: pytest.CaptureFixture) -> list[str]:
    assert import_logs.main(["check", str(place / "logs"), "--model", str(place / "arm.xml")]) == 0
    return capsys.readouterr().out.splitlines()


def logs(place: Path, header: str) -> None:
    for i in range(3):
        write(place / "logs", targets(i), header, f"run{i}.csv")


def read(place: Path) -> list:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return list(read_logs(place / "logs", MODEL, place / "logs" / "map.yaml", partial=True))


def test_a_check_of_logs_and_a_diagnosis_say_the_same_of_exchanged_servos(place, capsys):
    """Once for all logs, and the last words are lines of a map that mend it."""
    logs(place, EXCHANGED)
    out = check(place, capsys)
    said = [line for line in out if SAID in line]
    assert len(said) == 1 and said[0].startswith("note: run0.csv, run1.csv and run2.csv: "), out
    assert not any("nothing is missing" in line or "diagnose" in line for line in out)
    found = gate.check(read(place), MODEL, 0.01)
    assert f"note: {found.doubts[-1]}" == said[0] and found.doubts[-1] in found.warnings and len(found.usable) == 3
    start = next(i for i, line in enumerate(out) if line.startswith("if the positions are exchanged"))
    assert len(out) == start + 3
    with (place / "logs" / "map.yaml").open("a") as file:
        file.write("".join(f"{line.strip()}\n" for line in out[start + 1 :]))
    assert check(place, capsys)[-1].startswith("nothing is missing; next: bayessim-mjx diagnose")
    np.testing.assert_allclose(read(place)[0].qpos, targets(0)[:, 3:], atol=1e-9)


def test_the_page_of_logs_says_it_too(place, capsys):
    logs(place, EXCHANGED)
    argv = [str(place / "logs"), "--model", str(place / "arm.xml"), "--out", str(place / "show.html")]
    assert import_logs.main(["show", *argv]) == 0
    assert SAID in capsys.readouterr().out


def test_the_commands_may_be_the_wrong_ones(place, capsys):
    """Lines for both: the logs alone do not say which of the two columns is wrong."""
    logs(place, EXCHANGED)
    out = check(place, capsys)
    start = out.index(f"if the commands are exchanged, these lines in {place / 'logs' / 'map.yaml'} mend it:")
    own = yaml.safe_load("\n".join(out[start + 1 : start + 3]))
    assert own["ctrl"] == {"m_shoulder": "ctrl:m_elbow", "m_elbow": "ctrl:m_shoulder"}
    assert own["qpos"] == {"shoulder": "qpos:shoulder", "elbow": "qpos:elbow"}


def test_straight_columns_are_passed(place, capsys):
    logs(place, HEADER)
    assert check(place, capsys)[-1].startswith("nothing is missing; next: bayessim-mjx diagnose")
    found = gate.check(read(place), MODEL, 0.01)
    assert not found.exchanged and not any("swapped" in text for text in found.warnings)


def test_a_position_under_another_name_is_proposed_and_named_last(place, capsys):
    logs(place, HEADER.replace("qpos:shoulder", "position:shoulder"))
    out = check(place, capsys)
    assert out[-1].startswith("not measured: qpos:shoulder; next, without it: bayessim-mjx diagnose"), out[-1]
    assert not any("nothing is missing" in line for line in out)
    start = next(i for i, line in enumerate(out) if line.startswith("if position:shoulder is qpos:shoulder, these"))
    with (place / "logs" / "map.yaml").open("a") as file:
        file.write("".join(f"{line.strip()}\n" for line in out[start + 1 : -1]))
    assert check(place, capsys)[-1].startswith("nothing is missing; next:")
    assert not read(place)[0].absent


def test_of_a_position_that_no_column_suggests_only_its_name_is_said(place, capsys):
    logs(place, HEADER.replace("qpos:shoulder", "voltage"))
    out = check(place, capsys)
    assert out[-1].startswith("not measured: qpos:shoulder; next, without it: ") and not any("if v" in x for x in out)
