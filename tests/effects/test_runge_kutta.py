"""By RK4, whose own error is small at long steps, effects with a motion of their own are as exact, against MuJoCo C."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from tests.effects.test_body_effects import ARM, COMMAND, rocking
from tests.effects.test_transmission_effects import COMMAND as CHIRP
from tests.effects.test_transmission_effects import SERVO, TORQUE, model, sprung
from tests.effects.truths import moved, physics, truth

STEP = 0.005  # s, a fourth of the control step
LONG, FINE = (ARM.format(dt=dt, mount="").replace("timestep", 'integrator="RK4" timestep') for dt in (STEP, STEP / 50))
FORCE = np.array([3.0, -2.0, 1.0])


def share(simulated, real, without):
    """Error in parts of what the effect does."""
    return np.sqrt(np.mean((simulated - real) ** 2) / np.mean((without - real) ** 2))


def plain():
    return truth(mujoco.MjModel.from_xml_string(FINE), COMMAND)


@pytest.mark.parametrize("base", [(0.004, 8.0, 0.1, 0.1), (0.002, 25.0, 0.05, 0.0)])
def test_a_rocking_base(base):
    """To a thousandth; with its force held over the step it was off by 2 to 6 %."""
    (q,) = moved(physics(LONG, [make("base_flexibility", where="world")]), [base], COMMAND)
    swing = rocking(*base) - truth(mujoco.MjModel.from_xml_string(ARM.format(dt=0.002, mount="")), COMMAND)
    real = plain() + swing
    assert share(q, real, plain()) < 0.01


def test_a_force_from_outside():
    """To a thousandth; with the lever arm of the step's beginning it was off by 5 %."""

    def push(model, data):
        data.xfrc_applied[model.body("fore").id, :3] = FORCE

    real = truth(mujoco.MjModel.from_xml_string(FINE), COMMAND, push=push)
    (q,) = moved(physics(LONG, [make("external_force", where="fore")]), [[*FORCE, 0.0]], COMMAND)
    assert share(q, real, plain()) < 0.002


@pytest.mark.parametrize("actuator", [TORQUE, SERVO])
def test_a_spring_between_motor_and_link(actuator):
    """Of 12 Hz, to the second order in the step: 5 % of its effect at 16 steps a swing."""
    compliance, real = sprung(12.0, 0.1, actuator, "RK4", CHIRP)
    world = physics(model(actuator, "RK4", dt=STEP), [make("joint_elasticity", where="link")])
    q, rigid = moved(world, [[compliance, 0.1], [0.0, 0.1]], CHIRP)[..., 0]
    assert share(q, real, rigid) < 0.05
