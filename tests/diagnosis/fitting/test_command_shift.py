"""Commands that act before their rows: found to a tenth of a millisecond, and nothing where there is none."""

import dataclasses
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting import scales
from bayessim_mjx.diagnosis.fitting.command_shift import Shift, _judged, estimate
from bayessim_mjx.diagnosis.fitting.integrator_choice import GAINS
from bayessim_mjx.diagnosis.fitting.quadratic import Quadratic
from bayessim_mjx.diagnosis.fitting.robot import of_file
from bayessim_mjx.diagnosis.run import diagnose
from bayessim_mjx.diagnosis.setup import _measured
from bayessim_mjx.logs import Channels, Log, estimate_velocity, resample
from tests.diagnosis.pendulums import ARMATURE, DAMPING, MASS, MODEL, PERIOD, STEP, nominal, recorded

SURE = {"error": 1e-4, "apart": 1e-4, "explains": 0.95, "step": PERIOD}


def logged_late(logs):
    """The same motion, each command in the row after its own: it seems to act one row early."""
    return [dataclasses.replace(log, ctrl=np.concatenate([log.ctrl[:1], log.ctrl[:-1]])) for log in logs]


def estimated(robot, logs, effects=()) -> Shift:
    size = scales.measure(robot.mj_model, [resample(log, PERIOD) for log in logs])
    cuts, step = _measured(robot.physics(PERIOD, effects), logs, group=None, use_qvel=False, limit=None)
    found = estimate(step, cuts, size.force)
    assert found is not None
    return found


@pytest.mark.slow
@pytest.mark.ci
def test_leads_are_found_and_nothing_else_is_one(tmp_path):
    robot = nominal(tmp_path)
    for logs, late in (
        (recorded(count=4, delay=0.005), None),
        (logged_late(recorded(count=4, delay=0.017)), -0.003),
        (recorded(count=4), None),
        (recorded(count=4, friction=0.1), None),
        (recorded(count=4, scale=(4.0, 1.0, 1.2)), None),  # damping far beyond its range
    ):
        found = estimated(robot, logs)
        assert found.certain == (late is not None)
        assert late is None or (found.late == pytest.approx(late, abs=1.5e-4) and found.error < 1e-4)
        assert not found.likely
    # friction, whose direction changes within a step, takes part in it: with .1 N m a seventh
    much = estimated(robot, logged_late(recorded(count=4, friction=0.1, delay=0.017)))
    assert not much.certain and much.late == pytest.approx(-0.003, abs=5e-4)
    beside = estimated(robot, logged_late(recorded(count=4, friction=0.05, delay=0.017)))
    assert beside.likely and not beside.certain and beside.late == pytest.approx(-0.003, abs=1.5e-4)
    assert f"`commands_late: {beside.late:.4g}`" in beside.hint()


