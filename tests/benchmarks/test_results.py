"""results.md is what its records give, its pages keep to their words, and what cites a record finds it."""

import json
import re
import sys
from pathlib import Path

import pytest
import results

ROOT = Path(__file__).resolve().parents[2]
BENCHMARKS = ROOT / "benchmarks"
WORDS = {"results.md": 2000, "history.md": 1500, "how-to-run.md": 1200}
SECTION = 120  # words of a section's text
CITING = ("*.py", "*.md", "*.yaml", "*.yml")  # files that may cite a record
RECORD = re.compile(r"records/(\w+\.json)")


def test_the_page_is_what_the_records_give():
    assert (BENCHMARKS / "results.md").read_text(encoding="utf-8") == results.page(results.records())


@pytest.mark.parametrize("name", WORDS)
def test_pages_keep_to_their_words(name):
    assert len((BENCHMARKS / name).read_text(encoding="utf-8").split()) <= WORDS[name]
    assert [title for title, text in results.SECTIONS.items() if len(text.split()) > SECTION] == []


def test_records_have_their_fields_and_no_claim_stands_twice():
    assert results.faults(results.records()) == []


def test_scripts_that_commands_name_are_there():
    texts = {path.name: path.read_text(encoding="utf-8") for path in (BENCHMARKS / "records").glob("*.json")}
    named = {(name, script) for name, text in texts.items() for script in re.findall(r"benchmarks/[\w/]+\.py", text)}
    assert {(name, script) for name, script in named if not (ROOT / script).is_file()} == set()


def test_records_that_are_cited_are_there():
    folders = ("bayessim_mjx", "benchmarks", "cfg", "docs", "examples", "tasks")
    files = [path for folder in folders for glob in CITING for path in (ROOT / folder).rglob(glob)]
    cited = {(path.name, name) for path in files for name in RECORD.findall(path.read_text(encoding="utf-8"))}
    assert {(by, name) for by, name in cited if not (BENCHMARKS / "records" / name).is_file()} == set()
    assert cited  # of the page at least


def record(**changes):
    row = {"id": "a", "claim": "a claim", "goal": "1", "value": "2", "met": "yes", "interval": "", "n": "{one[hits]}"}
    row |= {"commit": "abc", "shown": "headline", "rank": 1} | changes
    fields = {"section": "Seconds and tests", "command": "x", "machine": "y", "rows": [row]}
    return fields | {"columns": ["", "hits"], "table": [["one", "3/4"]]}


def read(tmp_path, **named):
    for name, content in named.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    return results.records(tmp_path)


def test_a_row_has_the_cells_that_it_names_and_says_where_a_goal_is_missed(tmp_path):
    found = read(tmp_path, first=record(), second=record(claim="b", met="no", rank=0))
    first, second = ["a claim", "1", "**2**", "", "3/4"], ["b", "1", "2, **no**", "", "3/4"]
    assert results.headline(found) == [[*second, "[abc](records/second.json)"], [*first, "[abc](records/first.json)"]]
    assert results.faults(found) == []


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"goal": None}, "first.a: no goal"),
        ({"met": "nearly"}, "first.a: met or shown"),
        ({"claim": "other"}, "second.a: 'other' twice, see first.a"),
    ],
)
def test_faults_of_a_record_are_found(tmp_path, changes, fault):
    assert fault in results.faults(read(tmp_path, first=record(**changes), second=record(claim="other")))


def test_a_table_of_the_page_has_twelve_rows_at_most(tmp_path):
    many = {f"r{k}": record(claim=f"claim {k}", rank=k) for k in range(13)}
    assert "headline: 13 rows" in results.faults(read(tmp_path, **many))


def test_check_fails_where_the_page_differs(tmp_path, monkeypatch):
    (tmp_path / "records").mkdir()
    read(tmp_path / "records", first=record())
    found = results.records(tmp_path / "records")
    monkeypatch.setattr(results, "HERE", tmp_path)
    monkeypatch.setattr(results, "records", lambda: found)
    monkeypatch.setattr(sys, "argv", ["results.py", "--check"])
    (tmp_path / "results.md").write_text("other")
    assert results.main() == 1
    (tmp_path / "results.md").write_text(results.page(found))
    assert results.main() == 0
