"""A folder belongs to the check whose cases lie in it; a start that failed leaves no claim to it."""

from pathlib import Path

import pytest

from bayessim_mjx.blind.check import Check
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
