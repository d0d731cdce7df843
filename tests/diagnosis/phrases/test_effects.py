"""Effects in words: laws with their places, numbers rounded by their uncertainty, classes of explanations."""

import dataclasses
import math

import pytest

from bayessim_mjx.diagnosis.correction import Estimate
from bayessim_mjx.diagnosis.equation_error.inverse_dynamics_check import Joint, Look
from bayessim_mjx.diagnosis.phrases import effects, notes
from bayessim_mjx.diagnosis.phrases.effects import by_law, numbered, titled
from bayessim_mjx.diagnosis.selection.bounds import Bound
from tests.diagnosis.phrases.cases import effect


def test_a_law_at_several_joints_is_one_phrase():
    named = [("coulomb_friction", "hip"), ("actuator_delay", "all"), ("coulomb_friction", "knee")]
    assert by_law(named) == ["Coulomb friction at hip and knee", "command delay at all actuators"]


def test_a_tied_effect_and_one_without_a_place_stand_by_themselves():
    named = [("gravity_tilt", "world"), ("coulomb_friction", "all"), ("payload", "hand")]
    assert by_law(named) == [titled(*effect) for effect in named]
    assert by_law([]) == [] and effects.all_of([]) == "the known parameters alone"


def test_names_of_effects_and_places():
    assert numbered(effect("viscous_friction", "all")) == "viscous friction at all joints"
    assert numbered(effect("gravity_tilt", "world")) == "the tilt of the base"
    assert numbered(effect("my_effect", "elbow")) == "my effect at elbow"
    assert effects.any_of(["actuator_delay@m", "actuator_lag@m"]) == "command delay or actuator lag at m"
    assert effects.any_of(["actuator_delay@m", "sensor_delay@j"]) == "command delay at m or measurement delay at j"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (Estimate(0.1190, 0.0016, "N m"), "0.1190 +- 0.0016 N m"),
        (Estimate(-1.5, 0.24, "rad"), "-1.50 +- 0.24 rad"),
        (Estimate(0.7, math.nan), "0.700"),
    ],
)
def test_an_estimate_is_printed_as_it_is_rounded_by_its_uncertainty(value, text):
    assert str(value) == text


@pytest.mark.parametrize(
    ("found", "text"),
    [
        (effect("actuator_delay", "m", delay=(0.0213, 0.0011, "s")), "a command delay of 21.3 +- 1.1 ms at m"),
        (effect("actuator_saturation", "m", inverse_limit=(0.5, 0.05, "1/(N m)")),
         "an effort limit of 2.00 +- 0.20 N m at m"),
        (effect("backlash", "j", gap=(0.05, math.nan, "rad", "at least")),
         "backlash of at least 0.0500 rad to either side (0.100 rad in all) at j"),
        # com_x is within its uncertainty of none
        (effect("payload", "tool", mass=(0.99, 0.01, "kg"), com_x=(0.01, 0.1, "m")),
         "an extra payload at tool (mass 0.990 +- 0.010 kg)"),
        (effect("payload", "tool", mass=(0.99, 0.01, "kg"), com_x=(1.0, 0.1, "m"), com_y=(1.0, 0.1, "m")),
         "an extra payload at tool (mass 0.990 +- 0.010 kg, centre of mass x 1.00 +- 0.10 m, "
         "centre of mass y 1.00 +- 0.10 m)"),
        (effect("my_effect", "elbow"), "my effect at elbow"),
    ],
)  # fmt: skip
def test_an_effect_has_its_place_and_its_numbers(found, text):
    assert effects.lacking([found]) == f"the simulator lacks {text}"


def test_a_half_is_never_printed_as_the_whole():
    play = effect("backlash", "j", gap=(0.01977, 0.00069, "rad"), compliance=(0.001, 0.0001, "rad/(N m)"))
    other = dataclasses.replace(play, where="k")
    size = "0.01977 +- 0.00069 rad to either side (0.0395 rad in all)"
    assert effects.lacking([play]) == f"the simulator lacks backlash of {size} at j"
    assert effects.lacking([play, other]) == f"the simulator lacks backlash of {size} at j and {size} at k"
    assert effects.line(play).startswith("Backlash at j: gap (half of the play) 0.01977 +- 0.00069 rad, ")
    dead = effect("actuator_deadband", "m", half_width=(0.1, 0.01, ""))
    assert effects.lacking([dead]) == (
        "the simulator lacks a command deadband of 0.100 +- 0.010 to either side (0.200 in all) at m"
    )
    assert effects.line(dead) == "Command deadband at m: 0.100 +- 0.010 to either side (0.200 in all)"


