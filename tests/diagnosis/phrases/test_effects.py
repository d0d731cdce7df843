"""Effects in sentences: a phrase for each law, its places listed."""

from bayessim_mjx.diagnosis.phrases import by_law, missing


def test_a_law_at_several_joints_is_one_phrase():
    named = [
        ("coulomb_friction", "hip"),
        ("actuator_delay", "all"),
        ("coulomb_friction", "knee"),
        ("coulomb_friction", "foot"),
    ]
    assert by_law(named) == [
        missing("coulomb_friction", "hip, knee and foot"),
        missing("actuator_delay", "all"),
    ]
    assert by_law(named)[0].endswith(" at hip, knee and foot")


def test_what_has_no_place_or_is_tied_stands_by_itself():
    named = [("gravity_tilt", "world"), ("coulomb_friction", "all"), ("payload", "hand")]
    assert by_law(named) == [missing(*effect) for effect in named]
    assert by_law([]) == []
