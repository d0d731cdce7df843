"""A servo whose gains are not the model's, before any simulation: within its force limit and at it."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.equation_error.inverse_dynamics_check import check
from bayessim_mjx.diagnosis.phrases import notes
from tests.diagnosis.recordings import record

SERVO = """<mujoco><compiler autolimits="true"/><option timestep="0.001" integrator="implicitfast"/><worldbody><body>
  <joint name="horn" axis="0 1 0" damping="0.02" armature="{rotor}"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.1" mass="0.3" contype="0" conaffinity="0"/></body></worldbody>
<actuator><position name="servo" joint="horn" kp="{kp}" kv="{kv}" forcerange="-{most} {most}"/></actuator></mujoco>"""


def smooth(t: float, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    return np.array([0.8 * np.sin(4.0 * t) + 0.5 * np.sin(11.3 * t)])


def steps(t: float, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    return np.array([0.8 * np.sin(4.0 * t) + 0.5 * np.sign(np.sin(1.7 * t))])


# true gains, force limit, rotor and targets; the model's gains are kp 20 and kv 0.3
CASES = [(7.0, 0.3, 9.0, 0.04, smooth), (20.0, 0.9, 9.0, 0.04, smooth), (7.0, 0.3, 0.5, 0.004, steps)]


@pytest.mark.parametrize(("kp", "kv", "most", "rotor", "targets"), CASES)
def test_a_gain_of_the_firmware_is_proposed_in_its_own_unit(kp, kv, most, rotor, targets):
    real, given = (SERVO.format(kp=a, kv=b, most=most, rotor=rotor) for a, b in ((kp, kv), (20.0, 0.3)))
    logs = [record(real, targets, name=f"{k}.npz", seed=k) for k in range(3)]
    seen = check(logs, mujoco.MjModel.from_xml_string(given))
    name, true, model = ("servo_stiffness", kp, 20.0) if kp != 20.0 else ("servo_damping", kv, 0.3)
    assert seen.proposals[0].label == f"{name}@servo"
    assert model * seen.proposals[0].parameters["factor"] == pytest.approx(true, rel=0.12)
    assert f", not {model:g}" in " ".join(notes.first_look(seen))


@pytest.mark.parametrize("kp", [20.0, 400.0])  # the second one moves between the rows of a log
def test_the_gains_of_the_model_are_not_doubted(kp: float):
    xml = SERVO.format(kp=kp, kv=0.3, most=9.0, rotor=0.04)
    seen = check([record(xml, smooth, name=f"{k}.npz", seed=k) for k in range(3)], mujoco.MjModel.from_xml_string(xml))
    assert not {p.term.effect for p in seen.proposals} & {"servo_stiffness", "servo_damping"}


MOTOR = SERVO[: SERVO.index("<actuator>")] + '<actuator><motor name="servo" joint="horn"/></actuator></mujoco>'


@pytest.mark.parametrize(("kp", "kd", "declared"), [(7.0, 0.3, 20.0), (20.0, 0.9, 20.0)])
def test_a_gain_that_the_logs_declare_wrongly_is_proposed(kp: float, kd: float, declared: float):
    law = {"law": "position", "kp": declared, "kd": 0.3}
    real = SERVO.format(kp=kp, kv=kd, most=9.0, rotor=0.04)
    logs = [record(real, smooth, name=f"{k}.npz", seed=k, controller=law) for k in range(3)]
    seen = check(logs, mujoco.MjModel.from_xml_string(MOTOR.format(rotor=0.04)))
    name, true, known = ("controller_stiffness", kp, declared) if kp != declared else ("controller_damping", kd, 0.3)
    assert seen.proposals[0].label == f"{name}@servo"
    assert known * seen.proposals[0].parameters["factor"] == pytest.approx(true, rel=0.12)
    assert f", not {known:g}" in " ".join(notes.first_look(seen))
