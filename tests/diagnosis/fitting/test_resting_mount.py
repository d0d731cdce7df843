"""Windows at the beginning of a log of a robot on a flexible mount, recorded by MuJoCo C from rest."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.diagnosis.fitting.robot import of_file
from bayessim_mjx.diagnosis.fitting.simulator import Simulator, physics_of
from bayessim_mjx.effects import make
from bayessim_mjx.logs.log import Channels, Log
from tests.effects.test_body_effects import ARM, COMMAND

BASE = 0.004, 8.0, 0.2, 0.1  # rad/(N m), Hz, damping ratio, m: it swings for half a second
PERIOD, LENGTH = 0.02, 13


def recorded(model):
    """The arm of the tests of bodies, its mount settled under the weight, pushed from the first row on."""
    compliance, frequency, ratio, depth = BASE
    inertia = 1 / (compliance * (2 * np.pi * frequency) ** 2)
    damping = 2 * ratio * np.sqrt(inertia / compliance)
    hinge = '<joint axis="{}" pos="0 0 -{}" stiffness="{}" armature="{}" damping="{}"/>'
    joints = [hinge.format(axis, depth, 1 / compliance, inertia, damping) for axis in ("0 1 0", "1 0 0")]
    light = '<inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>'
    real = mujoco.MjModel.from_xml_string(ARM.format(dt=0.0002, mount="".join(joints) + light))
    data = mujoco.MjData(real)
    for _ in range(20):
        mujoco.mj_forward(real, data)
        data.qpos[:2] = -data.qfrc_bias[:2] * compliance
    qpos, qvel = [], []
    for row in COMMAND:
        qpos.append(data.qpos[2:].copy())
        qvel.append(data.qvel[2:].copy())
        data.ctrl[:] = row
        mujoco.mj_step(real, data, round(PERIOD / real.opt.timestep))
    time, noise = PERIOD * np.arange(len(COMMAND)), np.full(2, 1e-4)
    return Log("rest", time, COMMAND, np.array(qpos), np.array(qvel), True, Channels.of(model), noise, noise)


@pytest.fixture(scope="module")
def simulator(tmp_path_factory):
    file = tmp_path_factory.mktemp("arm") / "arm.xml"
    file.write_text(ARM.format(dt=0.005, mount="").replace("timestep", 'integrator="RK4" timestep'))
    physics = physics_of(of_file(file), PERIOD, [make("base_flexibility", where="world")])
    cut = windows.cut(
        [recorded(physics.mj_model)], physics.mj_model, PERIOD, physics.substeps, LENGTH, limit=10, centred=False
    )
    return Simulator(physics, cut, lanes=4)


def test_before_a_log_begins_nothing_moves(simulator):
    """Windows within half a second of it are exact: the mount rests, and swings by what was recorded."""
    theta = np.array(simulator.physics.space.nominal, float)
    own = [i for i, p in enumerate(simulator.physics.space.parameters) if p.target == "world.base_flexibility"]
    rigid = simulator.run(theta[None])[0, :, :, :2]
    theta[own if own else slice(-4, None)] = BASE
    swinging = simulator.run(theta[None])[0, :, :, :2]
    missing, left = (np.sqrt(np.mean(x**2, axis=(1, 2))) for x in (rigid, swinging))
    assert simulator.windows.start[0] == 0 and missing[0] > 0.003
    assert (left[:2] < 0.03 * missing[:2]).all()
