"""The reader of contradictions finds those that are planted, and none in what the room of words makes."""

import json

import pytest

from bayessim_mjx.diagnosis.result import plain
from tests.diagnosis.phrases import cases
from tests.diagnosis.phrases.contradictions import contradictions

EVERY = cases.every()


def said(name):
    """The contents of diagnosis.json."""
    return json.loads(json.dumps(plain(EVERY[name].to_dict())))


@pytest.mark.parametrize("name", EVERY)
def test_no_made_up_result_contradicts_itself(name):
    assert contradictions(said(name)) == []


@pytest.mark.parametrize(
    ("name", "before", "after", "kind"),
    [
        ("one effect", "closes 100 % of the squared gap above", "closes 80 % of the squared gap above", "share"),
        ("one effect", "predicted 66 %", "predicted 97 %", "share"),
        ("one effect", "in turn, the effect closes 98 %", "in turn, the effect closes 66 %", "share"),
        ("one effect", "explanations: 90 %", "explanations: 8.0 %", "share"),
        ("a remainder", "closes the rest, 7.0 %", "closes the rest, 66 %", "share"),
        ("much is left within the tolerance", "effects leave 31 %", "effects leave 3.0 %", "share"),
        ("much is left within the tolerance", "cause of this rest is unknown", "", "verdict"),
        ("partly", "that force makes 20 %", "that force makes 80 %", "share"),
        ("partly", "force removes 75 %", "force removes 20 %", "share"),
        ("one effect", "2.1 %", "2.3 %", None),  # is quoted nowhere
        ("one effect", "1.1 % of the motion", "3.3 % of the motion", "source"),
        ("one effect", "0.1497 +- 0.0087", "0.1697 +- 0.0087", "size"),
        ("one effect", "+- 0.0087", "+- 0.0037", "size"),
        ("a heavier link", "1.430 +- 0.022", "1.130 +- 0.022", "size"),
        ("one effect", "0.61 deg", "0.71 deg", "size"),
        ("one effect", "10.7 noise sd", "12.7 noise sd", "size"),
        ("a class with a number", "12.0 ms", "15.0 ms", "interval"),
        ("a class with a number", "10.0 to 14.0", "11.0 to 14.0", "interval"),
        ("a remainder", "3.00 noise sd", "3.00 noise sd, within the noise", "words"),
        ("one effect", "The simulator lacks", "No effect of the library explains", "words"),
        ("unexplained", "No effect of the library explains the gap", "The simulator lacks friction", "words"),
        ("parameters", "Only parameters are off", "The simulator lacks friction", "words"),
        ("one effect", "the effect reduces the gap", "the effect raises the gap", "words"),
        ("a remainder", "More than the tolerance remains at", "Every joint is within its tolerance at", "words"),
        ("one effect", "Every joint is within its tolerance", "More than the tolerance remains at hinge", "words"),
        ("unexplained", "This force acts", "No candidate and no flexible force predicts it. It acts", "predicts"),
        (
            "unexplained by chance",
            "A flexible force of motion and effort predicts nothing",
            "A flexible force still predicts a part",
            "predicts",
        ),
        ("two effects", "There may also", "missing at hinge, moving backward: +0.41 N m.\nThere may also", "place"),
    ],
)
def test_a_planted_contradiction_is_found(name, before, after, kind):
    planted = said(name)
    texts = "\n".join(planted["sentences"])
    assert (before in texts) == (kind is not None)
    planted["sentences"] = texts.replace(before, after).split("\n")
    assert kind in {found for found, _ in contradictions(planted)} or kind is None


def test_a_number_that_changed_under_a_sentence_is_found():
    planted = said("one effect")
    planted["gap"]["with_effects"] = 6.0
    assert {"share", "verdict"} <= {found for found, _ in contradictions(planted)}
    planted = said("a class with a number")
    planted["effects"][0]["shared"]["mean"] = 0.02
    assert "interval" in {found for found, _ in contradictions(planted)}


def test_a_verdict_behind_others_that_is_called_without_a_rival_is_found():
    """As of a diagnosis that named the twelfth of 36 sets at 100 %."""
    planted = said("another set with the best score")
    planted["sentences"] = [text for text in planted["sentences"] if "held-out score alone" not in text]
    assert "rank" in {found for found, _ in contradictions(planted)}
    planted = said("another set with the best score")
    planted["sentences"] = "\n".join(planted["sentences"]).replace("ranks it 2 of 3", "ranks it 1 of 3").split("\n")
    assert "rank" in {found for found, _ in contradictions(planted)}


def test_a_larger_set_with_most_of_the_probability_is_missed():
    planted = said("with another effect more probable")
    assert any("Sets with extra payload at arm as well have 88 % of it." in text for text in planted["sentences"])
    planted["sentences"] = [text.partition(" Sets with ")[0] for text in planted["sentences"]]
    assert "larger" in {found for found, _ in contradictions(planted)}


def test_a_late_effort_beside_a_late_measurement_is_found():
    planted = said("one effect")
    planted["effects"][0]["name"] = "sensor_delay"
    planted["sentences"].append("Without effects, the effort at hinge acts 7.1 ms [5.5, 8.7] later than commanded.")
    assert any("late, but" in text for _, text in contradictions(planted))


def test_a_member_of_the_answer_that_is_called_hidden_is_found():
    planted = said("two effects")
    planted["hidden"] = ["coulomb_friction@hinge"]
    assert "hidden" in {found for found, _ in contradictions(planted)}
