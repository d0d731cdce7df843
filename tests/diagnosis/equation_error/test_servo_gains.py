"""A servo whose gains are not the model's, before any simulation: within its force limit and at it."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.equation_error.inverse_dynamics_check import check
from bayessim_mjx.diagnosis.phrases import first_look
from tests.diagnosis.recordings import record

SERVO = """<mujoco><compiler autolimits="true"/><option timestep="0.001" integrator="implicitfast"/><worldbody><body>
  <joint name="horn" axis="0 1 0" damping="0.02" armature="0.004"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.1" mass="0.3" contype="0" conaffinity="0"/></body></worldbody>
<actuator><position name="servo" joint="horn" kp="{kp}" kv="{kv}" forcerange="-{most} {most}"/></actuator></mujoco>"""


def targets(t: float, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    return np.array([0.8 * np.sin(4.0 * t) + 0.5 * np.sign(np.sin(1.7 * t))])


@pytest.mark.parametrize(("kp", "kv", "most"), [(7.0, 0.3, 9.0), (7.0, 0.3, 0.5), (45.0, 0.3, 9.0), (20.0, 0.9, 9.0)])
def test_a_gain_of_the_firmware_is_proposed_in_its_own_unit(kp: float, kv: float, most: float):
    logs = [record(SERVO.format(kp=kp, kv=kv, most=most), targets, name=f"{k}.npz", seed=k) for k in range(3)]
    seen = check(logs, mujoco.MjModel.from_xml_string(SERVO.format(kp=20.0, kv=0.3, most=most)))
    name, true, model = ("servo_stiffness", kp, 20.0) if kp != 20.0 else ("servo_damping", kv, 0.3)
    assert seen.proposals[0].label == f"{name}@servo"
    assert model * seen.proposals[0].parameters["factor"] == pytest.approx(true, rel=0.12)
    assert f", not {model:g}" in " ".join(first_look.lines(seen))


def test_the_gains_of_the_model_are_not_doubted():
    xml = SERVO.format(kp=20.0, kv=0.3, most=0.5)
    seen = check([record(xml, targets, name=f"{k}.npz", seed=k) for k in range(3)], mujoco.MjModel.from_xml_string(xml))
    assert not seen.proposals


MOTOR = SERVO[: SERVO.index("<actuator>")] + '<actuator><motor name="servo" joint="horn"/></actuator></mujoco>'


@pytest.mark.parametrize(("kp", "kd"), [(7.0, 0.3), (20.0, 0.9)])
def test_a_gain_that_the_logs_declare_wrongly_is_proposed(kp: float, kd: float):
    declared = {"law": "position", "kp": 20.0, "kd": 0.3}
    real = SERVO.format(kp=kp, kv=kd, most=9.0)
    logs = [record(real, targets, name=f"{k}.npz", seed=k, controller=declared) for k in range(3)]
    seen = check(logs, mujoco.MjModel.from_xml_string(MOTOR))
    name, true, known = ("controller_stiffness", kp, 20.0) if kp != 20.0 else ("controller_damping", kd, 0.3)
    assert seen.proposals[0].label == f"{name}@servo"
    assert known * seen.proposals[0].parameters["factor"] == pytest.approx(true, rel=0.12)
    assert f", not {known:g}" in " ".join(first_look.lines(seen))
