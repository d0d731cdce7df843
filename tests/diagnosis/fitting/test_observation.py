"""Joints that were not measured: their motion from that of the others, and what cannot be told."""

import dataclasses

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.equation_error import inverse_dynamics_check
from bayessim_mjx.diagnosis.fitting import observation
from bayessim_mjx.diagnosis.fitting.robot import robot_of
from bayessim_mjx.diagnosis.logcheck import gate, links
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import Log, read_logs, write_log
from tests.diagnosis.recordings import ARM, record, sines

COARSE = ARM.replace('timestep="0.001"', 'timestep="0.005"')
APART = """<mujoco><option timestep="0.005"/><worldbody>
  <body><joint name="shoulder" axis="0 1 0"/><geom size=".05" pos="0 0 -.4" contype="0"/></body>
  <body pos="1 0 0"><joint name="elbow" axis="0 1 0"/><geom size=".05" pos="0 0 -.4" contype="0"/></body>
</worldbody><actuator><motor name="m_shoulder" joint="shoulder"/><motor name="m_elbow" joint="elbow"/></actuator>
</mujoco>"""
LEG = """<mujoco><option timestep="0.005"/><worldbody>
  <body><joint name="hip" type="{}"/><geom size=".05" pos="0 0 -.4" contype="0"/>
    <body pos="0 0 -.4"><joint name="knee" axis="0 1 0"/><geom size=".05" pos="0 0 -.3" contype="0"/></body></body>
</worldbody><actuator><motor name="m_knee" joint="knee"/></actuator></mujoco>"""


def recorded(xml: str = COARSE, qvel: bool = False) -> Log:
    return record(xml, sines((4.0, 1.5)), seconds=1.6, period=0.02, name="run.csv", qvel=qvel)


def without(log: Log, *absent: str) -> Log:
    """As read from a file without these columns."""
    seen = [np.array([f"{kind}:{n}" not in absent for n in log.joints]) for kind in ("qpos", "qvel")]
    qvel = log.qvel * (seen[1] if log.has_qvel else seen[0])
    return dataclasses.replace(log, qpos=log.qpos * seen[0], qvel=qvel, absent=absent)


@pytest.fixture(scope="module")
def arm() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(COARSE)


def test_a_log_of_all_positions_stays_the_object_that_it_is(arm):
    log = recorded()
    assert observation.completed([log], arm)[0] == (log,)


def test_an_elbow_is_found_from_the_shoulder_and_its_error_is_stated(arm):
    log = recorded()
    (found,), _ = observation.completed([without(log, "qpos:elbow")], arm)
    error = found.qpos - log.qpos
    assert (error[:, 0] == 0).all() and not found.has_qvel
    assert np.sqrt(np.mean(error[:, 1] ** 2)) < min(0.02, found.sigma_qpos[1])
    assert np.ptp(log.qpos[:, 1]) > 50 * found.sigma_qpos[1]
    assert list(found.seen_dofs) == [True, False] and not found.seen_speeds.any()


def test_a_joint_with_a_velocity_alone(arm):
    log = recorded(qvel=True)
    log = dataclasses.replace(log, sigma_qvel=np.full(2, 1e-3))
    (found,), _ = observation.completed([without(log, "qpos:elbow", "qvel:shoulder")], arm)
    assert np.abs(found.qpos[:, 1] - log.qpos[:, 1]).max() < 0.02
    assert (found.qvel[:, 1] == log.qvel[:, 1]).all() and list(found.seen_speeds) == [False, True]
    seen = gate.check([found], arm, 0.02)
    assert seen.usable and seen.use_qvel  # no position is there that could contradict it


def test_checks_that_need_the_motion_of_all_joints_are_said_to_be_left_out(arm):
    look = inverse_dynamics_check.looked([without(recorded(), "qpos:elbow")], robot_of(arm))
    assert not look.proposals and "left out: they need the motion of all joints, and qpos:elbow was not" in look.note


def test_checks_go_on_without_the_velocity_of_a_joint_whose_position_was_measured(tmp_path, arm):
    """They differentiate positions: a velocity column more or less changes what they say of no joint."""
    log = record(COARSE, sines((4.0, 1.5)), seconds=3.0, period=0.02, qvel=True)
    for name, absent in (("whole", ()), ("part", ("qvel:elbow",))):
        write_log(tmp_path / name / "run.csv", dataclasses.replace(log, absent=absent))
    (whole,), (part,) = (read_logs(tmp_path / name, arm, partial=True) for name in ("whole", "part"))
    assert part.absent == ("qvel:elbow",) and observation.completed([part], arm)[0] == (part,)
    looks = [inverse_dynamics_check.looked([one], robot_of(arm)) for one in (whole, part)]
    assert not looks[1].note and [j.name for j in looks[1].joints] == ["shoulder", "elbow"]
    for before, after in zip(looks[0].joints, looks[1].joints, strict=True):
        assert after.needs == pytest.approx(before.needs, rel=0.01) == pytest.approx(1.0, abs=0.1)
    assert [r.joint for r in gate.check([part], arm, 0.02).reports[0].relations] == ["shoulder", "elbow"]
    assert {link.where for link in links.links(part, arm, gate.check([part], arm, part.period).timing)} >= {
        "shoulder",
        "elbow",
    }


