"""The benchmark's run command with a worker that only pretends: cores, finished cases, interruptions."""

import argparse
import json
from pathlib import Path

import blind as command
import pytest

WORKER = """import json, sys
from pathlib import Path
case, out = Path(sys.argv[1]), Path(sys.argv[3])
(out / "arguments.json").write_text(json.dumps(sys.argv))
if (case / "stopped").exists():
    sys.exit(130)
if (case / "broken").exists():
    sys.exit(1)
(out / "exit.json").write_text('{"code": 0, "seconds": 1.0}')
if "--baselines" in sys.argv:
    (out / "baselines.json").write_text("{}")
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    worker = tmp_path / "worker.py"
    worker.write_text(WORKER)
    monkeypatch.setattr(command, "WORKER", worker)
    for name, kind in (("one", "single"), ("two", "null")):
        effects = [{"name": "cogging"}] if kind == "single" else []
        (tmp_path / "cases" / name).mkdir(parents=True)
        (tmp_path / "cases" / name / "truth.json").write_text(json.dumps({"kind": kind, "effects": effects}))
    return tmp_path / "cases"


def run(folder: Path, **more) -> None:
    given = {"leave_out_family": False, "baselines": False, "verdict_only": False, "workers": 2, "timeout": 60.0}
    given |= {"more": [], "cluster": ""}
    command.diagnose(argparse.Namespace(cases=folder, **(given | more)))


def told(folder: Path, where: str = "diagnosis") -> list[str]:
    return json.loads((folder / where / "arguments.json").read_text())


def test_finished_cases_stay_and_unfinished_ones_are_run(folder, capsys):
    run(folder)
    (folder / "two" / "diagnosis" / "exit.json").unlink()
    run(folder)
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["1/2", "2/2", "1/1"]


def test_baselines_that_are_missing_are_asked_for_again(folder):
    run(folder)
    assert "--baselines" not in told(folder / "one")
    run(folder, baselines=True)
    assert "--baselines" in told(folder / "one") and (folder / "two" / "diagnosis" / "baselines.json").exists()


def test_what_was_stopped_is_run_again_and_what_died_counts_as_run(folder, capsys):
    (folder / "one" / "stopped").touch()
    (folder / "two" / "broken").touch()
    run(folder)
    assert not (folder / "one" / "diagnosis" / "exit.json").exists()
    assert json.loads((folder / "two" / "diagnosis" / "exit.json").read_text())["code"] == 1
    capsys.readouterr()
    run(folder)
    assert capsys.readouterr().out.startswith("1/1 one: exit 130, no result")


def test_the_family_of_singles_only_is_left_out_of_the_library(folder):
    run(folder, leave_out_family=True, more=["--group", "payload"])
    arguments = told(folder / "one", "left_out")
    assert arguments[arguments.index("--more") + 1 : -2] == ["--group", "payload"]
    library = arguments[-1].split(",")
    assert arguments[-2] == "--effects" and "cogging" not in library and len(library) == 23
    assert not (folder / "two" / "left_out").exists()


def test_pictures_can_be_left_out(folder):
    run(folder, verdict_only=True)
    assert "--verdict-only" in told(folder / "one")


def test_systems_and_kinds_take_turns(tmp_path):
    for name in ("arm_single_s10", "arm_single_s9", "cart_null_s9", "leg_null_s100"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "truth.json").write_text("{}")
    names = [folder.name for folder in command.cases(tmp_path)]
    assert names == ["arm_single_s9", "cart_null_s9", "arm_single_s10", "leg_null_s100"]