def smooth(count: int = 3, noise: float = 4e-4) -> list[Log]:
    """Commands that change all the time, of which the log has a sample per row."""
    model = mujoco.MjModel.from_xml_string(MODEL % (STEP / 10, "RK4", DAMPING, ARMATURE, 0.0, MASS))
    channels, sigma, each = Channels.of(model), np.array([noise]), round(PERIOD / model.opt.timestep)
    rng, logs = np.random.default_rng(0), []
    for i in range(count):
        time = PERIOD / each * np.arange(200 * each)
        command = 0.8 * np.sin((4 + i) * time + i) + 0.4 * np.sin(13 * time)
        data, qpos = mujoco.MjData(model), np.zeros((200, 1))
        for k, u in enumerate(command):
            if k % each == 0:
                qpos[k // each] = data.qpos + noise * rng.normal()
            data.ctrl[0] = u
            mujoco.mj_step(model, data)
        rows = time[::each]
        qvel, spread = estimate_velocity(rows, qpos, channels, sigma)
        logs.append(Log(f"log{i}", rows, command[::each, None], qpos, qvel, False, channels, sigma, spread))
    return logs


SERVO = MODEL.replace("<motor ", '<position kp="20" kv="%g" ')


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("kv", [0.1, 1.2, 2.4])
def test_a_servos_wrong_damping_is_no_lead(tmp_path, kv):
    """Its truth is known: the robot's servo has another kv than the model's .6, and nothing else differs."""
    fine = (DAMPING, ARMATURE, 0.0, MASS)
    (tmp_path / "servo.xml").write_text(SERVO % (STEP, "implicitfast", *fine, 0.6))
    model = mujoco.MjModel.from_xml_string(SERVO % (STEP / 10, "implicitfast", *fine, kv))
    channels, sigma, rng = Channels.of(model), np.array([4e-4]), np.random.default_rng(0)
    logs = []
    for i in range(4):
        time, rows = PERIOD * np.arange(200), []
        command = 0.6 * np.sin((3 + i) * time + i) + 0.3 * np.sin(10 * time)
        data = mujoco.MjData(model)
        for data.ctrl[0] in command:
            rows.append(data.qpos + sigma * rng.normal())
            mujoco.mj_step(model, data, round(PERIOD / model.opt.timestep))
        qvel, spread = estimate_velocity(time, np.array(rows), channels, sigma)
        logs.append(Log(f"log{i}", time, command[:, None], np.array(rows), qvel, False, channels, sigma, spread))
    gains = [kind(where="motor") for kind in GAINS]
    found = estimated(of_file(tmp_path / "servo.xml"), logs, gains)
    assert found.lead == 0 and not found.likely


@pytest.mark.slow
@pytest.mark.ci
def test_samples_of_a_smooth_command_lead_by_half_a_row_unless_they_are_held_linearly(tmp_path):
    robot, logs = nominal(tmp_path), smooth()
    found = estimated(robot, logs)
    assert found.certain and found.late == pytest.approx(-PERIOD / 2, rel=0.05)
    assert "`hold: linear`" in found.notes(PERIOD)[0]
    linear = estimated(robot, [dataclasses.replace(log, metadata={"hold": "linear"}) for log in logs])
    assert not linear.certain and abs(linear.late) < 3e-4


@pytest.mark.slow
def test_a_lead_is_moved_away_and_told_not_explained_by_an_effect(tmp_path):
    """Its truth is known: a simulator without any gap, whose commands were logged 3 ms late."""
    effects = ["actuator_delay", "viscous_friction", "joint_elasticity"]
    found = diagnose(nominal(tmp_path), logged_late(recorded(count=6, delay=0.017)), effects=effects)
    assert found.verdict == "no_gap" and not found.effects
    (told,) = [w for w in found.warnings if "commands seem shifted" in w]
    assert "-3 ms" in told and "which no drive does" in told
    for parameter in found.parameters.values():
        assert parameter["mean"] == pytest.approx(1.0, abs=0.01)


def test_a_lead_is_told_only_if_nothing_else_would_do_as_well():
    assert Shift(-0.003, **SURE).certain and not Shift(0.003, **SURE).certain
    assert not Shift(-0.0009, **SURE).certain  # less than a twentieth of a step: a simulator's own
    for worse in ({"error": 1e-3}, {"apart": 1e-3}, {"explains": 0.45}):
        assert not Shift(-0.003, **{**SURE, **worse}).certain
    assert Shift(-0.003, **{**SURE, "apart": 1e-3}).likely
    assert not Shift(-0.003, **{**SURE, "explains": 0.14}).likely  # an unknown payload's gap is no hint of a lead


@pytest.mark.parametrize(("off", "certain"), [(0.5, True), (2.0, True), (20.0, False)])
def test_a_lead_beside_a_parameter_that_no_data_sheet_is_off_by_is_not_certain(off, certain):
    """All of the cost is explained, by a shift of 10 standard deviations and a parameter `off` of its prior's."""
    cut = SimpleNamespace(group=np.repeat([0, 1], 4), dt=PERIOD)
    q = Quadratic(np.full(8, 25.0), np.zeros((8, 2)), np.tile(np.diag([1250.0, 1250.0]), (8, 1, 1)))
    found = _judged(q, np.array([-0.1, 0.3 * off]), np.full(2, 0.3**-2), cut, 200)
    assert found.certain == certain and found.late == pytest.approx(-0.01)


def test_the_sentence_names_size_sign_and_remedy():
    lead = Shift(-0.003, **SURE).sentence(PERIOD)
    assert "shifted by -3 ms" in lead and "`commands_late: -0.003`" in lead and "linear" not in lead
    assert not Shift(0.005, **SURE).notes(PERIOD)  # a drive's delay is for effects to explain
    assert "`hold: linear`" in Shift(-PERIOD / 2, **SURE).sentence(PERIOD)


def test_a_shifted_log_is_resampled_as_its_commands_act():
    (log,) = recorded(count=1, seconds=1.0)
    ramp = dataclasses.replace(log, ctrl=log.time[:, None], metadata={"hold": "linear"})
    for late in (0.005, -0.013):
        even = resample(ramp.shifted(late), PERIOD)
        inside = slice(2, -2)
        np.testing.assert_allclose(even.ctrl[inside, 0], even.time[inside] + PERIOD / 2 - late, atol=1e-9)
        assert even.late == 0 and not even.linear
