"""A model with dry friction: too much of it is a known parameter that is off, too little is a missing effect."""

import pytest

from bayessim_mjx.diagnosis import run
from bayessim_mjx.diagnosis.fitting import robot
from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.summary import assemble
from tests.diagnosis.pendulums import ARMATURE, DAMPING, MASS, MODEL, STEP, recorded

RUBS = ("coulomb_friction", "viscous_friction")
ENOUGH = {"count": 4, "seconds": 3.0}


def rubbing(folder, level: float) -> robot.Robot:
    (folder / "pendulum.xml").write_text(MODEL % (STEP, "Euler", DAMPING, ARMATURE, level, MASS))
    return robot.of_file(folder / "pendulum.xml")


def test_dry_friction_is_a_known_parameter_that_may_be_much_less(tmp_path):
    space = rubbing(tmp_path, 0.08).space
    assert "hinge_friction_mult" in space.names
    own = dict(zip(space.names, zip(space.low, space.high, strict=True), strict=True))
    assert own["hinge_friction_mult"] == pytest.approx((0.2, 1.2)) and own["link_mass_mult"] == pytest.approx(
        (0.3, 2.0)
    )


def diagnosed(folder, model: float, real: float):
    needed = [s for s in run.STAGES if not s.optional]
    logs = recorded(friction=real, **ENOUGH)
    return assemble.diagnosis_of(run.investigate(rubbing(folder, model), logs, Request(RUBS), stages=needed))


@pytest.mark.slow
@pytest.mark.ci
def test_too_much_of_it_is_recalibrated(tmp_path):
    found = diagnosed(tmp_path, 0.08, 0.04)
    assert found.verdict == "parameters" and not found.effects
    assert found.parameters["hinge_friction_mult"]["mean"] == pytest.approx(0.5, rel=0.05)


@pytest.mark.slow
@pytest.mark.ci
def test_too_little_of_it_is_a_missing_effect(tmp_path):
    found = diagnosed(tmp_path, 0.04, 0.08)
    (effect,) = found.effects
    level = effect.parameters["level"]
    both = 0.04 * found.parameters["hinge_friction_mult"]["mean"] + level.mean
    # as soft as MuJoCo's, the effect does what the parameter does: their sum is known, and each alone as well as the
    # data sheet, 2 % of .04 at best (f33fed92 inferred more than .01 on one machine, and .0036 on another)
    assert effect.name == "coulomb_friction" and both == pytest.approx(0.08, abs=level.sd)
    assert level.sd > 0.02 * 0.04 and level.mean == pytest.approx(0.04, abs=2 * level.sd)
    assert found.gap.with_effects < 1.1
