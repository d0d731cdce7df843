"""The verdict in words: numbers as they follow by hand, and no sentence against another."""

import dataclasses
import shlex

import pytest

from bayessim_mjx.diagnosis.phrases import advice, notes, size, verdict
from bayessim_mjx.diagnosis.result import VERDICTS, Gap, Place
from tests.diagnosis.phrases import cases
from tests.diagnosis.phrases.cases import CLOSED, FRICTION, GAIN, LEVEL, PAYLOAD, gap, made


def test_the_head_has_the_place_and_the_number_of_each_effect():
    head = made("effects", [FRICTION, GAIN]).sentences[0]
    assert head == (
        "The simulator lacks Coulomb friction of 0.1497 +- 0.0087 N m at hinge; "
        "the actuator gain at torque is 0.698 +- 0.036, not 1."
    )


def test_the_gap_falls_by_the_share_that_its_two_numbers_give():
    """Of 10.7 and 3 noise sd: (114.49 - 9) / 113.49 = 92.95 %; 10.7 mrad are 0.61 deg."""
    falls = made("effects", [FRICTION], gap(with_effects=3.0)).sentences[1]
    assert falls.startswith("On held-out conditions the effect reduces the gap from 0.61 deg (1.1 % of the motion")
    assert falls.endswith("This closes 93 % of the squared gap above the noise.")
    rises = made("unexplained", [FRICTION], gap(with_effects=10.8)).sentences
    assert any(text.startswith("On held-out conditions the effect raises the gap from 0.61 deg") for text in rises)


def test_the_promise_and_the_result_stand_together():
    text = made("effects", [FRICTION]).sentences[2]
    assert (
        "predicted 66 %" in text and "Chosen and fitted without each condition in turn, the effect closes 98 %" in text
    )
    few = made("effects", [FRICTION], gap(closed=CLOSED | {"nested": False})).sentences[2]
    assert "Fitted without each condition" in few


def test_of_one_log_all_numbers_are_called_in_sample():
    one = made("effects", [FRICTION], gap(in_sample=True)).sentences
    assert "On held-out parts of the log" in one[1] and "each part of the log" in one[2]
    assert any(text.startswith("These numbers are in sample") for text in one)
    assert not any("in sample" in text for text in made("effects", [FRICTION]).sentences)


def test_a_class_is_one_answer_with_the_number_that_its_members_share():
    found = cases.every()["a class with a number"]
    (answer,) = found.answers
    assert [m["effects"] for m in answer["members"]] == [
        ["actuator_delay@torque"], ["actuator_lag@torque"], ["sensor_delay@hinge"],
    ]  # fmt: skip
    assert sum(m["probability"] for m in answer["members"]) == pytest.approx(1.0)
    assert answer["splits"] == "chirp on hinge"
    assert found.sentences[0] == (
        "These logs fit 3 explanations alike: 12.0 ms (90 %: 10.0 to 14.0) on the command's way, by command delay or "
        "actuator lag at torque. With another number: measurement delay at hinge."
    )


def test_an_answer_without_rivals_is_a_class_of_one():
    (answer,) = made("effects", [FRICTION]).answers
    assert answer["members"] == [{"effects": ["coulomb_friction@hinge"], "probability": 1.0}] and answer["splits"] == ""


def test_a_member_of_a_class_is_not_called_hidden_as_well():
    hidden = ["inertial_parameters@tool", "viscous_friction@hinge"]
    text = " ".join(made("ambiguous", [PAYLOAD], hidden=hidden).sentences)
    assert "There may also be viscous friction at hinge." in text and text.count("wrong centre of mass") == 1


def test_a_gap_within_the_noise_is_called_so():
    assert size.gap_line(made("effects", [FRICTION])) == (
        "Gap over 0.5 s: 1.2 deg (2.1 % of the motion, 21.4 noise sd) as delivered, 0.61 deg (1.1 % of the motion, "
        "10.7 noise sd) recalibrated, 0.050 deg (0.087 % of the motion, 0.87 noise sd, within the noise) with the "
        "effects."
    )
    assert "with the effects" not in size.gap_line(made("parameters"))


def whole(name, **sizes):
    """The horizon of whole logs."""
    return {"name": name, "over_likely": 1.0, "physical": {"hinge": sizes | {"unit": "rad"}}}


def test_the_gap_has_its_time_and_that_of_whole_logs():
    row = whole("whole log", nominal=0.138, calibrated=0.05, with_effects=0.001)
    text = size.gap_line(made("effects", [FRICTION], gap(horizons=[{"name": "0.5 s"}, row])))
    assert text.startswith("Gap over 0.5 s: 1.2 deg")
    assert text.endswith(" Over whole logs: 7.9 deg as delivered, 2.9 deg recalibrated, 0.057 deg with the effects.")
    short = made("effects", [FRICTION], gap(horizons=[row | {"name": "up to 3.2 s"}]))
    assert "Over simulations of up to 3.2 s: 7.9 deg" in size.gap_line(short)


