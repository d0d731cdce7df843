"""Forces that a motion takes, by hand, and what a common error of them does to a number that takes it."""

import dataclasses
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.evidence import doubts
from bayessim_mjx.diagnosis.evidence.gaussian import Hyper, marginal
from bayessim_mjx.diagnosis.evidence.parameters import belief_of
from bayessim_mjx.diagnosis.evidence.weighing import Weighing, _taken
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fit import Fit
from tests.diagnosis.evidence.linear import CHANNELS, SPREAD, STARTS, draw

SERVO = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0" damping=".3" stiffness="2" armature=".05"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5" mass="1.5"/></body></worldbody>
  <actuator><position joint="hinge" kp="40" kv="4" gear="2"/></actuator></mujoco>"""


def test_terms_of_a_driven_pendulum_by_hand():
    """Inertia times acceleration; damping and the servo's, through its gear squared; gravity and spring."""
    model = mujoco.MjModel.from_xml_string(SERVO)
    data, q, v, a = mujoco.MjData(model), 0.4, -1.3, 7.0
    found = doubts._at(model, data, np.array([q]), np.array([v]), np.array([a]))[:, 0]
    inertial, by_speed, by_position = found[:3]
    about_joint = model.body_inertia[1][1] + 1.5 * 0.25**2 + 0.05
    assert inertial == pytest.approx(about_joint * a)
    assert by_speed == pytest.approx((0.3 + 4 * 2**2) * v)
    assert by_position == pytest.approx(1.5 * 9.81 * 0.25 * np.sin(q) + 2 * q)
    assert found[3:] == pytest.approx([-1.0, v, q])


def test_a_number_that_takes_a_common_force_is_as_uncertain_as_that_force(monkeypatch):
    """A mass whose column is the inertial force: of 2 N m rms and a missing force of .01 N m it is known to .5 %."""
    rng = np.random.default_rng(0)
    forces, states, D = np.zeros((5, 4, 1, 4)), rng.normal(size=(5, 2, 1, 4)), rng.normal(size=(5, 30, 4))
    forces[:, 0, 0] = rng.normal(size=(5, 4))
    forces *= 2.0 / np.sqrt(np.mean(forces[:, 0] ** 2))
    monkeypatch.setattr(doubts, "of_motion", lambda fitter, nodes: (forces, states))
    column = (D @ forces[:, 0, 0, :, None])[..., 0]
    found = doubts.common(SimpleNamespace(), D, np.array([0.01]))
    assert np.sum(column * found[..., 0]) / np.sum(column**2) == pytest.approx(0.005)
    assert found.shape == (5, 30, 4 + 2 * 4) and not found[..., 1:4].any()
    for cells in np.split(found[..., 4:], 2, axis=2):  # by speed, by position: each node is in one cell
        np.testing.assert_allclose(cells.sum(2), 0.01 * D.sum(2))
    assert not doubts.common(SimpleNamespace(), D, np.zeros(1)).size


def test_numbers_take_common_errors_as_a_fit_to_them_would():
    """Each error added to the residuals moves the most probable numbers; one that rests at a bound stays there."""
    case, hyper = draw(3, k=3), Hyper(np.array([0.02]), 4.0, np.array([1.0, 1.2]))
    count, errors = len(case.r), np.random.default_rng(1).normal(size=(*case.r.shape, 2))
    coordinates = tuple(Coordinate(str(i), (i,), 0.0, -50.0, 50.0, 1.0) for i in range(3))
    fit = Fit(
        coordinates,
        np.zeros(3),
        np.zeros((count, STARTS)),
        case.r,
        case.A,
        case.B,
        np.ones(count),
        0.0,
        spread=np.full(STARTS, SPREAD),
    )
    weighing = Weighing.__new__(Weighing)
    weighing.D, weighing.scale, weighing.channels = case.D, case.scale, CHANNELS

    def best(r):
        own = dataclasses.replace(fit, r=r)
        return belief_of(own).best(marginal(weighing.windows(own), hyper).Q.sum(0))

    moves = np.array([best(case.r + errors[..., i]) - best(case.r) for i in range(2)])
    learnt, model = SimpleNamespace(hyper=hyper), SimpleNamespace(fit=fit)
    of = SimpleNamespace(fit=fit, learnt=learnt, model=model, found=SimpleNamespace(free=np.ones(3, bool)))
    np.testing.assert_allclose(_taken(weighing, of, errors), moves.T @ moves, rtol=1e-6)
    of.found.free = np.array([True, False, True])
    held = _taken(weighing, of, errors)
    assert not held[1].any() and held[0, 0] > 0
