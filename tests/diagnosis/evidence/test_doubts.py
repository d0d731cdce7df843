"""Lags of positions and of velocities: their columns by hand, and as large as they were put into logs."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from bayessim_mjx.diagnosis import setup as preparing
from bayessim_mjx.diagnosis.evidence import doubts
from bayessim_mjx.diagnosis.evidence.weighing import Weighing
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.selection.begin import begin
from bayessim_mjx.diagnosis.selection.sets import BASE
from tests.diagnosis import pendulums


def test_each_kind_of_sensor_has_a_lag_of_its_own():
    """Two joints with positions and velocities, two rows: each sees its own rate of change."""
    rate = np.arange(1.0, 9.0)[None]  # rows of (q1, q2, v1, v2)
    windows = SimpleNamespace(dt=0.01)
    simulator = SimpleNamespace(nv=2, windows=windows)
    fitter = SimpleNamespace(rate=lambda: rate, used=np.ones(4, bool), simulator=simulator)
    positions, velocities = np.moveaxis(doubts.columns(fitter)[0], 1, 0) / (-doubts.TIMING * 0.01)
    assert positions == pytest.approx([1, 2, 0, 0, 5, 6, 0, 0])
    assert velocities == pytest.approx([0, 0, 3, 4, 0, 0, 7, 8])
    fitter.used, fitter.rate = np.array([True, True, False, False]), lambda: rate[:, :4]
    assert doubts.columns(fitter).shape == (1, 4, 1)  # no velocities were measured


def test_numbers_behind_a_fits_own_change_nothing_of_it():
    fit = Fit((), np.zeros(0), *(np.zeros(1),) * 5, 0.0)
    fit = dataclasses.replace(fit, A=np.zeros((3, 8, 0)))
    more = doubts.doubted(fit, np.ones((3, 8, 2)))
    assert more.A.shape == (3, 8, 2) and not more.values.any() and np.all(more.belief() == 1.0)


@pytest.mark.slow
@pytest.mark.ci
def test_a_lag_of_velocities_is_found_and_moves_no_parameter(tmp_path):
    """Velocities .5 ms (2.5 % of the period) late: the lag by hand, and parameters within their intervals."""
    late, scale, sigma = 5e-4, (1.05, 0.97, 1.03), 4e-4
    logs = []
    for i, log in enumerate(pendulums.recorded(scale=scale, count=6, sigma=0.0)):
        rng, motion = np.random.default_rng(i), CubicSpline(log.time, log.qpos)
        qpos = log.qpos + sigma * rng.normal(size=log.qpos.shape)
        qvel = motion(log.time - late, 1) + 4 * sigma * rng.normal(size=log.qpos.shape)
        noise = {"sigma_qpos": np.array([sigma]), "sigma_qvel": np.array([4 * sigma])}
        logs.append(dataclasses.replace(log, qpos=qpos, qvel=qvel, has_qvel=True, **noise))
    setup = preparing.prepare(pendulums.nominal(tmp_path), logs, ["viscous_friction"])
    pool = begin(setup.fitter, setup.candidates, setup.settings)
    scored = Weighing(pool).scored[BASE]
    step = scored.learnt.step[len(pool.base.fit.values) :]
    assert len(step) == 2
    found = (step[1] - step[0]) * doubts.TIMING * float(setup.fitter.simulator.windows.dt)
    assert found == pytest.approx(late, rel=0.25)
    sd = np.sqrt(np.diag(scored.found.posterior.together()))[: len(scale)]
    assert np.all(np.abs(scored.found.posterior.middle[: len(scale)] - scale) < 2.6 * sd + 0.005)
