"""The verdict in words: one effect or several, promised and realised, every verdict a plain sentence."""

import dataclasses

import pytest

from bayessim_mjx.diagnosis.phrases import missing
from bayessim_mjx.diagnosis.result import VERDICTS, FoundEffect, Gap
from bayessim_mjx.diagnosis.summary import sentences

ROW = {"nominal": 0.02144, "calibrated": 0.0027, "with_effects": 0.000866, "unit": "rad", "tolerance": 0.02}
SHARES = {"nominal": 0.02144, "calibrated": 0.0027, "with_effects": 0.000866}
CLOSED = {"predicted": 0.66, "realised": 0.68}
LEVEL = Gap(1.0, 21.44, 2.7, 0.866, 0.866, physical={"hinge": ROW}, shares=SHARES, closed=CLOSED)


def effect(name, where, closed, promised):
    return FoundEffect(name, where, {}, 1.0, closed, (closed, closed), predicted_gap_closed=promised)


FRICTION = effect("coulomb_friction", "hinge", 0.68, 0.66)
GAIN = effect("actuator_gain", "torque", 0.32, 0.31)


def test_one_effect():
    head, falls, within = sentences.verdict_in_words("effects", [FRICTION], LEVEL)
    assert head == "The simulator lacks Coulomb friction at hinge."
    # 2.7 mrad of 1 rad are 0.155 deg, 0.27 %
    assert falls.startswith(
        "With it the recalibrated simulator's gap falls from 0.15 deg (0.27 % of the motion, 2.70 noise sd) to "
        "0.050 deg (0.087 % of the motion, 0.87 noise sd) on held-out conditions."
    )
    assert within.endswith("the tolerance at every joint: 0.050 deg above the noise, of 1.1 deg, at hinge.")
    assert falls.endswith(
        "Before it was fitted, 66 % of the squared gap above the noise was predicted to close; 68 % did."
    )


def test_what_conditions_without_a_part_in_the_choice_say():
    known = dataclasses.replace(LEVEL, closed=CLOSED | {"elsewhere": 0.41})
    told = sentences.verdict_in_words("effects", [FRICTION], known)[2]
    assert told.endswith("they close 41 % of the gap of the condition that was left out.")
    assert told not in sentences.verdict_in_words("effects", [FRICTION], LEVEL)


def test_of_one_log_all_numbers_are_called_in_sample():
    one = dataclasses.replace(LEVEL, in_sample=True)
    _, falls, said, *_ = sentences.verdict_in_words("effects", [FRICTION], one)
    assert "on held-out parts of the log." in falls and "condition" not in falls
    assert said.startswith("These numbers are in sample: one log is one operating condition")
    assert not any("in sample" in text for text in sentences.verdict_in_words("effects", [FRICTION], LEVEL))


def test_a_choice_without_a_condition_is_said_to_rest_on_costs_that_saw_it():
    nested = dataclasses.replace(LEVEL, closed={"nested": True, "elsewhere": 0.6})
    text = " ".join(sentences.verdict_in_words("effects", [FRICTION], nested))
    assert "chosen and fitted without it; the costs behind the choice were not" in text


def test_several_effects():
    both = dataclasses.replace(LEVEL, closed={"predicted": 0.97, "realised": 1.0})
    head, falls, _ = sentences.verdict_in_words("effects", [FRICTION, GAIN], both)
    assert head == "The simulator lacks Coulomb friction at hinge and the true actuator gain at torque."
    assert falls.startswith("With them the recalibrated")
    assert falls.endswith(
        "Before they were fitted, 97 % of the squared gap above the noise was predicted to close; 100 % did."
    )


def test_what_comes_nearest_where_nothing_explains():
    one = sentences.verdict_in_words("unexplained", [FRICTION], LEVEL, 0.4)[1]
    assert one == (
        "Of the library, Coulomb friction at hinge comes nearest; a force that it lacks makes 40 % of the gap."
    )
    two = sentences.verdict_in_words("unexplained", [FRICTION, GAIN], LEVEL, 0.4)[1]
    assert two.endswith("come nearest; a force that they lack makes 40 % of the gap.")
    alone = sentences.verdict_in_words("unexplained", [FRICTION], LEVEL)[1]
    assert alone == "Of the library, Coulomb friction at hinge comes nearest."


@pytest.mark.parametrize("verdict", [v for v in VERDICTS if v != "insufficient_data"])
def test_every_verdict_is_a_sentence(verdict):
    for found in ([], [FRICTION], [FRICTION, GAIN]):
        for text in sentences.verdict_in_words(verdict, found, LEVEL, 0.4):
            assert text[0].isupper() and text.endswith(".") and "{" not in text and "  " not in text


def test_names_of_effects_and_places():
    assert missing("viscous_friction", "all") == "viscous friction at all joints"
    assert missing("gravity_tilt", "world") == "the tilt of the base"
    assert missing("my_effect", "elbow") == "my effect at elbow"


@pytest.mark.parametrize(("value", "text"), [(0.8661, "0.87"), (2.7, "2.70"), (21.44, "21.4"), (161.6, "162")])
def test_numbers(value, text):
    assert sentences.number(value) == text


def test_a_closure_that_depends_on_the_horizon_is_flagged():
    rows = [("0.1 s", 3.0, 1.0), ("0.5 s", 3.0, 1.1), ("whole log", 100.0, 70.0)]
    horizons = [{"name": n, "calibrated": c, "with_effects": w} for n, c, w in rows]
    (told,) = sentences.horizon_warning(Gap(1.0, 4.0, 3.0, 1.1, 1.0, horizons=horizons))
    assert told == "the gap closed depends on the horizon: 100 % (0.1 s), 97 % (0.5 s), 51 % (whole log)"
    assert not sentences.horizon_warning(Gap(1.0, 4.0, 3.0, 1.1, 1.0, horizons=horizons[:2]))


def test_noise_larger_than_estimated_is_told_with_its_colour():
    (head,) = sentences.verdict_in_words("noise", [], LEVEL)
    assert head.startswith("The noise is larger than estimated: what the recalibrated simulator leaves, 0.15 deg")
    assert sentences._of_sensors(0.06).endswith("correlated over about 60 ms.")
    assert sentences._of_sensors(0.0).endswith("white.")
