"""What was proposed before the search is begun with, as far as so many laws go; what drives have is one of them."""

from types import SimpleNamespace

import pytest

from bayessim_mjx.diagnosis.fitting.candidates import Candidate, Coordinate
from bayessim_mjx.diagnosis.selection.fits import Fits


def screened(labels):
    found = []
    for i, label in enumerate(labels):
        effect, where = label.split("@")
        coordinate = Coordinate(f"{where}.{effect}.amount", (i,), 0.0, 0.0, 1.0)
        found.append(SimpleNamespace(candidate=Candidate(effect, where, "joint", (coordinate,), (False,)), start=None))
    return found


@pytest.mark.parametrize(
    ("together", "begun"),
    [
        (("coulomb_friction@a", "actuator_gain@a", "joint_spring@a", "payload@a"), {0, 1, 2}),
        (("coulomb_friction@a", "coulomb_friction@b", "payload@a"), {0, 1, 2}),
        (("coulomb_friction@a", "viscous_friction@a", "armature@b", "payload@a", "joint_spring@a", "gravity_tilt@w"),
         {0, 1, 2, 3, 4}),
        (("coulomb_friction@a",), set()),  # a single effect is fitted anyway
    ],
)  # fmt: skip
def test_the_first_laws_that_were_proposed_are_begun_with(together, begun):
    settings = SimpleNamespace(together=together)
    pool = SimpleNamespace(candidates=(), screened=screened(together), settings=settings)
    found = Fits(pool, lambda *_: None).proposed(3)
    assert found == ([frozenset(together[i] for i in begun)] if begun else [])
