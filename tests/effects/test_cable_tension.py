"""Cables that are slack up to an angle: by hand, against tendons of MuJoCo C, and against a spring."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from tests.effects.truths import edited, moved, physics, recovered, truth

XML = """
<mujoco>
  <compiler angle="{angle}"/>
  <option timestep="0.005"/>
  <worldbody><body>
    <joint name="a" axis="0 1 0" damping=".13"/>
    <geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1" contype="0"/>
    <body pos=".5 0 0">
      <joint name="b" axis="0 1 0" damping=".07"/>
      <geom type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass=".5" contype="0"/>
    </body>
  </body></worldbody>
  <actuator><motor joint="a"/><motor joint="b"/></actuator>
</mujoco>
"""
ARM = XML.format(angle="radian")
T = 0.02 * np.arange(60)[:, None]
WAVES = np.concatenate([4 * np.sin(5 * T), 1.5 * np.sin(9 * T + 1)], axis=1)
SPEED = [1.0, -2.0]
CABLES = {"a": {"forward": 9.0, "backward": 0.0, "taut": 0.4}, "b": {"forward": 2.0, "backward": 5.0, "taut": -0.3}}
ROWS = 8


def stack():
    return [make("cable_tension", where=("a", "b"))]


WORLD = physics(ARM, stack())


def run(thetas):
    return moved(WORLD, [*thetas, *[[0.0] * 6] * (ROWS - len(thetas))], WAVES, qvel=SPEED)[: len(thetas)]


def values_of(cables):
    return [x for joint in cables.values() for x in joint.values()]


@pytest.mark.parametrize("angle", ["radian", "degree"])
@pytest.mark.slow
@pytest.mark.ci
def test_is_a_tendon_with_slack(angle):
    effect = make("cable_tension", where=("a", "b"))
    want = truth(edited(XML.format(angle=angle), effect, CABLES), WAVES, qvel=SPEED)
    (q,) = run([values_of(CABLES)])
    np.testing.assert_allclose(q, want, atol=1e-4)
    assert np.abs(want - truth(mujoco.MjModel.from_xml_string(ARM), WAVES, qvel=SPEED)).max() > 0.1


def test_one_side_alone_by_hand():
    """-k (q - q0) beyond q0, nothing before: pushed by hand in MuJoCo C."""

    def push(model, data):
        data.qfrc_applied[:] = [-9.0 * max(data.qpos[0] - 0.4, 0.0), 5.0 * max(-0.3 - data.qpos[1], 0.0)]

    want = truth(mujoco.MjModel.from_xml_string(ARM), WAVES, qvel=SPEED, push=push)
    (q,) = run([[9.0, 0.0, 0.4, 0.0, 5.0, -0.3]])
    np.testing.assert_allclose(q, want, atol=1e-4)
    assert want[:, 0].max() > 0.5 and want[:, 1].min() < -0.5


@pytest.mark.slow
@pytest.mark.ci
def test_equal_sides_are_a_spring():
    spring = physics(ARM, [make("joint_spring", where="a")])
    want = moved(spring, [[6.0, 0.0, -0.4]], WAVES, qvel=SPEED)[0]
    (q,) = run([[6.0, 6.0, -0.4, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(q, want, atol=1e-5)


@pytest.mark.slow
@pytest.mark.ci
def test_neutral_changes_no_bit_beside_another_effect():
    drag = make("viscous_friction", where="a")
    alone = moved(physics(ARM, [drag]), [[0.5]], WAVES)
    beside = moved(physics(ARM, [drag, *stack()]), [[0.5, 0, 0, 0.7, 0, 0, -0.2]], WAVES)
    np.testing.assert_array_equal(beside, alone)


def test_recovers_what_mujoco_was_given():
    effect = make("cable_tension", where=("a",))
    real = truth(edited(ARM, effect, {"a": CABLES["a"]}), WAVES, qvel=SPEED)
    found = recovered(
        lambda points: run(np.pad(points, ((0, 0), (0, 3)))), real, [5.0, 1.0, 0.2], [1.0, 1.0, 0.1], ROWS
    )
    np.testing.assert_allclose(found, [9.0, 0.0, 0.4], atol=0.03)


def test_a_cable_that_is_not_there_is_not_written():
    spec = mujoco.MjSpec.from_string(ARM)
    assert make("cable_tension", where="a").edit(spec, {"a": CABLES["a"]}) is None
    model = spec.compile()
    assert [model.tendon(i).name for i in range(model.ntendon)] == ["a.cable_tension.forward"]