@pytest.mark.parametrize(
    ("nominal", "calibrated", "words"),
    [(21.4, 10.7, ""), (10.0, 11.0, size.NO_HELP), (0.98, 0.99, size.QUIET), (1.0, 0.99, "")],
)
def test_a_recalibration_that_does_not_help_is_said(nominal, calibrated, words):
    found = made("effects", [FRICTION], gap(nominal=nominal, calibrated=calibrated))
    assert size.no_help(found) == words and size.gap_line(found).endswith(words or "with the effects.")
    assert size.below_tiles(found) == f"These gaps are of windows of 0.5 s. {words}".strip()


def test_effects_that_the_headline_does_not_name_are_the_nearest():
    far = dataclasses.replace(LEVEL, with_effects=6.0, closed=LEVEL.closed | {"realised": -0.03})
    found = made("unexplained", [FRICTION], far)
    assert "noise sd) with the nearest effects" in size.gap_line(found)
    assert "in turn, the effect closes 0 %" in " ".join(found.sentences)


EVERY = [
    (verdict, count)
    for verdict in VERDICTS
    for count in (0, 1, 2)
    if verdict != "insufficient_data" and (count or verdict not in ("effects", "ambiguous"))
]


@pytest.mark.parametrize(("name", "count"), EVERY)
def test_every_verdict_is_a_sentence(name, count):
    effects = [FRICTION, GAIN][:count]
    for text in made(name, effects, remains=0.4).sentences:
        assert text[0].isupper() and text.endswith(".") and "{" not in text and "  " not in text


@pytest.mark.parametrize(("nominal", "none"), [(1.14, True), (1.16, False)])
def test_no_gap_above_the_noise_is_said_only_within_the_noise(nominal, none):
    head = made("no_gap", far=gap(nominal=nominal, calibrated=nominal, with_effects=nominal)).sentences[0]
    assert head.startswith("No gap above the noise") == none == ("exceeds the noise" not in head)
    assert head.startswith("The logs differ") != none


def test_nothing_is_said_to_predict_nothing_beside_a_force_that_predicts():
    force = {**cases.FORCE, "on": "recalibrated"}
    text = " ".join(made("unexplained", flexible=force).sentences)
    assert "removes 75 %" in text and "no flexible force predicts" not in text
    text = " ".join(made("unexplained", flexible=cases.NOTHING).sentences)
    assert "no flexible force predicts" in text and "removes" not in text


@pytest.mark.parametrize(("value", "text"), [(0.8661, "0.87"), (2.7, "2.70"), (21.44, "21.4"), (161.6, "162")])
def test_numbers(value, text):
    assert verdict.number(value) == text


def test_a_closure_that_depends_on_the_horizon_is_flagged():
    """Intervals of the shares: of windows from 94 %, of whole logs up to 64 %."""
    rows = [("0.1 s", 3.0, 1.0), ("0.5 s", 3.0, 1.1), ("whole log", 100.0, 70.0)]
    horizons = [
        {"name": n, "calibrated": c, "with_effects": w, "ci": {"with_effects": [w / 1.16, w * 1.16]}}
        for n, c, w in rows
    ]
    (text,) = notes.horizon_warning(Gap(1.0, 4.0, 3.0, 1.1, 1.0, horizons=horizons))
    assert text.endswith("depends on the horizon: 100 % (0.1 s), 97 % (0.5 s), 51 % (whole log)")
    assert not notes.horizon_warning(Gap(1.0, 4.0, 3.0, 1.1, 1.0, horizons=horizons[:2]))
    nobody_knows = [row | {"ci": {"with_effects": [float("nan")] * 2}} for row in horizons]  # of one condition
    assert not notes.horizon_warning(Gap(1.0, 4.0, 3.0, 1.1, 1.0, horizons=nobody_knows))


ABOUT = {"model": "Pendulum", "data": ["my logs"]}
RUN = {"name": "chirp", "file": "next_experiment.csv"}


@pytest.mark.parametrize(
    ("name", "effects", "about", "experiment", "words"),
    [
        ("effects", [FRICTION], ABOUT, {}, "bayessim-mjx train --task Pendulum effects=found/effects.yaml"),
        ("effects", [FRICTION], ABOUT | {"model": "a/arm.xml"}, RUN,
         "python -m mujoco.viewer --mjcf=found/model_with_effects.xml"),
        ("no_gap", [], ABOUT, {}, "bayessim-mjx train --task Pendulum"),
        ("ambiguous", [PAYLOAD], ABOUT | {"model": "arm.xml"}, RUN,
         "bayessim-mjx diagnose --model arm.xml --data 'my logs' new_logs --out found_2"),
        ("unexplained", [], ABOUT, {}, ""),
        ("effects", [FRICTION], {}, {}, ""),
    ],
)  # fmt: skip
def test_the_command_can_be_pasted(name, effects, about, experiment, words):
    found = dataclasses.replace(made(name, effects, experiment=experiment), about=about)
    assert advice.command(found, "found") == words == shlex.join(shlex.split(words))


