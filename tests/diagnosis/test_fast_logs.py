"""Logs at 1 kHz and above: the control period follows them, and known parameters come back."""

import dataclasses

import pytest

from bayessim_mjx.diagnosis.fitting import robot as robots
from bayessim_mjx.diagnosis.run import diagnose
from bayessim_mjx.diagnosis.setup import control_period
from tests.diagnosis import pendulums

STEP = 0.001  # s


@pytest.mark.parametrize(
    ("period", "expected"), [(0.02, 0.02), (0.004, 0.004), (0.001, 0.001), (0.0005, 0.0005), (0.0001, 0.0005)]
)
def test_the_control_period_is_that_of_the_logs(tmp_path, period, expected):
    (log,) = pendulums.recorded(count=1, seconds=1.0)
    fast = dataclasses.replace(log, time=log.time * period / pendulums.PERIOD)
    robot = pendulums.nominal(tmp_path)
    assert control_period(robot, [fast]) == pytest.approx(expected)
    assert control_period(dataclasses.replace(robot, control_dt=0.03), [fast]) == 0.03  # a task's own


@pytest.mark.slow
@pytest.mark.ci
def test_parameters_of_a_pendulum_logged_at_1_khz_are_found(tmp_path, monkeypatch):
    """MuJoCo C at a tenth of the step; the simulator's own step of 2 ms is longer than the logs' period."""
    robot = pendulums.nominal(tmp_path)
    assert robot.mj_model.opt.timestep == 2 * STEP
    monkeypatch.setattr(pendulums, "PERIOD", STEP)
    monkeypatch.setattr(pendulums, "STEP", STEP)
    logs = pendulums.recorded(count=4, seconds=3.0, scale=(1.0, 1.0, 1.1))
    found = diagnose(robot, logs, effects=["viscous_friction", "actuator_delay"])
    assert found.verdict == "parameters" and not found.effects
    values = [found.parameters[name]["mean"] for name in pendulums.NAMES]
    assert values == pytest.approx([1.0, 1.0, 1.1], abs=0.01)
    assert any("a row every 1 ms, and the model steps 2 ms" in text for text in found.warnings)
    assert robots.with_timestep(robot.mj_model, STEP).opt.timestep == STEP
