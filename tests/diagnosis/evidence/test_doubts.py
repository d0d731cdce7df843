"""Terms of force by hand, and what their errors do to residuals against the simulator's own parameters."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis import setup as preparing
from bayessim_mjx.diagnosis.evidence import doubts
from bayessim_mjx.diagnosis.residual import forcing
from tests.diagnosis import pendulums

SERVO = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0" damping=".3" stiffness="2" armature=".05"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5" mass="1.5"/></body></worldbody>
  <actuator><position joint="hinge" kp="40" kv="4" gear="2"/></actuator></mujoco>"""


def test_terms_of_a_driven_pendulum_by_hand():
    """Inertia times acceleration; damping and the servo's, through its gear squared; gravity and spring."""
    model = mujoco.MjModel.from_xml_string(SERVO)
    data, q, v, a = mujoco.MjData(model), 0.4, -1.3, 7.0
    inertial, by_speed, by_position = doubts._at(model, data, np.array([q]), np.array([v]), np.array([a]))[:, 0]
    about_joint = model.body_inertia[1][1] + 1.5 * 0.25**2 + 0.05
    assert inertial == pytest.approx(about_joint * a)
    assert by_speed == pytest.approx((0.3 + 4 * 2**2) * v)
    assert by_position == pytest.approx(1.5 * 9.81 * 0.25 * np.sin(q) + 2 * q)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """(fitter, fit of the known parameters) of logs with nothing missing."""
    robot = pendulums.nominal(tmp_path_factory.mktemp("model"))
    return pendulums.fitted(preparing.prepare(robot, pendulums.recorded(count=6), ["viscous_friction"]))


@pytest.mark.slow
@pytest.mark.ci
def test_an_error_of_a_term_is_that_of_the_parameter_which_makes_it(fitted):
    """Force by speed is the damping's alone, and two of the terms are what mass and armature are together."""
    fitter, fit = fitted
    D = forcing.columns(fitter, fit, forcing.default_nodes(fitter))
    found = doubts.columns(fitter, D)
    assert found.shape[2] == 4  # inertia, speed, position, and the lag of rows
    inertial, speed, position = (found[:, :, i] for i in range(3))
    damping, armature, mass = (fit.A[:, :, fit.names.index(n)] * doubts.TERMS for n in pendulums.NAMES)
    scale = fit.values[fit.names.index(pendulums.NAMES[0])]
    assert np.linalg.norm(speed + damping * scale) < 0.06 * np.linalg.norm(speed)
    whole = armature + mass  # all of the inertia, and gravity
    assert np.linalg.norm(inertial + position + whole) < 0.06 * np.linalg.norm(whole)


@pytest.mark.slow
@pytest.mark.ci
def test_numbers_behind_a_fits_own_change_nothing_of_it(fitted):
    fitter, fit = fitted
    columns = doubts.columns(fitter, forcing.columns(fitter, fit, 6))
    more = doubts.doubted(fit, columns)
    assert more.A[:, :, : len(fit.values)] is not fit.A and np.array_equal(more.A[:, :, : len(fit.values)], fit.A)
    assert np.array_equal(more.values[: len(fit.values)], fit.values) and not more.values[len(fit.values) :].any()
    assert np.all(more.belief()[len(fit.values) :] == 1.0)
