"""A diagnosis is told what a blind check of the same logs would have missed."""

import json

import pytest

from bayessim_mjx.blind import answer
from bayessim_mjx.blind.recall import beside, recall
from bayessim_mjx.errors import UserError
from bayessim_mjx.report.page import render
from tests.report import fake

SAID = "backlash at elbow: half of the play under 3 mrad may be missed"


@pytest.fixture
def logs(tmp_path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "blind").mkdir()
    found = {"sentences": [SAID], "cases": 40, "settings": {"data": [str(tmp_path / "logs")], "command": ""}}
    (tmp_path / "blind" / "blind.json").write_text(json.dumps(found))
    return tmp_path / "logs"


def test_a_check_beside_the_same_logs_is_found_and_no_other(logs):
    missed = beside([str(logs)])
    assert missed is not None and missed.sentences == (SAID,) and missed.cases == 40
    (logs.parent / "others").mkdir()
    assert beside([str(logs.parent / "others")]) is None
    with pytest.raises(UserError, match=r"no blind\.json"):
        recall(logs)


def test_the_report_links_to_the_check_from_where_it_lies(logs, tmp_path):
    from bayessim_mjx.report import page

    (tmp_path / "my diagnosis").mkdir()
    link = 'href="../blind/blind.html"'
    assert link in page.write(fake.full(), tmp_path / "my diagnosis", recall(tmp_path / "blind")).read_text()
    assert 'href="../a%20b/blind.html"' in render(fake.full(), recall(tmp_path / "blind"), "../a b/blind.html")


def test_the_report_tells_what_would_have_been_missed(logs):
    page = render(fake.full(), recall(logs.parent / "blind"))
    assert SAID in page and "40 blind cases" in page and "What would have been missed" in page
    assert "What would have been missed" not in render(fake.full())


def row(**changes):
    told = {
        "effect": "backlash",
        "where": "elbow",
        "told": "0.17 deg",
        "interval": "0.1 deg to 0.3 deg",
        "beyond": False,
    }
    return told | changes


def test_a_sentence_says_what_would_not_have_been_seen():
    assert answer.sentence(row()) == (
        "backlash at elbow under 0.17 deg (half of the play) would not have been seen reliably: it is found 9 times of "
        "10 from there on (90 % interval 0.1 deg to 0.3 deg)"
    )
    limit = row(effect="rate_limit", told="< 29/s", beyond=True)
    assert answer.sentence(limit) == (
        "rate limit at elbow: even 29/s (limit), the strongest that was tried, was not seen"
    )