@pytest.mark.parametrize(("kind", "last"), [("ball", 3), ("free", 6)])
def test_a_ball_or_free_joint_has_to_be_measured(tmp_path, kind, last):
    xml = LEG.format(kind)
    model = mujoco.MjModel.from_xml_string(xml)
    part = unseen_hip(record(xml, sines((2.0,)), seconds=0.4, period=0.02, name="run.csv"), model)
    with pytest.raises(
        UserError, match=rf"run\.csv: {kind} joint 'hip' was not measured; allowed: all of qpos:hip\[0\]"
    ):
        observation.completed([part], model)
    write_log(tmp_path / "run.csv", part)
    with pytest.raises(
        UserError, match=rf"run\.csv: missing.* qpos:hip\[{last}\]; allowed: all {last + 1} of .*'hip'.* \(only"
    ):
        read_logs(tmp_path, model, partial=True)


def unseen_hip(log: Log, model: mujoco.MjModel) -> Log:
    own, fast = (log.channels.columns("hip", kind) for kind in ("qpos", "qvel"))
    qpos, qvel = log.qpos.copy(), log.qvel.copy()
    qpos[:, own], qvel[:, fast] = model.qpos0[own], 0.0
    absent = tuple(f"qpos:{name}" for name in log.channels.of_joint("hip"))
    return dataclasses.replace(log, qpos=qpos, qvel=qvel, absent=absent)


def test_what_the_logs_cannot_tell_is_refused_by_name():
    model = mujoco.MjModel.from_xml_string(APART)
    with pytest.raises(UserError, match=r"run\.csv: .*\(qpos:shoulder\) does not determine the motion of elbow;"):
        observation.completed([without(recorded(APART), "qpos:elbow")], model)


def test_files_may_lack_columns_where_that_is_asked_for(tmp_path, arm):
    log = recorded(qvel=True)
    write_log(tmp_path / "run.csv", without(log, "qpos:elbow", "qvel:shoulder"))
    with pytest.raises(UserError, match=r"missing column\(s\) qpos:elbow, qvel:shoulder"):
        read_logs(tmp_path, arm)
    with pytest.warns(UserWarning, match="no column qpos:elbow: this motion is estimated"):
        (read,) = read_logs(tmp_path, arm, partial=True)
    assert read.absent == ("qpos:elbow", "qvel:shoulder") and read.has_qvel
    assert np.allclose(read.qvel[:, 1], log.qvel[:, 1]) and np.allclose(read.qpos[:, 0], log.qpos[:, 0])
    columns = np.loadtxt(tmp_path / "run.csv", delimiter=",", skiprows=1)
    np.savetxt(
        tmp_path / "run.csv", columns[:, :3], "%.9g", ",", header="time,ctrl:m_shoulder,ctrl:m_elbow", comments=""
    )
    with pytest.raises(UserError, match="no column qpos:<joint> or qvel:<joint>, so there is no motion"):
        read_logs(tmp_path, arm, partial=True)


def test_of_long_logs_only_as_much_is_filtered_as_the_windows_hold(arm):
    """Twelve seconds, whatever the logs' length; each log gives its share, and the elbow is found as in short ones."""
    long = [
        without(record(COARSE, sines((4.0, 1.5)), seconds=s, period=0.02, name=f"{s}.csv"), "qpos:elbow")
        for s in (20.0, 40.0)
    ]
    short, (text,) = observation.shortened(long, 12.0)
    assert [log.duration for log in short] == pytest.approx([4.0, 8.0], abs=0.05)
    assert "of 20.0.csv the first 3.98 of 20 s, of 40.0.csv the first 8 of 40 s are used" in text
    whole = record(COARSE, sines((4.0, 1.5)), seconds=20.0, period=0.02)
    assert observation.shortened([whole], 12.0) == ((whole,), [])  # all joints were measured
    assert observation.shortened(short, 12.0) == (short, [])  # nothing is gained
    found, _ = observation.completed(short, arm)
    assert [len(log) for log in found] == [len(log) for log in short]
    error = found[0].qpos[:, 1] - whole.qpos[: len(found[0]), 1]
    assert np.sqrt(np.mean(error**2)) < min(0.02, found[0].sigma_qpos[1])