def test_a_viewer_is_no_training():
    assert advice.purpose("python -m mujoco.viewer --mjcf=found/a.xml") == "view it"
    assert advice.purpose("bayessim-mjx train --task Pendulum") == "next"


def test_a_model_for_mujoco_that_lacks_an_effect_is_not_advised():
    """Nor shown by the command: what it lacks may be most of what was found."""
    found = dataclasses.replace(made("effects", [FRICTION]), about=ABOUT | {"model": "arm.xml"})
    assert "model_with_effects.xml in plain MuJoCo" in advice.verdict_of(found).advice
    lacking = dataclasses.replace(found, warnings=[f"{advice.MODEL} leaves out sensor_delay at all: no such delay"])
    assert "lacks a part of it" in advice.verdict_of(lacking).advice and advice.command(lacking, "found") == ""
    of_task = dataclasses.replace(lacking, about=ABOUT)
    assert advice.command(of_task, "found") == "bayessim-mjx train --task Pendulum effects=found/effects.yaml"


def test_too_little_data_leads_to_a_check_of_the_logs():
    found = dataclasses.replace(made("no_gap"), verdict="insufficient_data", about=ABOUT | {"model": "arm.xml"})
    assert advice.command(found, "found") == "bayessim-mjx logs check 'my logs' --model arm.xml"
    assert "warnings" not in advice.verdict_of(found).advice
    assert "as the warnings say" in advice.verdict_of(dataclasses.replace(found, warnings=["a note"])).advice


def test_an_experiment_is_advised_only_where_there_is_one():
    with_one, without = (made("ambiguous", [PAYLOAD], experiment=e) for e in (RUN, {}))
    assert "next experiment" in advice.verdict_of(with_one).advice
    assert "next experiment" not in advice.verdict_of(without).advice
    assert "without --quick" in advice.verdict_of(without).advice  # nobody searched for one
    none = made("ambiguous", [PAYLOAD], experiment={"name": "none"})
    assert "none was found here" in advice.verdict_of(none).advice


def test_effects_that_close_less_than_half_lead_to_the_map_and_not_to_training():
    """Of 99 above the noise 8 noise sd leave 63: the effects close 36 % of the squared gap."""
    far = dataclasses.replace(cases.every()["partly"].gap, calibrated=10.0, with_effects=8.0)
    found = dataclasses.replace(made("unexplained", [GAIN], far), about=ABOUT | {"model": "arm.xml"})
    assert "map and the logs first" in advice.verdict_of(found).advice
    assert "Train with effects.yaml" not in advice.verdict_of(found).advice
    assert advice.command(found, "found") == "bayessim-mjx logs check 'my logs' --model arm.xml"
    assert found.sentences[0].startswith("No effect of the library explains the gap")


def test_a_set_with_further_effects_that_close_nothing_is_no_other_answer():
    """By the rule of relevance, .3 % of the squared gap: .15 % more counts as the answer, .9 % more does not."""
    own = cases.every()["a larger set with the best score"]
    assert [verdict.counts_as_answer(own, c) for c in own.candidates] == [True, False, False]
    assert "1 set with further effects. These close at most 0.15 % more of the gap" in " ".join(own.sentences)
    much = [own.candidates[0] | {"gap_closed": 0.989}, *own.candidates[1:]]
    text = " ".join(verdict.sentences(dataclasses.replace(own, candidates=much)))
    assert "further effects" not in text and "ranks it 2 of 3, 77 nats behind" in text


def test_of_a_standard_deviation_the_part_of_the_logs_is_said_where_it_is_the_smaller_one():
    """.0005 of .0013, as .0013^2 = .0012^2 + .0005^2."""
    text = " ".join(cases.every()["known better than simulators agree"].sentences)
    assert "By the logs alone: 0.0005 of the 0.0013 N m of Coulomb friction at hinge." in text
    assert "By the logs alone" not in " ".join(cases.every()["one effect"].sentences)


def test_effects_within_the_tolerance_that_explain_nothing_are_no_part_of_an_explanation():
    assert advice.verdict_of(made("unexplained", [GAIN])).badge == "Unexplained"
    assert advice.verdict_of(cases.every()["partly"]).badge == "Partly explained"


def test_what_stands_below_is_promised_only_where_it_was_looked_for():
    """As of `--quick`, which leaves out where the gap lies and the next experiment."""
    short = made("unexplained")
    assert "shows where a force is missing" in advice.verdict_of(short).advice
    whole = dataclasses.replace(short, where=[Place("hinge", 1.0, (0.9, 1.0), "at rest")])
    assert advice.verdict_of(whole).advice.startswith("See below where a force is missing")
