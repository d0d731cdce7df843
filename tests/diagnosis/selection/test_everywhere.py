"""One law at all joints with numbers of its own at each, on planted sums: found as one step, pruned where it is not."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis.selection import beam, everywhere
from bayessim_mjx.diagnosis.selection.criteria import Criteria
from tests.diagnosis.selection.planted import Linear, columns, law, table

JOINTS = [f"j{i}" for i in range(6)]
FRICTION = [f"friction@{j}" for j in JOINTS]


def joints(seed=0, others=6):
    """Columns of two laws at six joints and tied over them, and of unrelated effects."""
    drawn = list(columns(12 + others, seed).values())
    laws = {f"friction@{j}": drawn[i] for i, j in enumerate(JOINTS)}
    laws |= {f"damping@{j}": drawn[6 + i] for i, j in enumerate(JOINTS)}
    for name in ("friction", "damping"):
        laws[f"{name}@all"] = sum(laws[f"{name}@{j}"] for j in JOINTS)
    return laws | {f"{chr(97 + i)}@j0": drawn[12 + i] for i in range(others)}


def found(laws, amounts, seed=0, **criteria):
    fits = Linear(laws, amounts, seed, kind="joint", places=JOINTS)
    return beam.search(fits, Criteria(**criteria)), fits


@pytest.mark.parametrize("seed", range(3))
def test_friction_of_another_size_in_each_of_six_joints(seed):
    amounts = dict(zip(FRICTION, (3.0, 1.0, 2.0, 1.2, 1.5, 1.1), strict=True))
    selection, fits = found(joints(seed), amounts, seed)
    assert set(selection.answer) == set(FRICTION)
    assert fits.fitted < 200


def test_two_laws_in_every_joint():
    amounts = {f"{name}@{j}": 1.0 + 0.4 * i for i, j in enumerate(JOINTS) for name in ("friction", "damping")}
    selection, _ = found(joints(), amounts)
    assert set(selection.answer) == set(amounts)


def test_joints_that_have_none_are_not_named():
    """Of six joints three have friction: the spread model is cut back to them."""
    amounts = dict.fromkeys(FRICTION[:3], 2.0)
    assert set(found(joints(), amounts)[0].answer) == set(amounts)


def test_the_same_everywhere_is_one_effect_still():
    assert set(found(joints(), {"friction@all": 2.0})[0].answer) == {"friction@all"}


def test_one_joint_is_one_effect_still():
    assert set(found(joints(), {"friction@j2": 3.0})[0].answer) == {"friction@j2"}


def test_at_several_joints_a_law_counts_once():
    amounts = {label: 2.0 + 0.3 * i for i, label in enumerate(FRICTION)}
    assert set(found(joints(), amounts, most=2)[0].answer) == set(FRICTION)
    both = table({(): 9.0, (law("friction", "j0"), law("friction", "j1"), law("damping", "j1")): 2.0})
    assert everywhere.laws(both, frozenset(both.laws)) == 2


def test_what_is_not_in_every_joint_is_not_spread():
    bodies = [law("payload", b, kind="body") for b in ("hand", "arm")]
    alone = law("coulomb_friction", "hinge", kind="joint")
    rows = {(): 9.0, (bodies[0],): 4.0, (bodies[1],): 5.0, (alone,): 6.0}
    made, gains = table(rows), dict.fromkeys(("payload@hand", "payload@arm", "coulomb_friction@hinge"), 1.0)
    assert everywhere.spread(made, frozenset(), gains) == []


def test_what_every_link_has_is_spread():
    links = [law("inertial_parameters", b, 4, kind="body", spread=True) for b in ("hand", "arm")]
    made = table({(): 9.0, (links[0],): 4.0, (links[1],): 5.0})
    every = frozenset(c.label for c in links)
    assert [model for model, _ in everywhere.spread(made, frozenset(), dict.fromkeys(every, 1.0))] == [every]
    assert table({(): 9.0, (links[0],): 4.0}).to_dict()["laws"][0]["spread"]


def test_a_spread_model_begins_at_what_is_fitted():
    laws = [law("friction", j, kind="joint") for j in ("j0", "j1")]
    tied, other = law("friction", "all", places=("j0", "j1"), kind="joint"), law("delay", "s", kind="actuator")
    known = table({(): 9.0, (laws[0],): 4.0, (laws[1],): 5.0, (tied,): 3.0, (tied, other): 2.0, (other,): 8.0})
    every = frozenset(c.label for c in laws)
    one = everywhere.spread(known, frozenset([laws[0].label]), {})
    assert one == [(every, frozenset([laws[0].label]))]
    pair = everywhere.spread(known, frozenset([tied.label, other.label]), {})
    assert pair == [(every | {other.label}, frozenset([other.label]))]
    assert np.isfinite(known.excess(frozenset()))


def test_a_law_stands_in_the_place_of_its_special_cases():
    joints = ("j0", "j1")
    dry = [law("coulomb_friction", j, kind="joint") for j in joints]
    viscous = law("viscous_friction", "all", places=joints, kind="joint")
    special = ("coulomb_friction", "viscous_friction")
    both = [law("asymmetric_friction", j, 4, special=special, kind="joint") for j in joints]
    known = table({(): 9.0, (*dry, viscous): 3.0, (both[0],): 4.0, (both[1],): 5.0})
    key = frozenset([*(c.label for c in dry), viscous.label])
    found = everywhere.spread(known, key, {c.label: 1.0 for c in both})
    assert (frozenset(c.label for c in both), frozenset()) in found
    assert not any(
        len({known.laws[x].effect for x in model} & {"asymmetric_friction", *special}) == 3 for model, _ in found
    )
    assert not both[0].beside(dry[0]) and both[0].beside(dry[1]) and dry[0].beside(viscous)


def test_what_was_proposed_together_is_fitted_first_and_nothing_far_behind_it_goes_on():
    amounts = {f"{name}@{j}": 2.0 + 0.3 * i for i, j in enumerate(JOINTS) for name in ("friction", "damping")}

    class Proposing(Linear):
        def proposed(self, most):
            return [frozenset(amounts)]

    fits = Proposing(joints(), amounts, kind="joint", places=JOINTS)
    assert set(beam.search(fits, Criteria()).answer) == set(amounts)
    other = Linear(joints(), amounts, kind="joint", places=JOINTS)
    beam.search(other, Criteria())
    assert fits.fitted < other.fitted


def test_a_proposal_that_does_not_explain_does_not_win():
    class Misled(Linear):
        def proposed(self, most):
            return [frozenset(["a@j0", "b@j0"])]

    fits = Misled(joints(), {"friction@j2": 3.0, "c@j0": 3.0}, kind="joint", places=JOINTS)
    assert set(beam.search(fits, Criteria()).answer) == {"friction@j2", "c@j0"}
