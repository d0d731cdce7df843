"""A folder belongs to the check whose cases lie in it; a start that failed leaves no claim to it."""

from pathlib import Path

import pytest

from bayessim_mjx.blind.check import Check
from bayessim_mjx.blind.runner import Limits, estimate
from bayessim_mjx.errors import UserError


def test_a_check_without_a_case_gives_way(tmp_path: Path) -> None:
    Check(str(tmp_path), model="robot.xml", data=("mistyped",)).begin()
    Check(str(tmp_path), model="robot.xml", data=("logs",)).begin()
    assert '"logs"' in (tmp_path / "check.json").read_text()


def test_another_check_is_refused_in_words_of_its_flags(tmp_path: Path) -> None:
    first = Check(str(tmp_path), model="robot.xml", data=("logs", "more"), effects=("backlash", "joint_spring"))
    first.begin()
    (tmp_path / "cases").mkdir()
    first.begin()
    with pytest.raises(UserError, match=r"check with --data logs more \(now --data logs\), --effects .*\(now no --eff"):
        Check(str(tmp_path), model="robot.xml", data=("logs",)).begin()


def test_the_time_of_all_cases_is_said_before_the_start(tmp_path: Path) -> None:
    check = Check(str(tmp_path), model="robot.xml")
    assert estimate(check, Limits(100, workers=2)).startswith(
        "100 cases x 32 s / 2 workers: about 26 min 40 s (recorded"
    )
    assert estimate(check, Limits(100, workers=None, cluster="tcp://head:8786")) == "100 cases to do"
    assert estimate(Check(str(tmp_path), command="mine {out}"), Limits(4, 300.0)).startswith("4 cases to do; --minutes")
    for index, seconds in enumerate((50, 60, 100)):
        check.answer(index).mkdir(parents=True)
        (check.answer(index) / "exit.json").write_text(f'{{"seconds": {seconds}}}')
    assert "97 cases x 1 min 00 s / 1 worker: about 1 h 37 min (as the fin" in estimate(check, Limits(100, workers=1))
