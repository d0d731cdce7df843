"""Scores, tables and pictures of the blind benchmark on cases written by hand."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import score
import systems
import tables
import weights

ELBOW = {"name": "coulomb_friction", "where": "elbow", "parameters": {"level": 0.11}, "raw": 20.0, "left": 9.0}
HIP = {"name": "actuator_gain", "where": "shoulder_motor", "parameters": {"gain": 1.2}, "raw": 20.0, "left": 9.0}
RIGHT = ("coulomb_friction", "elbow")


def said(*named: tuple[str, str], verdict: str | None = None, rivals: list | None = None, level: float = 0.1) -> Any:
    numbers = {"level": {"mean": level, "sd": 0.01}, "gain": {"mean": 1.0, "sd": 0.01}}
    told = {"parameters": numbers, "gap_closed": 0.9 / max(len(named), 1), "equivalent_to": rivals or []}
    effects = [{"name": name, "where": where} | told for name, where in named]
    return {"verdict": verdict or ("effects" if named else "no_gap"), "effects": effects}


def case(
    folder: Path,
    effects: list,
    verdict: Any,
    *,
    kind: str = "single",
    oracle: float = 0.93,
    rival: float = 5.0,
    **more: Any,
) -> Path:
    """A folder as generate, isolable and run leave it."""
    out = folder / "diagnosis"
    out.mkdir(parents=True)
    (folder / "model.xml").write_text(systems.SYSTEMS["two_link"].xml)
    truth = {"system": "two_link", "strength": "medium", "effects": effects, "kind": kind, "seed": 1}
    files = {folder / "truth.json": truth, out / "exit.json": {"code": 0, "seconds": 60.0, "compile_seconds": 20.0}}
    files |= {out / "oracle.json": {"closure": oracle}}
    files |= {folder / "isolable.json": [{"name": "x", "left": rival}]} if kind == "single" else {}
    files |= {out / "diagnosis.json": verdict} if verdict else {}
    files |= {folder / name: content for name, content in more.items()}
    for path, content in files.items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(content))
    return folder


def rates(*folders: Path) -> dict[str, score.Rate]:
    return {r.what: r for r in score.rates([score.read(f) for f in folders])}


def test_a_right_a_rival_and_a_wrong_verdict(tmp_path):
    right = score.read(case(tmp_path / "a", [ELBOW], said(RIGHT)))
    assert right.right(ELBOW) and score.covered(right) == [True]
    assert score.closure_errors([right]) == pytest.approx([0.03])
    rivals = [{"effects": ["coulomb_friction@elbow"]}]
    rival = score.read(case(tmp_path / "b", [ELBOW], said(("stribeck_friction", "elbow"), rivals=rivals)))
    assert rival.inside(ELBOW) and not rival.right(ELBOW)
    wrong = score.read(case(tmp_path / "c", [ELBOW], said(("coulomb_friction", "shoulder"))))
    assert not wrong.inside(ELBOW)


def test_an_actuator_and_its_joint_are_one_place(tmp_path):
    assert score.read(case(tmp_path / "a", [HIP], said(("actuator_gain", "shoulder")))).right(HIP)


def test_what_a_rival_explains_from_the_truth_does_not_count_as_isolable(tmp_path):
    near = case(tmp_path / "a", [ELBOW], said(), rival=0.2)
    faint = case(tmp_path / "c", [ELBOW | {"left": 30.0}], said(), rival=4.0)
    far = case(tmp_path / "b", [ELBOW], said(RIGHT), rival=4.0)
    found = rates(near, faint, far)
    assert found["single, isolable: effect and place named"].answers == [True]
    assert found["single, all: effect and place named"].answers == [False, False, True]


def test_a_cause_weaker_than_asked_does_not_count(tmp_path):
    weak = case(tmp_path / "a", [ELBOW | {"left": 1.0}], said())
    assert not rates(weak)["single, all: effect and place named"].answers


def test_doubles_nulls_and_unknown_causes(tmp_path):
    both = case(tmp_path / "a", [ELBOW, HIP], said(RIGHT, ("actuator_gain", "shoulder_motor")), kind="double")
    one = case(tmp_path / "b", [ELBOW, HIP], said(RIGHT), kind="double")
    alarm = case(tmp_path / "c", [], said(RIGHT), kind="null", oracle=None)
    quiet = case(tmp_path / "d", [], said(verdict="parameters"), kind="null", oracle=None)
    other = ELBOW | {"name": "unknown_pushes"}
    found = rates(both, one, alarm, quiet, case(tmp_path / "e", [other], said(verdict="unexplained"), kind="unknown"))
    assert found["double: both named"].answers == [True, False]
    assert found["nothing wrong: false alarm"].answers == [True, False]
    assert found["unknown cause: unexplained"].answers == [True]


def test_a_family_left_out_has_to_be_unexplained(tmp_path):
    folder = case(tmp_path / "a", [ELBOW], said(RIGHT))
    (folder / "left_out").mkdir()
    (folder / "left_out" / "diagnosis.json").write_text(json.dumps(said(verdict="unexplained")))
    found = {r.what: r for r in score.rates([], [score.read(folder, "left_out")])}
    assert found["family left out: unexplained"].answers == [True]


def test_naming_nothing_closes_nothing(tmp_path):
    assert score.closure_errors([score.read(case(tmp_path / "a", [ELBOW], said()))]) == [0.93]


def test_parameters_that_mean_something_else_are_not_asked_for(tmp_path):
    loose = {"name": "load_friction", "where": "elbow", "parameters": {"level": 9.0}, "raw": 20.0, "left": 9.0}
    assert score.covered(score.read(case(tmp_path / "a", [loose], said(("load_friction", "elbow"))))) == []


def test_confusion_counts_hidden_against_named(tmp_path):
    folders = [case(tmp_path / "a", [ELBOW], said(RIGHT)), case(tmp_path / "b", [ELBOW], said())]
    folders += [case(tmp_path / "c", [], said(("backlash", "elbow")), kind="null")]
    rows, columns, counts = score.confusion([score.read(f) for f in folders])
    assert rows == ["coulomb_friction", "nothing"] and columns == ["backlash", "coulomb_friction", "no_gap"]
    np.testing.assert_array_equal(counts, [[0, 1, 1], [1, 0, 0]])


def test_everything_is_written_with_the_baselines_beside_it(tmp_path):
    folders = [case(tmp_path / "a", [ELBOW], said(RIGHT)), case(tmp_path / "b", [HIP], None)]
    fits = {"naive BIC": said(("backlash", "elbow")), "parameter refit": said(verdict="parameters")}
    (folders[0] / "diagnosis" / "baselines.json").write_text(json.dumps(fits))
    footer = tables.score(folders, tmp_path / "out")
    assert footer.startswith("2 of 2 cases run; 1 without a result")
    files = ("score.md", "score.json", "score.html", "confusion.csv", "confusion.txt", "confusion.png")
    assert all((tmp_path / "out" / f).stat().st_size > 50 for f in files)
    numbers = json.loads((tmp_path / "out" / "score.json").read_text())
    named = "single, all: effect and place named"
    assert (numbers["diagnosis"][named]["hits"], numbers["diagnosis"][named]["n"]) == (1, 2)
    assert (numbers["naive BIC"][named]["hits"], numbers["naive BIC"][named]["n"]) == (0, 1)
    assert numbers["diagnosis"]["seconds"]["median_compile_seconds"] == 20.0
    page = (tmp_path / "out" / "score.html").read_text()
    assert "naive BIC: hidden against named" in page and "Plotly.newPlot" in page
    assert (tmp_path / "out" / "confusion.csv").read_text().splitlines()[0] == "hidden,coulomb_friction,no result"


def test_weights_among_rivals_are_scored_as_probabilities(tmp_path):
    """Said .8 and true, .2 and false, .8 and false, .2 and true: Brier (.04 + .04 + .64 + .64) / 4; half is true."""
    rivals = [{"effects": ["stribeck_friction@elbow"], "weight": 0.2}, {"effects": ["load_friction@elbow"]}]
    told = [
        said(RIGHT, rivals=rivals),
        said(("backlash", "elbow"), rivals=[rivals[0] | {"effects": ["@".join(RIGHT)]}]),
    ]
    for file in told:
        file["effects"][0]["weight_among_rivals"] = 0.8
    folders = [case(tmp_path / str(i), [ELBOW], file) for i, file in enumerate(told)]
    folders.append(case(tmp_path / "alone", [ELBOW], said(RIGHT)))  # nothing to be weighed against
    outcomes = [score.read(f) for f in folders]
    found = weights.forecasts(outcomes)
    assert sorted(found) == [(0.2, False), (0.2, True), (0.8, False), (0.8, True)]
    assert weights.brier(found) == pytest.approx((0.34, 0.25))
    _, _, rows = weights.table(outcomes)
    assert [row[:3] for row in rows[:2]] == [["0.2 to 0.4", "2", "0.20"], ["0.8 to 1", "2", "0.80"]]
    assert all(row[3].startswith("50 %") for row in rows[:2])
    tables.score(folders, tmp_path / "out")
    assert "Brier score 0.340; of the base rate 0.250" in (tmp_path / "out" / "score.md").read_text()


def test_mcnemars_exact_p_of_pairs_that_differ():
    assert [score.mcnemar(0, 0), score.mcnemar(3, 3)] == [1.0, 1.0]
    assert score.mcnemar(0, 5) == score.mcnemar(5, 0) == pytest.approx(1 / 16)
    assert score.mcnemar(1, 7) == pytest.approx(18 / 256)


def test_wilson_interval_of_nine_in_ten():
    # (p + z^2/2n -+ z sqrt(p q / n + z^2 / 4n^2)) / (1 + z^2/n) with z = 1.96: Wilson (1927), 0.596 to 0.982
    assert score.wilson(9, 10) == pytest.approx((0.596, 0.982), abs=1e-3)


def test_a_limit_holds_on_its_side_and_a_number_without_interval_holds_nothing():
    at = {"mean": 2.0, "sd": None}
    assert score.holds(at | {"bound": "at least"}, 3.0) and not score.holds(at | {"bound": "at least"}, 1.0)
    assert score.holds(at | {"bound": "at most"}, 1.0) and not score.holds(at | {"bound": "at most"}, 3.0)
    assert not any(score.holds(at | {"bound": bound}, 2.0) for bound in ("end", "off", ""))
    assert score.holds({"mean": 2.0, "sd": 0.1}, 2.16) and not score.holds({"mean": 2.0, "sd": 0.1}, 2.17)


def test_a_parameter_at_a_bound_is_asked_for_too(tmp_path):
    ended = said(RIGHT)
    ended["effects"][0]["parameters"] = {"level": {"mean": 0.2, "sd": None, "bound": "end"}}
    assert score.covered(score.read(case(tmp_path / "a", [ELBOW], ended))) == [False]


def test_a_truth_in_a_set_has_the_set_as_its_price(tmp_path):
    """Named, an equal pair of which one is named already, and one hidden: three places."""
    rivals = [{"effects": ["coulomb_friction@elbow", "backlash@elbow"]}, "stribeck_friction@elbow"]
    wide = said(("stribeck_friction", "elbow"), rivals=rivals) | {"hidden": ["backlash@elbow"]}
    found = rates(case(tmp_path / "a", [ELBOW], wide), case(tmp_path / "b", [ELBOW], said()))
    told = found["single: truth in the equivalence set"]
    assert told.answers == [True, False] and told.size == 3.0  # the answer that names nothing has no set
    assert told.to_dict()["set_size"] == 3.0 and told.told.endswith("sets of 3.0")


def test_families_left_out_count_with_unknown_causes(tmp_path):
    folder = case(tmp_path / "a", [ELBOW], said(RIGHT))
    (folder / "left_out").mkdir()
    (folder / "left_out" / "diagnosis.json").write_text(json.dumps(said(RIGHT)))
    other = case(tmp_path / "b", [ELBOW | {"name": "unknown_pushes"}], said(verdict="unexplained"), kind="unknown")
    found = {r.what: r for r in score.rates([score.read(other)], [score.read(folder, "left_out")])}
    assert found["unknown cause or family left out: unexplained"].answers == [True, False]
