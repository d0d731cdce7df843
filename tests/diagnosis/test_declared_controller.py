"""A whole diagnosis of a position-controlled joint, whose logs hold targets and declare the controller."""

import mujoco
import pytest

import bayessim_mjx

from .recordings import PENDULUM, record, sines

MOTOR = '<motor name="motor" joint="hinge"/>'
SERVO = '<position name="motor" joint="hinge" kp="6" kv="0.4"/>'


@pytest.mark.slow
def test_friction_behind_a_declared_controller_is_named():
    """Every stage: the flexible force, black boxes and whole logs know the controller too."""
    spoken = {"law": "position", "kp": 6.0, "kd": 0.4}
    real = PENDULUM.replace(MOTOR, SERVO).replace('timestep="0.001"', 'timestep="0.0001"')  # no time step of its own
    logs = [record(real, sines((0.9,), seed=s), name=f"run{s}.npz", seed=s, controller=spoken) for s in range(4)]
    model = mujoco.MjModel.from_xml_string(PENDULUM.replace('frictionloss="0.05"', ""))
    found = bayessim_mjx.diagnose(model, logs, effects=["coulomb_friction", "actuator_gain"])
    (effect,) = found.effects
    assert (effect.name, effect.where) == ("coulomb_friction", "hinge")
    assert effect.parameters["level"].mean == pytest.approx(0.05, rel=0.1)
