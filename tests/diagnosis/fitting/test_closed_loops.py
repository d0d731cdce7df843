"""Joints without an encoder that an equality constraint binds: the constraint tells their motion."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting import candidates, observation, robot, scales
from bayessim_mjx.logs import read_logs
from bayessim_mjx.physics import control_step
from bayessim_mjx.physics.loops import Loops

FOUR_BAR = """
<mujoco><option timestep="0.001" integrator="implicitfast"/>
  <default><geom type="capsule" size="0.012" contype="0" conaffinity="0"/><joint axis="0 1 0" damping="0.01"/></default>
  <worldbody>
    <body><joint name="crank" damping="0.05" armature="0.01"/><geom fromto="0 0 0 0 0 0.15" mass="0.3"/>
      <body name="coupler" pos="0 0 0.15"><joint name="coupler"/><geom fromto="0 0 0 0.3 0 0.05" mass="0.3"/></body>
    </body>
    <body name="rocker" pos="0.3 0 0"><joint name="rocker"/><geom fromto="0 0 0 0 0 0.2" mass="0.3"/></body>
  </worldbody>
  <equality><connect body1="coupler" body2="rocker" anchor="0.3 0 0.05" solref="0.004 1"/></equality>
  <actuator><motor name="drive" joint="crank"/></actuator></mujoco>
"""
MIMIC = """
<mujoco><option timestep="0.001" integrator="implicitfast"/>
  <default><geom type="capsule" size="0.012" contype="0" conaffinity="0"/><joint axis="0 1 0" damping="0.05"/></default>
  <worldbody>
    <body><joint name="left" armature=".01"/><geom fromto="0 0 0 0 0 -0.15" mass="0.1"/></body>
    <body pos=".1 0 0"><joint name="right" armature=".01"/><geom fromto="0 0 0 0 0 -0.15" mass="0.1"/></body>
  </worldbody>
  <equality><joint joint1="right" joint2="left" polycoef="0 -1.5 0 0 0" solref="0.004 1"/></equality>
  <actuator><motor name="drive" joint="left"/></actuator></mujoco>