def test_numbers_that_the_model_has_wrong_are_no_lack():
    scale = effect("sensor_gain", "j", gain=(1.1, 0.02, ""))
    height = effect("ground_height", "world", height=(0.02, 0.001, "m"))
    centre = effect("inertial_parameters", "link", com_x=(0.01, 0.001, "m"), inertia=(1.0, 0.1, ""))
    assert effects.lacking([scale, height, centre]) == (
        "the sensor gain at j is 1.100 +- 0.020, not 1; the height of the ground is off by 0.0200 +- 0.0010 m; "
        "the centre of mass and inertia at link is not the model's (centre of mass x 0.0100 +- 0.0010 m)"
    )


def test_one_law_at_many_joints_lists_some():
    many = [effect("coulomb_friction", f"j{i}", level=(0.1, 0.01, "N m")) for i in range(8)]
    text = effects.lacking(many)
    assert text.count("Coulomb") == 1 and text.count("0.100 +- 0.010 N m at j") == 6 and text.endswith(" and 2 more")


def test_an_interval_is_rounded_by_its_width():
    assert effects.spanned(0.0182916, 0.0179626, 0.0186206, "rad") == "0.01829 rad (90 %: 0.01796 to 0.01862)"
    assert effects.spanned(0.0023, 0.0014354, 0.003201, "s") == "2.3 ms (90 %: 1.4 to 3.2)"


def test_a_rival_and_a_parameter_at_its_end():
    assert effects.close_by(3.21, -0.1) == "held-out evidence differs by 3.2 nats, 0 % of the gap"
    text = effects.at_bound(Bound("at most", 0.5), "N m")
    assert text.startswith("ends at 0.5 N m, the smallest value tried: at most")


def test_a_servos_gain_is_a_multiple_of_the_models():
    found = effect("servo_stiffness", "servo", 0.99, factor=(0.35, 0.0065, ""))
    assert effects.wrong(found) == "the servo stiffness (kp) at servo is 0.3500 +- 0.0065 times the model's"


def test_the_shape_of_an_amount_that_may_be_none_is_no_number_of_the_head():
    """The Stribeck speed was printed beside an excess of 0.09 +- 0.18 N m, which was left out."""
    numbers = {"level": (0.2, 0.003, "N m"), "excess": (0.09, 0.18, "N m"), "speed": (0.047, 0.013, "rad/s")}
    assert "speed" not in numbered(effect("stribeck_friction", "shoulder", **numbers))
    numbers |= {"excess": (0.09, 0.01, "N m")}
    assert "speed 0.047" in numbered(effect("stribeck_friction", "shoulder", **numbers))


def test_a_headline_leaves_optional_numbers_to_the_table():
    soft = {"level": (0.1497, 0.0087, "N m"), "relaxation": (0.0139, 0.001, "s")}
    assert numbered(effect("coulomb_friction", "elbow", **soft)) == "Coulomb friction of 0.1497 +- 0.0087 N m at elbow"
    both = [effect("coulomb_friction", where, **soft) for where in ("elbow", "hip")]
    assert effects.lacking(both).endswith("0.1497 +- 0.0087 N m at elbow and 0.1497 +- 0.0087 N m at hip")


def test_a_number_is_called_wrong_only_where_it_clearly_is():
    sure, unsure = (effect("actuator_gain", "drive", gain=(*own, "")) for own in ((0.7, 0.04), (1.05, 0.55)))
    assert effects.wrong(sure) == "the actuator gain at drive is 0.700 +- 0.040, not 1"
    assert effects.wrong(unsure) == "the actuator gain at drive is uncertain (1.05 +- 0.55; the model has 1)"


def test_the_factor_between_degrees_and_radians_is_pointed_out():
    joints = [Joint("hip", "ctrl", 1.1, 0.1, 0.1, 0.1), Joint("knee", "ctrl", 55.4, 0.98, 0.9, 0.9)]
    (line,) = notes.first_look(Look(joints=tuple(joints)))
    assert "knee differs by the factor of rad to deg" in line and "hip differs" not in line
    of_any_unit = [dataclasses.replace(j, source="effort") for j in joints]
    assert "rad to deg" not in notes.first_look(Look(joints=tuple(of_any_unit)))[0]
