"""A seal that is broken is noticed, whatever of the case was changed."""

import json

import pytest

from bayessim_mjx.blind import seal
from bayessim_mjx.errors import UserError


@pytest.fixture
def case(tmp_path):
    given, secret = tmp_path / "given", tmp_path / "sealed" / "0.json"
    (given / "logs").mkdir(parents=True)
    (given / "logs" / "a.csv").write_text("time\n0\n")
    code = seal.close({"effect": "backlash", "salt": "1"}, given, secret)
    return given, secret, {"seal.txt": code, "exit.json": code}


def test_an_unbroken_seal_opens(case):
    assert seal.opened(*case)["effect"] == "backlash"


def test_another_truth_is_noticed(case):
    given, secret, seals = case
    told = json.loads(secret.read_text())
    secret.write_text(json.dumps(told | {"effect": "cogging"}))
    with pytest.raises(UserError, match="not the truth"):
        seal.opened(given, secret, seals)


def test_another_seal_is_noticed_where_the_other_one_stays(case):
    given, secret, seals = case
    with pytest.raises(UserError, match=r"exit\.json"):
        seal.opened(given, secret, seals | {"exit.json": "0" * 64})


@pytest.mark.parametrize("change", ["edit", "add", "remove"])
def test_other_logs_are_noticed(case, change):
    given, secret, seals = case
    file = given / "logs" / ("a.csv" if change != "add" else "b.csv")
    file.unlink() if change == "remove" else file.write_text("time\n1\n")
    with pytest.raises(UserError, match="not the files"):
        seal.opened(given, secret, seals)


def test_a_seal_tells_nothing_of_a_truth_with_another_salt(case, tmp_path):
    again = seal.close({"effect": "backlash", "salt": "2"}, case[0], tmp_path / "other.json")
    assert again != case[2]["seal.txt"]
