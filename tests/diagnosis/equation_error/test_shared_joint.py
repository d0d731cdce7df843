"""Two motors on one joint: each effort is scaled by its own motor's gain."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.equation_error.inverse_dynamics_check import check, proposed
from tests.diagnosis.recordings import record

PAIR = """<mujoco><option timestep="0.001" integrator="implicitfast"/><worldbody><body>
  <joint name="hinge" axis="0 1 0" damping="0.05"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.4" mass="0.5" contype="0" conaffinity="0"/></body></worldbody>
<actuator><general name="left" joint="hinge" gainprm="{left}"/><general name="right" joint="hinge" gainprm="{right}"/>
</actuator></mujoco>"""


def together(t: float, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Each motor follows a course of its own, so that their shares of the effort can be told apart."""
    return np.array([1.2 * np.sin(5.1 * t), 1.0 * np.sin(3.3 * t + 1.0)])


@pytest.mark.parametrize(("left", "right"), [(0.7, 1.0), (1.0, 1.3)])
def test_a_motor_that_shares_a_joint_has_a_gain_of_its_own(left: float, right: float):
    logs = [record(PAIR.format(left=left, right=right), together, name=f"{k}.npz", seed=k) for k in range(3)]
    seen = check(logs, mujoco.MjModel.from_xml_string(PAIR.format(left=1, right=1)))
    (found,) = seen.proposals
    wrong, gain = ("left", left) if left != 1.0 else ("right", right)
    assert found.label == f"actuator_gain@{wrong}"
    assert found.parameters["gain"] == pytest.approx(gain, abs=0.02)
    assert seen.explained > 0.95 and proposed(seen)
