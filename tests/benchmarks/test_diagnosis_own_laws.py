"""Laws that differ from the library's: what each of them is known to do."""

import math

import numpy as np
import own_laws as laws
import pytest
from systems import SYSTEMS

from bayessim_mjx.blind.reality.menu import CAUSES
from bayessim_mjx.blind.reality.plant import Plant, scales_of

ROBOT = SYSTEMS["pendulum"]


@pytest.fixture(scope="module")
def scales():
    plain = Plant(ROBOT, {})
    return scales_of(plain, [ROBOT.record(plain, i, 0, noise=False) for i in ROBOT.pushed])


def lawful(name: str, scales, size: float = 0.0, **shape: float):
    where = "hinge_motor" if CAUSES[name].kind == "actuator" else "hinge"
    cause = CAUSES[name](where, scales, np.random.default_rng(0), size)
    vars(cause).update(shape)
    return laws.lawful(cause)


def test_a_law_keeps_what_was_drawn_and_other_causes_are_as_they_were(scales):
    drawn = CAUSES["stribeck_friction"]("hinge", scales, np.random.default_rng(3), 0.2)
    own = laws.lawful(drawn)
    assert type(own) is laws.OwnStribeck and own.parameters() == drawn.parameters()
    gain = CAUSES["actuator_gain"]("hinge_motor", scales, np.random.default_rng(0))
    assert laws.lawful(gain) is gain


def test_bristles_bend_before_dry_friction_slips(scales):
    """Under a force that grows slowly to half of the level: z' = w (1 - z / BEND), so q = BEND ln 2."""
    cause = lawful("coulomb_friction", scales, 0.4)
    plant = Plant(ROBOT, {}, [cause])
    plant.model.opt.gravity[:] = 0
    plant.reset(np.zeros(1), np.zeros(1), np.zeros(1))
    for force in np.linspace(0, 0.2, 200):
        plant.advance(np.array([force]))
    at, _ = plant.link()
    assert at[0] == pytest.approx(laws.BEND * math.log(2), rel=0.02)
    for _ in range(100):
        plant.advance(np.array([0.44]))  # a tenth above the level: it slips
    assert plant.link()[0][0] > 10 * laws.BEND


def test_stribecks_level_falls_by_e_within_its_speed(scales):
    cause = lawful("stribeck_friction", scales, 0.2, ratio=2.0, speed=0.5)
    plant = Plant(ROBOT, {}, [cause])
    assert [cause.level(plant, w) for w in (0.0, -0.5, 50.0)] == pytest.approx([0.4, 0.2 * (1 + 1 / math.e), 0.2])


def test_flanks_hold_the_link_within_the_gap_and_throw_it_back_slower(scales):
    cause = lawful("backlash", scales, 0.05)
    plant = Plant(ROBOT, {}, [cause])
    plant.model.opt.gravity[:] = 0
    plant.model.dof_damping[:] = 0
    play = plant.model.joint("hinge/play")
    plant.reset(np.zeros(1), np.zeros(1), np.zeros(1))
    plant.data.qvel[play.dofadr[0]] = 0.5  # the link goes towards a flank of a rotor at rest
    seen, speeds = [], []
    for _ in range(400):
        plant.advance(np.zeros(1), 1)
        seen.append(plant.data.qpos[play.qposadr[0]])
        speeds.append(plant.data.qvel[play.dofadr[0]])
    assert max(seen) < 0.026 and min(seen) > -0.026 and max(seen) > 0.025
    # Hunt and Crossley: 1 - LOSS v of the speed, to first order
    assert speeds[0] == pytest.approx(0.5) and min(speeds) == pytest.approx(-0.5 * (1 - laws.LOSS * 0.5), abs=0.02)


def test_a_gear_hardens_with_its_torque(scales):
    size = 0.02
    cause = lawful("joint_elasticity", scales, size)
    plant = Plant(ROBOT, {}, [cause])
    gear = plant.model.joint("hinge/play").id
    stiffness, cubic = plant.model.jnt_stiffness[gear], plant.model.jnt_stiffnesspoly[gear, 1]
    assert stiffness == pytest.approx(1 / size)
    wound = scales.force["hinge"] * size
    assert stiffness + 3 * cubic * wound**2 == pytest.approx((1 + laws.HARDENING) * stiffness)


def test_cogging_has_a_second_harmonic(scales):
    cause = lawful("cogging", scales, 0.3, count=6, phase=0.4)
    plant, force = Plant(ROBOT, {}, [cause]), []
    plant.reset(np.zeros(1), np.zeros(1), np.zeros(1))
    for q in np.linspace(0, 2 * np.pi, 720, endpoint=False):
        plant.data.qpos[0], plant.data.qfrc_applied[0] = q, 0.0
        cause.force(plant)
        force.append(plant.data.qfrc_applied[0])
    size = 2 * np.abs(np.fft.rfft(force)) / 720
    assert size[6] == pytest.approx(0.3) and size[12] == pytest.approx(laws.SECOND * 0.3)


def test_laws_take_turns_and_a_double_has_two_causes_that_a_joint_can_have():
    singles = [laws.turn("single", "leg", seed, ("payload",))[0] for seed in range(7)]
    assert sorted(singles) == sorted(laws.LAWS)
    at = next(s for s in range(7) if laws.turn("double", "leg", s, ("payload", "armature"))[0] == "backlash")
    assert laws.turn("double", "leg", at, ("joint_elasticity", "payload")) == ("backlash", "payload")
    assert laws.turn("double", "leg", at, ("backlash", "armature")) == ("backlash", "armature")
    assert laws.turn("null", "leg", at, ()) == () and laws.turn("unknown", "leg", at, ("u",)) == ("u",)
