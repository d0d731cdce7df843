"""What drives a joint is told from the log: through the controller that it declares, where it declares one."""

from types import SimpleNamespace

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.residual import motion_inputs
from bayessim_mjx.physics import controllers
from tests.diagnosis.recordings import ARM, record, sines

KP, KD = np.array([20.0, 8.0]), np.array([1.0, 0.3])
LAW = {"m_shoulder": {"law": "position", "kp": 20.0, "kd": 1.0}, "m_elbow": {"law": "position", "kp": 8.0, "kd": 0.3}}


def test_efforts_are_those_of_the_declared_controller():
    model, target = mujoco.MjModel.from_xml_string(ARM), sines((0.5, 0.5))
    log = record(ARM, target, seconds=1.0, controller=LAW)
    windows = SimpleNamespace(batch=SimpleNamespace(law=controllers.of_logs([log], model)), log=np.array([0]))
    _, effort, _ = motion_inputs._forces(log, model, windows, 0)
    expected = (KP * (log.ctrl - log.qpos) - KD * log.qvel) * np.array([1.0, 2.0])  # the elbow's gear
    np.testing.assert_allclose(effort, expected, rtol=1e-4, atol=1e-5)
    direct = SimpleNamespace(batch=SimpleNamespace(law=None), log=np.array([0]))
    _, effort, _ = motion_inputs._forces(log, model, direct, 0)
    np.testing.assert_allclose(effort, log.ctrl * np.array([1.0, 2.0]), rtol=1e-6)
