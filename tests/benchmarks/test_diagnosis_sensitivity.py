"""Numbers are replaced before anything imports them, and what changes is counted over the cases that have ended."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import sensitivity

FOLDER = Path(__file__).parents[2] / "benchmarks" / "diagnosis"


@pytest.mark.parametrize(
    ("value", "factor", "new"),
    [(3e-4, 0.5, 1.5e-4), (5, 0.5, 2), (1, 0.5, 1), ((6, 4, 2), 2.0, (12, 8, 4)), (0.98, 0.5, 0.99), (1.3, 2.0, 1.6),
     ((1.0, 0.1), 0.5, (1.0, 0.05)), (1.0, 2.0, 2.0)],
)  # fmt: skip
def test_halved_and_doubled(value, factor, new):
    assert sensitivity.changed(value, factor) == pytest.approx(new)


def test_a_planted_number_is_in_everything_that_is_derived_from_it():
    """The median of the missing force is the root of its least amplitude; words read the new limit of noise."""
    code = (
        "import sys; sys.path[:0] = [sys.argv[1]]; import sensitivity\n"
        "sensitivity.plant('Priors.least', 1e-6); sensitivity.plant('statistics:AT_NOISE', 7.0)\n"
        "from bayessim_mjx.diagnosis.evidence import gaussian\n"
        "from bayessim_mjx.diagnosis import statistics\n"
        "print(gaussian.PRIORS.least, round(gaussian.PRIORS.usual, 9), statistics.Gap(2.0, 36.0).at_noise)\n"
        "try: sensitivity.plant('Priors.noise', 1.0)\n"
        "except RuntimeError as e: print(e)"
    )
    out = subprocess.run([sys.executable, "-c", code, str(FOLDER)], capture_output=True, text=True, check=True).stdout
    assert out.splitlines() == ["1e-06 0.001 True", "bayessim_mjx.diagnosis.selection.numbers has been imported"]


def test_no_such_number():
    with pytest.raises(SystemExit, match=r"Priors\.lest: no number of .*numbers\.py; it has Priors\.expected"):
        sensitivity.value_of("Priors.lest")


def said(folder, verdict, effects, sets, simulated=1000):
    folder.mkdir(parents=True)
    answer = {"verdict": verdict, "effects": effects, "sets": sets}
    (folder / "result.json").write_text(json.dumps({"said": answer, "simulated": simulated}))


def test_the_record_counts_what_changes_and_the_page_shows_it(tmp_path):
    both = {"a@x": 0.7, "a@x + b@y": 0.25}
    said(tmp_path / "one" / "unchanged", "effects", ["a@x"], both)
    said(tmp_path / "two" / "unchanged", "no_gap", [], {"": 0.9})
    said(
        tmp_path / "one" / "Odds.strong_halved",
        "ambiguous",
        ["a@x", "b@y"],
        {"b@y + a@x": 0.5, "a@x": 0.3},
        simulated=500,
    )
    said(tmp_path / "two" / "Odds.strong_halved", "no_gap", [], {"": 0.85})
    found = sensitivity.record(tmp_path, ["one", "two", "three"], ["Odds.strong"], "abc", "command")
    (row,) = found["table"]  # nothing has ended with it doubled
    counts = ["2", "1", "1", "1", "0.40", "1.00", "one"]
    assert row == ["Odds.strong halved", "20", "10", *counts] and len(row) == len(found["columns"])
    assert json.loads(sensitivity.written(found)) == found
    page = "| `Odds.strong` | 20 | what | | |\n| `Odds.mention` | 3 | what | | |"
    assert sensitivity.paged(page, found).split("\n") == [
        "| `Odds.strong` | 20 | what | 1, 1, 1 of 2 | not counted |", "| `Odds.mention` | 3 | what | | |",
    ]  # fmt: skip


def test_a_run_goes_on_where_it_was_killed(tmp_path):
    """Unchanged runs come first; a number that halving does not change is not run; those with a result stay."""
    from counted_cases import plans

    case = next(p for p in plans() if p.name == "pendulum_single_s9300")
    todo = sensitivity.jobs(tmp_path, [case], ["Effort.rounds", "Odds.strong"])
    assert [f.name for f in todo] == [
        "unchanged", "Effort.rounds_halved", "Effort.rounds_doubled", "Odds.strong_halved", "Odds.strong_doubled",
    ]  # fmt: skip
    assert json.loads((todo[1] / "change.json").read_text()) == {"number": "Effort.rounds", "value": "2"}
    for folder in todo:
        (folder / "result.json").write_text("{}")
    sensitivity.run(todo, 1, 1.0)  # ends at once