"""
NOISE, PERIOD, ROWS = 5e-4, 0.01, 200


def recorded(folder, xml, joint):
    """(model, the log of one encoder with the rest estimated): a motion of the model itself."""
    model = mujoco.MjModel.from_xml_string(xml)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    rows = []
    for k in range(ROWS):
        data.ctrl[0] = 0.4 * np.sin(2 * np.pi * 0.7 * k * PERIOD) - 3 * data.joint(joint).qpos[0]
        rows.append([k * PERIOD, data.ctrl[0], data.joint(joint).qpos[0] + NOISE * rng.normal()])
        mujoco.mj_step(model, data, round(PERIOD / model.opt.timestep))
    np.savetxt(folder / "a.csv", rows, delimiter=",", header=f"time,ctrl:drive,qpos:{joint}", comments="")
    with pytest.warns(UserWarning, match="this motion is estimated from the measurements"):
        (log,) = read_logs([folder / "a.csv"], model, partial=True)
    (done,), _ = observation.completed([log], model)
    return model, done


def rocker_of(crank):
    """Angle of the rocker by the circles about both ends (law of cosines), as it moves on from 0."""
    pin = 0.15 * np.stack([np.sin(crank), np.cos(crank)], -1)  # where the coupler hangs: (x, z)
    reach, length = np.hypot(0.3, 0.05), 0.2
    way = pin - [0.3, 0]
    far = np.linalg.norm(way, axis=-1)
    inner = np.arccos((far**2 + length**2 - reach**2) / (2 * far * length))
    return np.arctan2(way[..., 0], way[..., 1]) + inner


def test_the_loop_of_a_four_bar_tells_its_other_angles(tmp_path, monkeypatch):
    """By its geometry: no model of masses and friction has to be right for it."""
    monkeypatch.setattr(observation, "Stepper", None)
    model, log = recorded(tmp_path, FOUR_BAR, "crank")
    crank, rocker = log.qpos[:, 0], log.qpos[:, 2]
    assert rocker_of(np.zeros(())) == pytest.approx(0, abs=1e-9)
    assert np.ptp(rocker) > 0.05  # it moves
    slope = np.abs(np.gradient(rocker_of(np.linspace(-0.3, 0.3, 61)), 0.01)).max()
    assert np.abs(rocker - rocker_of(crank)).max() < 5 * NOISE * max(slope, 1)
    assert log.sigma_qpos[2] < 2 * NOISE


def test_a_finger_follows_its_twin(tmp_path):
    model, log = recorded(tmp_path, MIMIC, "left")
    left, right = log.qpos.T
    assert np.abs(right + 1.5 * left).max() < 5 * 1.5 * NOISE
    assert np.corrcoef(log.qvel.T)[0, 1] < -0.99


def test_forces_of_a_loop_are_as_large_as_its_drive_makes_them(tmp_path):
    """What noise breaks of a loop its stiff constraint would answer with a hundred times as much."""
    model, log = recorded(tmp_path, MIMIC, "left")
    drive = np.percentile(np.abs(log.ctrl), 98)
    left, right = scales.measure(model, [log]).force
    assert 0.98 * drive <= left < 1.5 * drive  # of a hundred rows a log
    assert right == pytest.approx(left / 1.5, rel=0.05)  # at 1.5 times the speed: the same power


def test_joints_outside_of_a_loop_keep_their_own_forces(tmp_path):
    """A joint that hangs beside the loop, and hardly moves."""
    beside = '<body pos="0 0 1"><joint name="beside"/><geom fromto="0 0 0 0 0 -0.1" mass="0.01"/></body></worldbody>'
    model = mujoco.MjModel.from_xml_string(MIMIC.replace("</worldbody>", beside))
    force, speed = np.array([1.0, 0.1, 0.01]), np.array([1.0, 2.0, 0.1])
    np.testing.assert_array_equal(scales.bound(model, [model.qpos0]), [0, 0, 1])
    np.testing.assert_allclose(scales.passed_on(force, speed, np.array([0, 0, 1])), [1.0, 0.5, 0.01])


def test_sensors_are_tried_where_something_reads_them(tmp_path):
    """An encoder that is neither logged nor fed back changes nothing; dry friction acts at all joints of the loop."""
    model, log = recorded(tmp_path, FOUR_BAR, "crank")
    kinds = candidates.kinds_of(["sensor_gain", "joint_offset", "sensor_delay", "coulomb_friction"])
    where = {e.name: e.places() for e in candidates.stack(kinds, scales.measure(model, [log]))[0]}
    everywhere = ("crank", "coupler", "rocker")
    assert where == dict.fromkeys(("sensor_gain", "joint_offset", "sensor_delay"), ("crank",)) | {
        "coulomb_friction": everywhere
    }
    servo = FOUR_BAR.replace("</actuator>", '<position name="fed" joint="rocker" kp="1"/></actuator>')
    assert list(scales.read_by(mujoco.MjModel.from_xml_string(servo), [], {})) == [False, False, True]


def test_joints_that_move_as_one_are_one_place_for_forces(tmp_path):
    """At 1.5 times the speed friction of a twin is that of the finger, larger: named where the encoder is."""
    model, log = recorded(tmp_path, MIMIC, "left")
    found = scales.measure(model, [log])
    assert found.follows == {1: 0}
    kinds = candidates.kinds_of(["coulomb_friction", "joint_offset"])
    assert [e.places() for e in candidates.stack(kinds, found)[0]] == [("left",), ("left",)]
    bar = mujoco.MjModel.from_xml_string(FOUR_BAR)
    crank, bound = np.arange(3) < 1, Loops(bar)
    poses = np.array([bound.closed(np.array([x, 0, 0]), crank) for x in (-0.2, 0.0, 0.2)])
    assert bound.followers(poses, crank) == {}


@pytest.mark.slow
def test_a_loop_needs_few_rounds_of_the_solver(tmp_path):
    """The same motion as with all rounds, dry friction at every joint included."""
    model, log = recorded(tmp_path, FOUR_BAR, "crank")
    model.dof_frictionloss[:] = 0.05
    few = robot.pruned(robot.robot_of(model), [log], PERIOD)
    assert few.rounds == robot.ROUNDS
    ends = [driven(own.physics(PERIOD)) for own in (few, dataclasses.replace(few, rounds=None))]
    np.testing.assert_allclose(*ends, atol=2e-6)
    assert np.ptp(ends[0][:, 0]) > 0.3


def driven(physics):
    """Its way in half a second, driven to and fro."""
    world = physics.unseen(jnp.asarray(physics.space.nominal, jnp.float32), jnp.zeros(3), jnp.zeros(3))
    step = jax.jit(lambda w, u: control_step(physics, w, jnp.full((physics.substeps, 1), u))[0])
    way = []
    for k in range(50):
        world = step(world, 0.6 * np.sin(2 * np.pi * k / 30))
        way.append(world.qpos)
    return np.asarray(way)
