"""Generated logs of floating robots are read, and their bases are followed within what the estimate states."""

import dataclasses
import json

import mujoco
import numpy as np
import pytest
import quadruped

from bayessim_mjx.logs import read_logs
from bayessim_mjx.odometry import base, imu


@pytest.mark.parametrize("robot", ["stool", "bars", "quadruped"])
def test_a_standing_robot_is_followed(tmp_path, robot):
    quadruped.write(tmp_path, robot, "ground", "null", runs=1, seconds=1.5, orientation=False, seed=0)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    with pytest.warns(UserWarning, match="hold samples of an inertial unit alone"):
        (log,) = read_logs(tmp_path / "logs", model, partial=True)
    truth = np.load(tmp_path / "base" / "run0.npz")
    rows = np.searchsorted(truth["time"], log.time - 1e-6)
    found = base.estimate(log, model)
    up, right = (np.stack([imu.rotation(q)[2] for q in x]) for x in (found.qpos[:, 3:], truth["pose"][rows, 3:]))
    assert np.abs(up - right).max() < 4 * found.sd_qpos[:, 3].max() < 0.08
    assert np.abs(found.qpos[:, 2] - truth["pose"][rows, 2]).max() < 0.01
    turn = next(s.turn for s in found.sensors if s.kind == "gyro")
    assert (np.abs(found.gyro_bias - turn @ np.array(quadruped.Unit().gyro_bias)) < 4 * found.sd_gyro_bias).all()


def test_a_stand_has_no_floating_base_and_a_fault_is_in_the_truth_alone(tmp_path):
    quadruped.write(tmp_path, "stool", "stand", "coulomb", runs=1, seconds=0.3, orientation=True, seed=0)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
    fault = json.loads((tmp_path / "truth.json").read_text())["fault"]
    assert model.nq == 2 and not model.dof_frictionloss.any()
    assert fault == dataclasses.asdict(quadruped.FAULTS["stool"]["coulomb"])
    real = quadruped.with_fault((tmp_path / "robot.xml").read_text(), quadruped.FAULTS["stool"]["coulomb"])
    assert list(real.dof_frictionloss) == [0.0, 2.0] and real.opt.timestep < model.opt.timestep
