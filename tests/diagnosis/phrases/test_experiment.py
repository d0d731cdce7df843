"""The next experiment in words: sentences known beforehand."""

from bayessim_mjx.diagnosis.phrases import advice as phrases
from bayessim_mjx.diagnosis.phrases.effects import all_of


def test_why_an_experiment_is_proposed():
    titles = [all_of(own) for own in ([("load_friction", "elbow"), ("payload", "all")], [], [("x", "y")])]
    assert titles == [
        "load-dependent friction at elbow and extra payload at all bodies",
        "the known parameters alone",
        "x at y",
    ]
    action = phrases.run_experiment("chirp on elbow", 9.96)
    assert action == "run a chirp on elbow for 10 s" and phrases.run_experiment("release", 3.0).startswith(
        "run release"
    )
    assert phrases.tells_apart(action, titles, 4.04, True, 10.0) == (
        f"{action}: separates {titles[0]} from {titles[1]}, or {titles[2]}, expected evidence 4.0 nats; "
        "repeat it 3 times for a decision"
    )
    text = phrases.tells_apart(action, titles[:2], 25.2, False, 10.0)
    assert text == f"{action}: confirms {titles[0]} against {titles[1]}, expected evidence 25 nats"
    text = phrases.separates_nobody(titles[:2], "release", 0.02, "more")
    assert text.endswith("(the best, release, is expected to give 0.0 nats); these would: more")
    assert phrases.sharpens(action, "mass", 0.2, 0.05) == (
        f"{action}: it should divide the standard deviation of mass by 4"
    )
    assert phrases.sharpens_little("release", "mass", 0.2, 0.16) == (
        "no experiment of the menu adds much; the best, release, leaves 80 % of the standard deviation of mass"
    )
    text = phrases.sharpens_little("release", "mass", 0.2, 0.199, 0.98)
    assert text == "no experiment sharpens mass: 98 % of its standard deviation allows for other simulators"
    assert phrases.separating(["unheard_of"]) == "a known payload, two mount orientations, or a measured effort"
