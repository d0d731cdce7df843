"""Which effects are tried: all that are on offer, those that are named, and what is told of the others."""

import pytest

from bayessim_mjx import effects
from bayessim_mjx.diagnosis.fitting.candidates import kinds_of
from bayessim_mjx.diagnosis.phrases.effects import not_on_offer
from bayessim_mjx.errors import UserError

ON_REQUEST = {"cable_tension", "ground_height", "lugre_friction"}


def names(asked):
    return [kind.name for kind in kinds_of(asked)]


def test_all_are_those_on_offer():
    random = {name for name in effects.names() if effects.load(name).random}
    assert set(names("all")) == set(effects.names()) - ON_REQUEST - random


def test_others_may_be_named_beside_all_and_nothing_is_tried_twice():
    assert names(["all", "lugre_friction", "backlash"]) == [*names("all")[:-1], "lugre_friction", "actuator_delay"]
    assert names(["lugre_friction", effects.load("backlash")]) == ["lugre_friction", "backlash"]
    with pytest.raises(UserError, match="no effect 'lugre'"):
        kinds_of(["all", "lugre"])


def test_a_pure_delay_acts_on_commands_behind_all_others():
    assert names("all")[-1] == names(["actuator_delay", "rate_limit"])[-1] == "actuator_delay"


def test_what_was_not_on_offer_is_told():
    nouns = "cable tension, ground at another height and friction with presliding (LuGre)"
    told = f"Not tried because not named: {nouns}"
    assert not_on_offer(["backlash"]) == f"{told} (--effects all,cable_tension,ground_height,lugre_friction)."
    assert not_on_offer(ON_REQUEST) == ""
