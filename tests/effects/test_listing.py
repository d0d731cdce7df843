"""Names of effects for users: the list of the command, and what an unknown name may mean."""

import pytest

from bayessim_mjx import diagnose, effects
from bayessim_mjx.errors import UserError


def test_the_command_lists_every_effect_with_its_place(capsys: pytest.CaptureFixture) -> None:
    assert diagnose.main(["--list_effects"]) == 0
    rows = [line.split(maxsplit=2) for line in capsys.readouterr().out.splitlines()]
    assert rows[0] == ["effect", "place", "meaning"] and [row[0] for row in rows[1:]] == effects.names()
    assert all(row[1] == effects.load(row[0]).kind and row[2] for row in rows[1:])
    said = {row[0]: row[2] for row in rows}
    assert "only where --effects names it" in said["lugre_friction"] and "training" in said["sensor_packets"]


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        ("gain", "actuator_gain"),
        ("motor_gain", "actuator_gain"),
        ("friction", "coulomb_friction"),
        ("backlash_gap", "backlash"),
        ("latency", "actuator_delay"),
        ("Coulomb Friction", "coulomb_friction"),
        ("actuator_dely", "actuator_delay"),
    ],
)
def test_an_unknown_name_suggests_what_is_meant_first(given: str, meant: str) -> None:
    with pytest.raises(UserError, match=rf"did you mean {meant}\b.*`bayessim-mjx diagnose --list_effects` lists all"):
        effects.load(given)


def test_the_usual_meanings_exist() -> None:
    assert {*effects.USUAL.values()} <= {*effects.names()}
