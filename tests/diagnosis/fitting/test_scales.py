"""Scales of a robot with a floating base: noise and range of motion belong to the joint whose they are."""

import dataclasses

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting import scales
from bayessim_mjx.logs import Channels, Log

FLOATING = """<mujoco><option gravity="0 0 0"/><worldbody><body><freejoint/><geom size=".1"/>
  <body><joint type="ball"/><geom size=".1"/>
    <body pos="0 0 .3"><joint name="one" axis="0 1 0"/><geom size=".1"/>
      <body pos="0 0 .3"><joint name="two" axis="0 1 0"/><geom size=".1"/></body></body></body>
</body></worldbody><actuator><motor joint="two"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def setting():
    """The base turns by 0.4 rad about its x axis; of the hinges only "two" moves, by 0.02 rad."""
    model = mujoco.MjModel.from_xml_string(FLOATING)
    time = np.linspace(0.0, 2.0, 101)
    wave = (1 - np.cos(np.pi * time)) / 2
    qpos = np.tile(model.qpos0, (len(time), 1))
    qpos[:, 3], qpos[:, 4] = np.cos(0.2 * wave), np.sin(0.2 * wave)
    qpos[:, 12] = 0.02 * wave
    qvel = np.zeros((len(time), model.nv))
    qvel[:, 3], qvel[:, 10] = np.gradient(0.4 * wave, time), np.gradient(0.02 * wave, time)
    sigma = np.array([0.1, 0.2, 0.3, 3e-3, 4e-3, 3e-3, 4e-3, 0.01, 0.01, 0.01, 0.01, 0.5, 1e-4])
    ctrl, noise = np.zeros((len(time), 1)), np.full(model.nv, 1e-3)
    return model, Log("log", time, ctrl, qpos, qvel, True, Channels.of(model), sigma, noise)


def test_noise_by_degree_of_freedom(setting):
    """A turn by w moves a quaternion by |w| / 2, whatever its orientation: the columns share three turns' noise."""
    model, log = setting
    rng, noise = np.random.default_rng(0), 4e-3
    shaken = np.tile([0.1, 0.7, -0.5, 0.5], (20_000, 1))
    for row in shaken:
        row /= np.linalg.norm(row)
        mujoco.mju_quatIntegrate(row, noise * rng.normal(size=3), 1.0)
    spread = np.std(shaken, axis=0)
    assert spread.max() > 1.3 * spread.min()  # no column has its share alone
    sigma = np.r_[log.sigma_qpos[:3], spread, spread, log.sigma_qpos[11:]]
    found = dataclasses.replace(log, sigma_qpos=sigma).sigma_dofs
    np.testing.assert_allclose(found, [0.1, 0.2, 0.3, *[noise] * 6, 0.5, 1e-4], rtol=0.02)


def test_a_joint_moves_by_its_own_noise(setting):
    found = scales.measure(setting[0], [setting[1]])
    np.testing.assert_array_equal(np.flatnonzero(found.moves), [3, 10])  # roll, and "two" by 200 of its own noises
    np.testing.assert_allclose(found.travel[[3, 10]], [0.2, 0.01], rtol=1e-6)
    assert found.at("joint", "two")["travel"] == pytest.approx(0.01)


SERVO = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="hinge" axis="0 1 0"/>
  <geom size=".01" mass=".01"/></body></worldbody><actuator>{drive}</actuator></mujoco>"""
DRIVES = {  # each exerts 0.6 N m on a joint that stands still at 0.1 rad: (its MJCF, its command)
    "motor": ('<motor name="m" joint="hinge" gear="3"/>', 0.2),
    "servo": ('<position name="m" joint="hinge" kp="20" gear="1"/>', 0.13),
    "servo with a filter": ('<position name="m" joint="hinge" kp="20" timeconst=".02"/>', 0.13),
    "limited servo": ('<position name="m" joint="hinge" kp="200" forcerange="-.6 .6"/>', 0.13),
}


@pytest.mark.parametrize("name", DRIVES)
def test_what_a_drive_exerts_on_a_joint_at_rest_is_the_joints_force(name):
    """Friction holds it there, which the model lacks: its motion needs no force at all."""
    drive, command = DRIVES[name]
    model = mujoco.MjModel.from_xml_string(SERVO.format(drive=drive))
    count, sigma = 101, np.full(1, 1e-4)
    still, ctrl = np.full((count, 1), 0.1), np.full((count, 1), command)
    log = Log("log", 0.02 * np.arange(count), ctrl, still, 0 * still, True, Channels.of(model), sigma, sigma)
    found = scales.measure(model, [log])
    assert found.force[0] == pytest.approx(0.6)
    assert found.effort[0] == pytest.approx(0.2 if name == "motor" else 0.6)
    assert found.at("joint", "hinge")["force"] == pytest.approx(0.6)
