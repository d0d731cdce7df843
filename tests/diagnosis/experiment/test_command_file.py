"""python -m bayessim_mjx.diagnose: exit code 2 and one clear line for unusable input, the promised files otherwise."""

import json

import pytest

from bayessim_mjx import diagnose
from bayessim_mjx.diagnosis import result
from tests.diagnosis.pendulums import nominal, recorded, saved

FILES = ("diagnosis.json", "report.html", "effects.yaml", "model_with_effects.xml")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("command")
    nominal(folder)
    saved(folder / "logs", recorded(friction=0.05, count=6, seconds=3.0))
    return folder


def refused(capsys, *argv) -> str:
    """The one line on stderr of a command that ends with 2."""
    capsys.readouterr()
    code = diagnose.main([*map(str, argv), "--headless", "--device", "cpu", "--cache_dir", "off"])
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert code == 2 and len(lines) == 1
    return lines[0]


def changed(place, tmp_path, old: str, new: str, line: int | None = None):
    """A copy of one log with a text replaced."""
    rows = (place / "logs" / "log0.csv").read_text().splitlines()
    rows = [r.replace(old, new) if line in (None, i) else r for i, r in enumerate(rows)]
    path = tmp_path / "changed.csv"
    path.write_text("\n".join(rows) + "\n")
    return path


def test_arguments(place, capsys, tmp_path):
    model, data = place / "pendulum.xml", place / "logs"
    assert "--data" in refused(capsys, "--model", model)
    assert "--task" in (text := refused(capsys, "--data", data)) and "--model" in text
    assert (
        "--task" in (text := refused(capsys, "--task", "Pendulum", "--model", model, "--data", data))
        and "--model" in text
    )
    assert "no_model.xml" in refused(capsys, "--model", tmp_path / "no_model.xml", "--data", data)
    assert "nowhere" in refused(capsys, "--model", model, "--data", tmp_path / "nowhere")
    (tmp_path / "file").write_text("")
    assert "--out" in refused(capsys, "--model", model, "--data", data, "--out", tmp_path / "file")
    assert "--sed" in refused(capsys, "--model", model, "--data", data, "--sed", "3")


def test_unusable_logs(place, capsys, tmp_path):
    model, out = place / "pendulum.xml", tmp_path / "out"

    def text(path):
        return refused(capsys, "--model", model, "--data", path, "--out", out)

    assert "elbow" in (line := text(changed(place, tmp_path, "qpos:hinge", "qpos:elbow"))) and "hinge" in line
    assert "gripper" in (line := text(changed(place, tmp_path, "ctrl:motor", "ctrl:gripper"))) and "motor" in line
    rows = (place / "logs" / "log0.csv").read_text().splitlines()
    path = changed(place, tmp_path, rows[20].split(",")[2], "nan", line=20)
    assert "changed.csv" in (line := text(path)) and "nan" in line.lower()
    assert not (out / "diagnosis.json").exists()


def test_models_that_cannot_be_used(place, capsys, tmp_path):
    path = tmp_path / "model.xml"
    for body, word in (
        ("<mujoco><worldbody", "cannot load"),
        ("<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>", "no actuator"),
        ("<mujoco><worldbody><body><geom size='.1'/></body></worldbody></mujoco>", "no joint"),
    ):
        path.write_text(body)
        assert word in refused(capsys, "--model", path, "--data", place / "logs")


@pytest.mark.slow
def test_effects_that_are_not_there(place, capsys, tmp_path):
    base = ("--model", place / "pendulum.xml", "--data", place / "logs", "--out", tmp_path)
    line = refused(capsys, *base, "--effects", "coulomb_fricton")
    assert "coulomb_fricton" in line and "coulomb_friction" in line
    assert "mine.py" in refused(capsys, *base, "--effects", "mine.py:Mine")
    assert "speed" in refused(capsys, *base, "--effects", "coulomb_friction", "--group", "speed")
    assert "elbow" in (line := refused(capsys, *base, "--tolerance", "elbow=1deg")) and "hinge" in line
    assert "not in mm" in refused(capsys, *base, "--tolerance", "hinge=2mm")


def test_too_little_data_is_a_verdict(place, capsys, tmp_path):
    rows = (place / "logs" / "log0.csv").read_text().splitlines()
    (tmp_path / "short.csv").write_text("\n".join(rows[:80]) + "\n")
    argv = ["--model", place / "pendulum.xml", "--data", tmp_path / "short.csv", "--out", tmp_path / "out"]
    argv += ["--effects", "coulomb_friction", "--headless", "--cache_dir", "off"]
    assert diagnose.main([str(a) for a in argv]) == 0
    assert result.load(tmp_path / "out").verdict == "insufficient_data"
    assert (tmp_path / "out" / "report.html").stat().st_size > 0


@pytest.mark.slow
def test_a_diagnosis_leaves_its_files(place, capsys, tmp_path):
    argv = ["--model", place / "pendulum.xml", "--data", place / "logs", "--out", tmp_path / "out"]
    argv += ["--effects", "coulomb_friction,actuator_delay", "--headless", "--device", "cpu", "--cache_dir", "off"]
    assert diagnose.main([str(a) for a in argv]) == 0
    for name in FILES:
        assert (tmp_path / "out" / name).stat().st_size > 0, name
    raw = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert raw["verdict"] == "effects"
    assert [(e["name"], e["where"]) for e in raw["effects"]] == [("coulomb_friction", "hinge")]
    assert "coulomb_friction" in (tmp_path / "out" / "effects.yaml").read_text()
    assert "frictionloss" in (tmp_path / "out" / "model_with_effects.xml").read_text()
    page = (tmp_path / "out" / "report.html").read_text()
    assert "coulomb" in page.lower() and 'src="http' not in page
    assert "report.html" in capsys.readouterr().out
