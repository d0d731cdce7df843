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
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.selection.begin import begin
from bayessim_mjx.diagnosis.selection.sets import BASE
from tests.diagnosis import pendulums

SERVO = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0" damping=".3" armature=".05"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5" mass="1.5"/></body></worldbody>
  <actuator><position joint="hinge" kp="40" kv="4" gear="2"/></actuator></mujoco>"""


def test_each_kind_of_sensor_has_a_lag_of_its_own(monkeypatch):
    """Two joints with positions and velocities, two rows: each sees its own rate of change."""
    monkeypatch.setattr(doubts, "_pulled", lambda fitter, nodes: np.zeros((1, 2 * nodes)))
    rate, D = np.arange(1.0, 9.0)[None], np.zeros((1, 8, 2))  # rows of (q1, q2, v1, v2)
    windows = SimpleNamespace(dt=0.01)
    simulator = SimpleNamespace(nv=2, windows=windows)
    fitter = SimpleNamespace(rate=lambda: rate, used=np.ones(4, bool), simulator=simulator)
    positions, velocities = np.moveaxis(doubts.columns(fitter, D)[0], 1, 0) / (-doubts.TIMING * 0.01)
    assert positions == pytest.approx([1, 2, 0, 0, 5, 6, 0, 0])
    assert velocities == pytest.approx([0, 0, 3, 4, 0, 0, 7, 8])
    fitter.used, fitter.rate = np.array([True, True, False, False]), lambda: rate[:, :4]
    assert doubts.columns(fitter, D[:, :4]).shape == (1, 4, 1)  # no velocities were measured


def test_a_servos_force_changes_by_its_stiffness_through_its_gear():
    """k = 40 N m/rad at a gear of 2: 160 N m/rad times the speed at the middle of each half of four steps."""
    model = mujoco.MjModel.from_xml_string(SERVO)
    log = SimpleNamespace(qvel=np.arange(12.0)[:, None])
    windows = SimpleNamespace(start=np.array([3]), steps=4, log=np.array([0]), logs=[log])
    simulator = SimpleNamespace(windows=windows, physics=SimpleNamespace(mj_model=model))
    assert doubts._pulled(SimpleNamespace(simulator=simulator), 2) == pytest.approx(160 * np.array([[4.0, 6.0]]))


def test_numbers_behind_a_fits_own_change_nothing_of_it():
    fit = Fit((), np.zeros(0), *(np.zeros(1),) * 5, 0.0)
    fit = dataclasses.replace(fit, A=np.zeros((3, 8, 0)))
    more = doubts.doubted(fit, np.ones((3, 8, 2)))
    assert more.A.shape == (3, 8, 2) and not more.values.any() and np.all(more.belief() == 1.0)


@pytest.mark.slow
@pytest.mark.ci
def test_a_lag_of_velocities_is_found_and_moves_no_parameter(tmp_path):
    """Velocities .6 ms (3 % of the period) late: the lag by hand, and parameters within their intervals."""
    late, scale = 6e-4, (1.05, 0.97, 1.03)
    logs = pendulums.recorded(scale=scale, count=6, late_velocity=late)
    path, numbers = tmp_path / "pendulum.xml", (pendulums.DAMPING, pendulums.ARMATURE, 0.0, pendulums.MASS)
    path.write_text(pendulums.MODEL % (pendulums.STEP, "RK4", *numbers))  # without an error of its own step
    setup = preparing.prepare(robot.of_file(path), logs, ["viscous_friction"])
    pool = begin(setup.fitter, setup.candidates, setup.settings)
    scored = Weighing(pool).scored[BASE]
    step = scored.learnt.step[len(pool.base.fit.values) :]
    assert len(step) == 2
    found = (step[1] - step[0]) * doubts.TIMING * float(setup.fitter.simulator.windows.dt)
    assert found == pytest.approx(late, rel=0.25)
    sd = np.sqrt(np.diag(scored.found.posterior.together()))[: len(scale)]
    assert np.all(np.abs(scored.found.posterior.middle[: len(scale)] - scale) < 2.6 * sd)
