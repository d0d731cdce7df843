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


def test_why_an_experiment_is_proposed():
    titles = [phrases.model_title(own) for own in ([("load_friction", "elbow"), ("payload", "all")], [], [("x", "y")])]
    assert titles == [
        "load-dependent friction at elbow and extra payload at all bodies",
        "the known parameters alone",
        "x at y",
    ]
    action = phrases.run_experiment("chirp on elbow", 9.96)
    assert action == "run a chirp on elbow for 10 s" and phrases.run_experiment("release", 3.0).startswith(
        "run release"
    )
    assert phrases.tells_apart(action, titles, 4.04, contested=True) == (
        f"{action}: separates {titles[0]} from {titles[1]} and {titles[2]}, expected evidence 4.0 nats; "
        "repeat it 3 times for a decision"
    )
    told = phrases.tells_apart(action, titles[:2], 25.2, contested=False)
    assert told == f"{action}: makes sure of {titles[0]} against {titles[1]}, expected evidence 25 nats"
    told = phrases.separates_nobody(titles[:2], "release", 0.02, "more")
    assert told.endswith("(the best, release, is expected to give 0.0 nats); what would: more")
    assert (
        phrases.sharpens(action, "mass", 0.2, 0.05, "")
        == f"{action}: sharpens mass, standard deviation from 0.2 to 0.05"
    )
    assert phrases.sharpens_little("release", "mass", 0.2, 0.19, "kg") == (
        "none would tell much more; the best, release: sharpens mass, standard deviation from 0.2 to 0.19 kg"
    )
    assert phrases.separating(["unheard_of"]) == "a known payload, two mount orientations, or a measured effort"


def test_why_a_model_is_a_rival_and_a_parameter_at_its_end():
    assert phrases.close_by(3.21, -0.1) == "held-out evidence differs by 3.2 nats, 0 % of the gap"
    told = phrases.at_bound("at most", 0.5, "N m", physical=False)
    assert told.startswith("ends at 0.5 N m, the smallest value tried: at most")
