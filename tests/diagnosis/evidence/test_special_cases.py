"""A special case begins as large as it is in the effect that contains it."""

from dataclasses import replace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.evidence.laws import neutral_beyond, related, special_case
from bayessim_mjx.diagnosis.evidence.search import as_large
from bayessim_mjx.diagnosis.fitting.candidates import Candidate, Coordinate


def candidate(effect, *numbers, where="place", kind="joint"):
    coordinates = tuple(
        Coordinate(f"place.{effect}.{name}", (i,), 0.0, 0.0, high, unit=unit)
        for i, (name, high, unit) in enumerate(numbers)
    )
    return Candidate(effect, where, kind, coordinates, np.zeros(len(numbers), bool), np.zeros((1, len(numbers))))


STRIBECK = candidate("stribeck_friction", ("level", 2.0, "N m"), ("excess", 2.0, "N m"), ("speed", 1.0, "rad/s"))


@pytest.mark.parametrize(("high", "start"), [(2.0, 0.7), (0.5, 0.5)])
def test_by_units_in_their_order_and_within_the_range(high, start):
    coulomb = candidate("coulomb_friction", ("level", high, "N m"))
    (found,) = as_large(coulomb, STRIBECK, np.array([0.7, 0.2, 0.1]))
    assert found == pytest.approx([start])


def test_a_law_that_contains_another_begins_as_that_one():
    """Friction by direction begins with the level of Coulomb's in both; what has no partner is neutral."""
    coulomb = candidate("coulomb_friction", ("level", 2.0, "N m"))
    numbers = [("forward", 2.0, "N m"), ("backward", 2.0, "N m"), ("viscous", 1.0, "N m s/rad")]
    (found,) = as_large(candidate("asymmetric_friction", *numbers), coulomb, np.array([0.7]))
    assert found == pytest.approx([0.7, 0.7, 0.0])
    (found,) = as_large(candidate("asymmetric_friction", *numbers), STRIBECK, np.array([0.7, 0.2, 0.1]))
    assert found == pytest.approx([0.7, 0.2, 0.0])
    assert as_large(candidate("quadratic_drag", ("coefficient", 1.0, "N m s^2/rad^2")), STRIBECK, np.zeros(3)) == ()


def test_a_tied_law_has_each_place_as_a_special_case():
    """A limit of all motors that one of them reaches is that one's."""
    tied, one = (candidate("stribeck_friction", where=where) for where in ("all", "elbow"))
    coulomb = candidate("coulomb_friction", where="elbow")
    assert special_case(one, tied) and special_case(coulomb, tied) and special_case(coulomb, one)
    assert not special_case(tied, one) and not special_case(tied, tied) and not special_case(one, one)
    assert not special_case(candidate("coulomb_friction", where="wrist"), one)
    assert not special_case(candidate("quadratic_drag", where="elbow"), tied)


def test_a_payload_and_a_wrong_inertia_of_one_body_are_tried_in_each_others_place():
    payload, inertia = (candidate(n, where="lower", kind="body") for n in ("payload", "inertial_parameters"))
    assert related(payload, inertia) and related(inertia, payload)
    upper = candidate("inertial_parameters", where="upper", kind="body")
    assert not related(payload, upper) and not related(payload, payload)
    assert not related(payload, candidate("armature", where="lower"))  # of a joint with the body's name
    stribeck, coulomb = (candidate(f"{n}_friction", where="lower") for n in ("stribeck", "coulomb"))
    assert related(coulomb, stribeck) and related(stribeck, coulomb) and not related(coulomb, payload)


@pytest.mark.parametrize(("excess", "one"), [(0.0, True), (0.1, False)])
def test_a_law_whose_further_numbers_are_neutral_is_its_special_case(excess, one):
    """Whatever the speed is at which an excess that is none would fall."""
    coulomb = candidate("coulomb_friction", ("level", 2.0, "N m"))
    shaped = replace(STRIBECK, shapes=np.array([False, False, True]))
    assert neutral_beyond(coulomb, shaped, np.array([0.7, excess, 0.3])) == one
    limit = candidate("actuator_saturation", ("inverse_limit", 1.0, "1/(N m)"))  # no number in common
    curve = candidate("speed_torque_limit", ("inverse_stall", 1.0, "1/(N m)"), ("inverse_speed", 1.0, "s/rad"))
    assert not neutral_beyond(limit, curve, np.zeros(2))
