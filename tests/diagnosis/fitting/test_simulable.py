"""What the simulation does without: limits that the logs never come near, rounds of the solver that change nothing."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting import robot
from bayessim_mjx.diagnosis.fitting.robot import robot_of
from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.setup import prepare
from bayessim_mjx.logs import Channels, Log
from bayessim_mjx.physics import control_step
from tests.diagnosis.pendulums import nominal, recorded

ARM = """<mujoco><option timestep="0.005"/><compiler angle="radian"/><default>
  <geom size=".1" contype="0" conaffinity="0"/></default><worldbody>
  <body><joint name="a" axis="0 1 0" range="-2 2"/><geom pos="0 0 -.3" mass="1"/>
    <body pos="0 0 -.5"><joint name="b" axis="0 1 0" range="-1 1"/><geom mass="1"/>
      <body pos="0 0 -.5"><joint name="c" axis="0 1 0"/><geom mass="1"/></body></body></body>
</worldbody><actuator><motor joint="a"/><motor joint="b"/><motor joint="c"/></actuator></mujoco>"""


def log(model, *spans):
    """Each joint to and fro between its ends."""
    time = np.arange(0, 2, 0.01)
    q = np.stack([low + (high - low) * (0.5 + 0.5 * np.sin(5 * time)) for low, high in spans], 1)
    channels, noise = Channels.of(model), np.full(len(spans), 1e-3)
    return Log(
        "it", time, np.zeros((len(time), model.nu)), q, np.gradient(q, time, axis=0), True, channels, noise, noise
    )


@pytest.mark.parametrize(
    ("a", "b", "away"),
    [
        ((-1, 1), (-0.5, 0.5), (0, 1)),
        ((-1, 1.6), (-0.5, 0.5), (1,)),
        ((-1, 1), (-0.99, 0), (0,)),
        ((0, 0), (0, 0), (0, 1)),
    ],
)
def test_limits_farther_than_a_quarter_of_the_travel_are_not_reached(a, b, away):
    model = mujoco.MjModel.from_xml_string(ARM)
    assert robot.unreached(model, [log(model, a, b, (0, 1)), log(model, (0, 0.1), (0, 0.1), (0, 1))]) == away


@pytest.mark.slow
def test_they_are_left_out_of_the_simulation_alone(tmp_path):
    nominal(tmp_path)
    (path,) = tmp_path.glob("*.xml")
    spec = mujoco.MjSpec.from_file(str(path))
    (joint,) = spec.joints
    joint.limited, joint.range = mujoco.mjtLimited.mjLIMITED_TRUE, [-900, 900]
    robot = robot_of(spec)
    assert robot.mj_model.jnt_limited[0]
    setup = prepare(robot, recorded(count=4, seconds=2.0), Request(("coulomb_friction",)))
    assert setup.robot.mj_model.jnt_limited[0] and not setup.physics.mj_model.jnt_limited[0]
    assert setup.physics.template._impl.efc_J.shape[0] == 0


RUBBING = ARM.replace("<joint name", '<joint frictionloss=".4" damping=".1" name')


@pytest.mark.slow
@pytest.mark.parametrize("touching", [False, True])
def test_dry_friction_alone_needs_few_rounds_of_the_solver(touching):
    """The same motion as with all rounds; where something can touch they stay."""
    model = mujoco.MjModel.from_xml_string(RUBBING.replace('contype="0" conaffinity="0"', "") if touching else RUBBING)
    few = robot.pruned(robot_of(model), [log(model, (-0.5, 0.5), (-0.5, 0.5), (-0.5, 0.5))], 0.01)
    assert few.rounds == (None if touching else robot.ROUNDS) and few.unlimited == (0, 1)
    if not touching:
        ends = [swung(robot.physics(0.01)) for robot in (few, dataclasses.replace(few, rounds=None))]
        np.testing.assert_allclose(*ends, atol=2e-6)
        assert np.abs(ends[0]).max() > 0.5


def swung(physics):
    """Where it is after half a second from another pose."""
    theta, at = jnp.asarray(physics.space.nominal, jnp.float32), [[1.0, -0.6, 0.4], [2.0, -3.0, 1.0]]
    world = physics.unseen(theta, *map(jnp.array, at))
    step = jax.jit(lambda w: control_step(physics, w, jnp.zeros((physics.substeps, 3)))[0])
    for _ in range(50):
        world = step(world)
    return np.asarray(world.qpos)
