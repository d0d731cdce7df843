"""The command from flags to files, with a diagnosis that only pretends."""

import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from bayessim_mjx import blind_check
from bayessim_mjx.blind import show, worker
from bayessim_mjx.blind.check import Check, loader
from tests.blind.recorded import pendulum

ENTRY = Path(__file__).with_name("entry.py")


def call(*words: object) -> int:
    return blind_check.main([str(w) for w in (*words, "--headless")])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "give one of --task NAME and --model FILE"),
        (("--model", "none.xml"), "none.xml: no such file"),
        (("--model", "m.xml", "--command", "mine {data}"), "has to hold {out}"),
        (("--model", "m.xml", "--command", "mine {out}", "--more", "--quick"), "--more"),
        (
            ("--model", "m.xml", "--command", "mine '{out}"),
            "No closing quotation; allowed: words as a shell takes them",
        ),
        (("--model", "m.xml", "--effects", "backslash"), "backlash"),
        (("--model", "m.xml", "--accuracy", "5"), "allowed: per cent"),
        (("--model", "m.xml", "--minutes", "-1"), "allowed: minutes"),
        (("--model", "m.xml", "--cases", "0"), "must be from 1"),
        (("--model", "m.xml", "--cluster", "mine:1"), "--cluster: 'mine:1': allowed: tcp://HOST:PORT"),
        (("--model", "m.xml", "--cluster", "tcp://host"), "allowed: tcp://HOST:PORT"),
        (("--model", "m.xml", "--cluster", "tcp://host:70000"), "allowed: tcp://HOST:PORT"),
        (("--model", "m.xml", "--cluster", "slurm:no.yaml"), "there is no file no.yaml"),
        (("--task", "Pendulum", "--drive", "torque"), "--drive and --packages are for --model FILE"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # --headless first: --more takes the rest
    assert blind_check.main(["--headless", *words]) == 2
    assert said in capsys.readouterr().err


def test_a_urdf_has_the_drive_that_the_diagnosis_of_its_cases_gets(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shape = '<collision><geometry><mesh filename="package://mine/a.obj"/></geometry></collision>'
    inertial = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    Path("r.urdf").write_text(
        f'<robot name="r"><link name="base"/><link name="arm">{inertial}{shape}</link><joint name="elbow" '
        'type="revolute"><parent link="base"/><child link="arm"/><limit lower="-1" upper="1" effort="5"/></joint>'
        "</robot>"
    )
    Path("meshes").mkdir()
    Path("meshes/a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    Path("drives.yaml").write_text("elbow: position:40\n")
    check = Check("out", "r.urdf", drive="drives.yaml", packages=("mine=meshes",))
    model = loader(check)().compile()
    assert (model.actuator(0).name, model.actuator_gainprm[0, 0], model.nmesh) == ("elbow", 40, 1)
    words = worker.command(check.anywhere(), tmp_path / "logs", tmp_path / "out")
    assert words[words.index("--drive") + 1] == str(tmp_path / "drives.yaml")  # it runs in another folder
    assert words[words.index("--packages") + 1] == f"mine={tmp_path}/meshes"


def test_only_the_three_words_of_a_command_are_replaced(tmp_path):
    """Braces of another tool stay as they are."""
    check = SimpleNamespace(command="awk '{print $1}' {data} {out}/{x} {model}", model="", task="")
    words = worker.command(check, tmp_path / "logs", tmp_path / "out")
    assert words == ["awk", "{print $1}", f"{tmp_path}/logs", f"{tmp_path}/out/{{x}}", f"{tmp_path}/model.xml"]


def test_places_that_were_not_tried_are_told_by_effect():
    rows = [("backlash", "hip", 0), ("backlash", "knee", 1), ("backlash", "ankle", 0), ("gravity_tilt", "world", 0)]
    found = {"thresholds": [{"effect": e, "where": w, "tried": n} for e, w, n in rows]}
    assert show.untried(found) == ["backlash: hip, ankle", "gravity tilt"]


def run(folder: Path, out: Path, *more: object) -> int:
    entry = f"{sys.executable} {ENTRY} {out / 'sealed'} 8 {{data}} {{out}}"
    robot = ("--model", folder / "model.xml", "--data", folder / "logs", "--out", out)
    flags = ("--effects", "viscous_friction,actuator_bias", "--command", entry, "--no_sandbox")  # it reads the truths
    return call(*robot, *flags, *more)


def files(out: Path) -> dict[str, bytes]:
    """What is hidden and what was said; not how long it took."""
    found = [p for p in out.rglob("*") if p.is_file() and (p.suffix in (".csv", ".yaml") or p.name == "seal.txt")]
    found += list((out / "sealed").iterdir())
    return {str(p.relative_to(out)): p.read_bytes() for p in found}


@pytest.mark.slow
def test_a_check_is_a_function_of_its_seed_goes_on_and_notices_a_broken_seal(tmp_path, capsys):
    folder = pendulum(tmp_path / "robot")
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert run(folder, whole, "--cases", 18, "--workers", 2) == 0
    assert run(folder, parts, "--cases", 5, "--workers", 1) == 0
    shutil.rmtree(parts / "cases" / "0002" / "answer")  # killed while it was diagnosed
    (parts / "cases" / "0003" / "seal.txt").unlink()  # and while it was made
    shutil.rmtree(parts / "cases" / "0003" / "answer")
    assert run(folder, parts, "--cases", 18, "--workers", 1) == 0
    assert files(whole) == files(parts)
    found = json.loads((whole / "blind.json").read_text())
    rows = {r["effect"]: r for r in found["thresholds"]}
    assert found["cases"] == 18 and found["false_alarms"]["hits"] == 0 and found["coverage"]["hits"] > 0
    for effect in ("viscous_friction", "actuator_bias"):
        _, low, high = rows[effect]["strength"]
        assert low / 1.1 < 8 < high and rows[effect]["amount"][1] < rows[effect]["amount"][2]
    assert all((whole / name).exists() for name in ("blind.html", "media")) and list(whole.glob("events*"))

    secret = whole / "sealed" / "0001.json"
    secret.write_text(secret.read_text().replace("single", "null"))
    capsys.readouterr()
    assert run(folder, whole, "--cases", 18) == 2 and "0001.json" in capsys.readouterr().err
    assert run(folder, parts, "--cases", 18, "--seed", 1) == 2 and "seed" in capsys.readouterr().err
