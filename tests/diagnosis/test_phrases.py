"""Facts in words: sentences known beforehand."""

from bayessim_mjx.diagnosis import phrases

UNITS = {"speed": "rad/s", "position": "rad", "direction": "", "time since reversal": "s", "load": "N m"}


def test_regions_tell_the_tighter_of_nested_limits():
    assert phrases.region([], UNITS) == "everywhere"
    nested = [("speed", False, 0.5), ("direction", True, 0.0), ("speed", False, 0.2)]
    assert phrases.region(nested, UNITS) == "speed below 0.2 rad/s, moving forward"
    both = [("position", True, -0.1), ("position", False, 0.4), ("time since reversal", False, 0.05)]
    assert phrases.region(both, UNITS) == "position between -0.1 and 0.4 rad, within 0.05 s after a reversal"
    assert phrases.region([("load", True, 1.0), ("load", True, 2.0)], UNITS) == "gravity load above 2 N m"


def test_a_sign_stands_in_the_words_where_they_have_a_place_for_it():
    linear = phrases.SIGNATURES["odd and even in speed"].terms["linear"]
    assert phrases.signed(-0.3, -0.4, -0.2, "N m/(rad/s)", linear) == (
        "0.3 [0.2, 0.4] N m/(rad/s) with the motion, linear in speed"
    )
    assert phrases.signed(-0.3, -0.4, -0.2, "s", "times the speed") == "-0.3 [-0.4, -0.2] s times the speed"
    assert phrases.missing_force(-0.06, "N m", along=True) == "0.06 N m against the motion"
    assert phrases.missing_force(-0.06, "N m", along=False) == "-0.06 N m"


def test_why_a_model_is_a_rival_and_a_parameter_at_its_end():
    assert phrases.close_by(3.21, -0.1) == "held-out evidence differs by 3.2 nats, 0 % of the gap"
    told = phrases.farthest_tried(0.5, " N m", "at most")
    assert told.startswith("ends at 0.5 N m, the smallest value tried: at most")
