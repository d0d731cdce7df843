"""Logs of robots that float or drive are read, pass the gate, and a diagnosis finds what was hidden in them."""

import dataclasses

import free_bodies
import mujoco
import numpy as np
import pytest

from bayessim_mjx import diagnose
from bayessim_mjx.diagnosis.fitting.robot import robot_of
from bayessim_mjx.diagnosis.logcheck import gate
from bayessim_mjx.diagnosis.setup import control_period
from bayessim_mjx.logs import read_logs


@pytest.fixture
def short(monkeypatch):
    """Give logs of so many runs and seconds."""

    def cut(name: str, runs: int, seconds: float) -> None:
        own = dataclasses.replace(free_bodies.ROBOTS[name], runs=runs, seconds=seconds)
        monkeypatch.setitem(free_bodies.ROBOTS, name, own)

    return cut


@pytest.mark.parametrize("name", list(free_bodies.ROBOTS))
def test_their_logs_are_read_and_pass_the_gate(name, tmp_path, short):
    short(name, 2, 1.0)
    truth = free_bodies.write(name, "null", tmp_path)
    robot = robot_of(mujoco.MjSpec.from_file(str(tmp_path / "model.xml")))
    logs = read_logs(tmp_path / "logs", robot.mj_model)
    found = gate.check(logs, robot.mj_model, control_period(robot, logs))
    assert not found.refused and len(found.usable) == 2 and truth["effects"] == []
    for log in found.usable:
        assert log.has_qvel and np.allclose(np.linalg.norm(log.qpos[:, 3:7], axis=1), 1, atol=1e-6)
        # noise that was put in: half a millimetre, a milliradian (half of it in the quaternion)
        np.testing.assert_allclose(log.sigma_dofs[:6], [5e-4] * 3 + [1e-3] * 3, rtol=0.5)


@pytest.mark.parametrize(
    ("name", "case"), [("drone", "drag_strong"), ("vehicle", "drag_strong"), ("drone", "lag_strong")]
)
def test_a_cause_changes_the_motion_and_nothing_else_does(name, case, short):
    short(name, 1, 1.0)
    robot = free_bodies.ROBOTS[name]
    (one,), (again,), (other,) = (free_bodies.record(robot, robot.cases[c](), 3) for c in ("null", "null", case))
    np.testing.assert_array_equal(one["qpos"], again["qpos"])
    assert np.abs(other["qpos"] - one["qpos"])[:, :3].max() > 10 * free_bodies.NOISE["place"]


FEW = ["body_drag", "wind", "external_force", "actuator_gain", "actuator_lag", "payload"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "label", "parameter", "value"),
    [
        ("drag_strong", "body_drag@drone", "linear", 0.4),
        ("gain_strong", "actuator_gain@front_right", "gain", 0.8),
        ("null", "", "", 0.0),
    ],
)
def test_a_drone_is_diagnosed_from_its_pose(case, label, parameter, value, tmp_path, short):
    """At its place, with an interval of four standard deviations that holds the truth; no false alarm."""
    short("drone", 4, 2.0)
    free_bodies.write("drone", case, tmp_path)
    found = diagnose(tmp_path / "model.xml", tmp_path / "logs", effects=FEW, verdict_only=True)
    assert [f"{e.name}@{e.where}" for e in found.effects] == ([label] if label else [])
    for effect in found.effects:
        own = effect.parameters[parameter]
        assert abs(own.mean - value) < 4 * own.sd < 0.2 * abs(value)
