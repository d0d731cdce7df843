"""Lags of positions and of velocities: their columns by hand, and as large as they were put into logs."""

import dataclasses
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis import setup as preparing
from bayessim_mjx.diagnosis.evidence import doubts
from bayessim_mjx.diagnosis.evidence.weighing import Weighing
from bayessim_mjx.diagnosis.fitting import robot
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.selection.models import BASE
from bayessim_mjx.diagnosis.selection.numbers import PRIORS
from bayessim_mjx.diagnosis.selection.successive_halving import begin
from bayessim_mjx.parameters.parameter import Parameter
from tests.diagnosis import pendulums

SERVO = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0" damping=".3" armature=".05"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5" mass="1.5"/></body></worldbody>
  <actuator><position joint="hinge" kp="40" kv="4" gear="2"/></actuator></mujoco>"""


def test_each_kind_of_sensor_has_a_lag_of_its_own(monkeypatch):
    """One joint, three rows of (q, v): each sees its own rate of change, and what the late start does to all rows."""
    monkeypatch.setattr(doubts, "_servos", lambda fitter, D: ([], np.zeros((0, 0))))
    speed = np.array([[2.0], [3.0], [5.0], [9.0]])  # rad/s; its slope at the start is 100 rad/s^2
    windows = SimpleNamespace(dt=0.01, log=[0], start=[0], logs=[SimpleNamespace(qvel=speed)])
    rate = np.array([[3.0, 150.0, 5.0, 300.0, 9.0, 400.0]])
    B, D = np.zeros((1, 6, 2)), np.zeros((1, 6, 1))
    B[0, ::2] = [[1.0, 0.01], [1.0, 0.02], [1.0, 0.03]]  # of positions, by start position and speed
    fitter = SimpleNamespace(
        rate=lambda: rate, used=np.ones(2, bool), simulator=SimpleNamespace(nv=1, windows=windows)
    )  # fmt: skip
    unit = PRIORS.times * 0.01
    positions, velocities = np.moveaxis(doubts.found(fitter, D, B).columns[0], 1, 0) / unit
    assert positions == pytest.approx([2 - 3, 0, 2 - 5, 0, 2 - 9, 0])
    assert velocities == pytest.approx([1.0, -150, 2.0, -300, 3.0, -400])
    fitter.used, fitter.rate = np.array([True, False]), lambda: rate[:, ::2]  # speeds are those of the positions
    (both,) = np.moveaxis(doubts.found(fitter, D[:, ::2], B[:, ::2]).columns[0], 1, 0) / unit
    assert both == pytest.approx([2 - 3 + 1, 2 - 5 + 2, 2 - 9 + 3])


def test_a_servos_force_changes_by_its_gains_through_its_gear():
    """k = 40, kv = 4 at a gear of 2: 160 N m/rad times the speed, 16 N m s/rad and the joint's .3 times its slope."""
    model = mujoco.MjModel.from_xml_string(SERVO)
    log = SimpleNamespace(qvel=np.arange(12.0)[:, None] ** 2)
    windows = SimpleNamespace(start=np.array([3]), steps=4, log=np.array([0]), logs=[log], dt=0.1)
    simulator = SimpleNamespace(windows=windows, physics=SimpleNamespace(mj_model=model))
    by_position, by_speed = doubts._pulled(SimpleNamespace(simulator=simulator), 2)
    assert by_position == pytest.approx(160 * np.array([[16.0, 36.0]]))
    assert by_speed == pytest.approx(16.3 * np.array([[80.0, 120.0]]))


@pytest.mark.parametrize("known", [True, False])
def test_late_feedback_of_a_servo_is_less_damping_and_less_armature(known):
    """Per s: 160 N m/rad over a damping of .3, 16.3 N m s/rad over an armature of .05, where these are parameters."""
    model = mujoco.MjModel.from_xml_string(SERVO)
    log = SimpleNamespace(qvel=np.arange(12.0)[:, None] ** 2)
    windows = SimpleNamespace(start=np.array([3]), steps=4, log=np.array([0]), logs=[log], dt=0.1)
    parameters = [Parameter(f"hinge_{a}", 1.0, 0.3, 2.0, attribute=a, target="hinge") for a in ("damping", "armature")]
    physics = SimpleNamespace(mj_model=model, space=SimpleNamespace(parameters=parameters))
    base = parameters if known else []
    fitter = SimpleNamespace(simulator=SimpleNamespace(windows=windows, physics=physics, nv=1), base=base)
    (late_q, late_v), as_known = doubts._servos(fitter, np.ones((1, 4, 2)))
    if known:
        assert not late_q.any() and not late_v.any()
        assert as_known == pytest.approx(np.array([[-160 / 0.3, 0.0], [0.0, -16.3 / 0.05]]))
    else:
        assert not as_known.size
        assert late_q == pytest.approx(np.full((1, 4), 160 * (16.0 + 36.0)))
        assert late_v == pytest.approx(np.full((1, 4), 16.3 * (80.0 + 120.0)))


def test_numbers_behind_a_fits_own_change_nothing_of_it():
    known = Coordinate("known", (0,), 1.0, 0.5, 2.0, 1.0, "")
    fit = Fit((known,), np.zeros(1), *(np.zeros(1),) * 5, 0.0)
    fit = dataclasses.replace(fit, A=np.full((3, 8, 1), 2.0))
    own = doubts.Doubts(np.ones((3, 8, 2)), np.array([[0.0, -3.0]]))
    more = own.beside(fit)
    assert more.A[0, 0] == pytest.approx([2.0, 1.0, 1.0 - 3.0 * 2.0])
    assert more.A.shape == (3, 8, 3) and not more.values.any() and np.all(more.belief() == 1.0)


@pytest.mark.slow
@pytest.mark.ci
def test_a_lag_of_velocities_is_found_and_moves_no_parameter(tmp_path):
    """Velocities .6 ms (3 % of the period) late: the lag by hand, and parameters within their intervals."""
    late, scale = 6e-4, (1.05, 0.97, 1.03)
    logs = pendulums.recorded(scale=scale, count=6, late_velocity=late)
    path, numbers = tmp_path / "pendulum.xml", (pendulums.DAMPING, pendulums.ARMATURE, 0.0, pendulums.MASS)
    path.write_text(pendulums.MODEL % (pendulums.STEP, "RK4", *numbers))  # without an error of its own step
    setup = preparing.prepare(robot.of_file(path), logs, Request(["viscous_friction"]))
    pool = begin(setup.fitter, setup.candidates, setup.settings)
    scored = Weighing(pool).scored[BASE]
    step = scored.learnt.step[len(pool.base.fit.values) :]
    assert len(step) == 3 and abs(step[2]) < 0.1  # damping is not late
    found = (step[1] - step[0]) * doubts.PRIORS.times * float(setup.fitter.simulator.windows.dt)
    assert found == pytest.approx(late, rel=0.25)
    assert pool.base.fit.values[0] < 1.01  # the damping takes the lag where there is no other number for it
    assert scored.found.posterior.middle[: len(scale)] == pytest.approx(scale, abs=0.01)
