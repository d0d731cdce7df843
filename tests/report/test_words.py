"""Numbers, units and effects as people read them; the right answers are written down by hand."""

import math

import pytest

from bayessim_mjx.diagnosis.phrases import advice, effects
from bayessim_mjx.diagnosis.result import VERDICTS, Estimate, FoundEffect
from bayessim_mjx.report import words


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.031234, "0.0312"),
        (12.449, "12.4"),
        (9.999, "10.0"),
        (123456.0, "123456"),
        (0, "0"),
        (7, "7"),
        (-0.5, "−0.500"),
        (2.5e-6, "2.50·10⁻⁶"),
        (1.234e8, "1.23·10⁸"),
        (math.nan, "–"),
        (None, "–"),
        ("x", "–"),
    ],
)
def test_numbers(value, text):
    assert words.number(value) == text


@pytest.mark.parametrize(
    ("mean", "sd", "unit", "text"),
    [
        (0.0312, 0.0021, "N m", "0.0312 ± 0.0021 N m"),
        (0.0213, 0.0011, "s", "21.3 ± 1.1 ms"),
        (-1.5, 0.24, "rad", "−1.50 ± 0.24 rad"),
        (152.0, 31.0, "", "152 ± 31"),
        (0.5, math.nan, "kg", "0.500 kg"),
        (3.2e-6, 4e-7, "kg m^2", "(3.20 ± 0.40)·10⁻⁶ kg m²"),
    ],
)
def test_estimates_show_the_digits_that_the_sd_allows(mean, sd, unit, text):
    assert words.estimate(mean, sd, unit) == text


@pytest.mark.parametrize(
    ("share", "text"), [(0.68, "68 %"), (0.042, "4.2 %"), (0.9972, "99.7 %"), (1.0, "100 %"), (0.0, "0 %")]
)
def test_shares(share, text):
    assert words.percent(share) == text


def test_units_have_superscripts():
    assert words.signs("N m s^2/rad^2") == "N m s²/rad²" and words.signs("N m/rad^3") == "N m/rad³"


def test_effects_in_plain_english():
    assert effects.label_title("payload@hand") == "Extra payload at hand"
    assert effects.label_title("coulomb_friction@all") == "Coulomb friction at all joints"
    assert effects.label_title("payload@all") == "Extra payload at all bodies"
    assert effects.label_title("my_effect@elbow") == "My effect at elbow"
    assert effects.label_title("actuator_delay@m1", short=True) == "Command delay · m1"


def test_a_law_at_several_places_is_named_once():
    labels = ["coulomb_friction@elbow", "coulomb_friction@wrist", "actuator_delay@m1", "cogging@all"]
    assert (
        effects.candidate_title({"effects": labels})
        == "Coulomb friction · elbow, wrist + Command delay · m1 + Cogging · all"
    )
    assert effects.candidate_title({"effects": [], "label": "base"}) == "base"


def test_a_reciprocal_is_turned_over_with_its_error():
    # 1 / 0.5 = 2, sd 0.05 / 0.5^2 = 0.2
    assert effects.quantity("inverse_limit", Estimate(0.5, 0.05, "1/(N m)")) == ("limit", "2.00 +- 0.20 N m")
    assert effects.quantity("inverse_speed", Estimate(0.1, 0.01, "s/rad")) == ("no-load speed", "10.0 +- 1.0 rad/s")


def test_an_effect_with_several_parameters_names_them():
    two = {"level": Estimate(0.1, 0.03, "N m"), "excess": Estimate(0.2, 0.05, "N m")}
    line = effects.line(FoundEffect("stribeck_friction", "j", two, 1.0, 0.5, (0.4, 0.6)))
    assert line == "Stribeck friction at j: level 0.100 +- 0.030 N m, excess 0.200 +- 0.050 N m"


def test_gap_closed_by_hand():
    # (10^2 - 2^2) / (10^2 - 1^2) = 96 / 99
    assert words.gap_closed({"nominal": 10, "with_effects": 2, "reducible_floor": 1}) == pytest.approx(96 / 99)
    assert math.isnan(words.gap_closed({"nominal": 10, "with_effects": 2}))


def test_every_verdict_has_words():
    assert set(advice.VERDICTS) == set(VERDICTS)


@pytest.mark.parametrize(
    ("span", "said"),
    [
        ((2.0, 3.5), " (2.00 – 3.50)"),
        (None, ""),
        ((1.0, float("nan")), ""),
        ((4.7e-95, 7.7e99), " (interval wider than a factor of 1000)"),
        ((0.0, 5.0), " (interval wider than a factor of 1000)"),
    ],
)
def test_an_interval_that_says_nothing_is_not_told_in_numbers(span, said):
    assert words.spanned(span) == said


def test_the_ends_of_an_interval_of_shares_never_look_the_same():
    assert words.between(0.96, 0.999) == "96 % – 99.9 %"
    assert words.between(0.99963, 1.0) == "99.96 % – 100.00 %"
    assert words.between(0.999988, 1.0) == "100.00 %"
    assert words.between(float("nan"), 1.0) == ""


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("0.15 +- 0.01 N m at hinge", "0.15_±_0.01_N_m at hinge"),
        ("-0.5 N m s^2/rad^2 on run-1 of 2026-11-29", "−0.5_N_m_s²/rad² on run-1 of 2026-11-29"),
        ("99 % of it, 2.69 noise sd", "99_% of it, 2.69_noise_sd"),
        ("--accuracy 5% at wrist2 mass", "--accuracy 5% at wrist2 mass"),
    ],
)
def test_a_sentence_is_typeset_for_the_page(text, printed):
    assert words.page(text).replace("\N{NO-BREAK SPACE}", "_") == printed


@pytest.mark.parametrize(
    ("name", "value", "hinged", "text"),
    [
        ("m1.actuator_delay.delay", 0.0396, True, "delay 39.6 ms"),
        ("elbow.coulomb_friction.level", 0.15, True, "level 0.150 N m"),
        ("rail.coulomb_friction.level", 30.0, False, "level 30.0"),
        ("elbow.coulomb_friction.level", 1e-9, True, "level 0"),
        ("m1.actuator_saturation.inverse_limit", 0.5, True, "limit 2.00 N m"),
        ("elbow.my_effect.size", {"mean": 1.5, "sd": 0.1, "unit": "N"}, True, "size 1.50 ± 0.10 N"),
    ],
)
def test_numbers_of_candidates_have_units_where_all_joints_are_hinges(name, value, hinged, text):
    assert words.own_number(name, value, hinged) == text
