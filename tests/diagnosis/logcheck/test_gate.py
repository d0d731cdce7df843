"""The data gate: good logs pass, each fault is named, and real logs with known faults are told from good ones."""

import dataclasses
import re

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.logcheck.gate import Gate, check
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import Log
from bayessim_mjx.logs.signals import noise_level
from tests.diagnosis.recordings import ARM, PENDULUM, record, sines

DT = 0.01


def model(xml: str = PENDULUM) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(xml)


@pytest.fixture(scope="module")
def good() -> Log:
    return record(PENDULUM, sines((1.5,)), qvel=True)


@pytest.fixture(scope="module")
def arm() -> Log:
    return record(ARM, sines((3.0, 0.6)), qvel=True)


def judge(log: Log, xml: str = PENDULUM) -> Gate:
    return check([log], model(xml), DT)


def refused(log: Log, *words: str, xml: str = PENDULUM) -> None:
    gate = judge(log, xml)
    assert not gate.usable and not gate.use_qvel
    for word in words:
        assert word in gate.refused[log.name], gate.refused
    with pytest.raises(UserError, match=log.name):
        gate.demand()


def warned(log: Log, *words: str, xml: str = PENDULUM) -> Gate:
    gate = judge(log, xml)
    assert gate.usable == (log,) == gate.demand(), gate.refused
    assert any(all(w in text for w in words) for text in gate.warnings), gate.warnings
    return gate


def test_exchanged_commands_are_named(arm: Log) -> None:
    """Only with them exchanged the inverse dynamics explain the efforts."""
    said = " ".join(judge(dataclasses.replace(arm, ctrl=arm.ctrl[:, ::-1]), ARM).warnings)
    assert "are the columns swapped? Exchanged commands would explain 100 %" in said
    said = " ".join(judge(dataclasses.replace(arm, qpos=arm.qpos[:, ::-1], qvel=arm.qvel[:, ::-1]), ARM).warnings)
    assert "are the columns swapped? Exchanged positions would explain" in said


def test_good_logs_pass_without_a_word(good: Log, arm: Log) -> None:
    for log, xml in ((good, PENDULUM), (arm, ARM)):
        gate = judge(log, xml)
        assert gate.usable == (log,) and not gate.warnings and not gate.findings
        assert gate.use_qvel and all(gate.qvel.values())
        for relation in gate.reports[0].relations:
            assert relation.explained is not None and relation.explained > 0.98, relation


@pytest.mark.parametrize("scale", [0.6, 1.6])
def test_a_wrong_nominal_model_is_no_fault_of_the_log(arm: Log, scale: float) -> None:
    other = model(ARM)
    other.body_mass[1] *= scale
    other.body_inertia[1] *= scale
    other.body_mass[2] *= 1.5 / scale
    other.body_inertia[2] *= 1.5 / scale
    gate = check([arm], other, DT)
    assert gate.usable and all((r.explained or 0) > 0.9 for r in gate.reports[0].relations)


def test_heavy_friction_is_no_fault_of_the_log() -> None:
    log = record(PENDULUM.replace('frictionloss="0.05"', 'frictionloss="0.8"'), sines((3.0,)))
    gate = judge(log)
    assert gate.usable and (gate.reports[0].relations[0].explained or 0) > 0.9


def test_a_servo_has_no_effort_to_compare() -> None:
    servo = PENDULUM.replace("<motor", '<position kp="8" kv="0.3"')
    log = record(servo, sines((0.5,)))
    gate = judge(log, servo)
    assert gate.usable and not gate.reports[0].relations
    # a torque model, but the log's controller makes the command a target
    target = dataclasses.replace(log, metadata={"controller": {"law": "position", "kp": 8}})
    assert not judge(target).reports[0].relations


def test_what_was_not_compared_is_said_once_for_all_logs(arm: Log) -> None:
    still = [dataclasses.replace(arm.cut(0, 60), name=f"run{i}") for i in range(8)]
    gate = check(still, model(ARM), DT)
    told = [w for w in gate.warnings if "not compared" in w]
    assert len(told) == 1, gate.warnings
    assert "run0, run1, run2, run3, run4, run5 and 2 more" in told[0] and all(joint in told[0] for joint in arm.joints)


def test_a_pendulum_that_only_falls_is_not_refused() -> None:
    log = record(PENDULUM, lambda t, q, v: np.array([0.002 * np.sin(3 * t) + (2.0 if t < 0.3 else 0.0)]))
    rest = log.cut(60, len(log))
    warned(rest, "effort of hinge", "hardly changes")


def test_an_effort_of_another_run_is_refused(good: Log) -> None:
    other = record(PENDULUM, sines((1.5,), pace=0.8, seed=5))
    refused(dataclasses.replace(good, ctrl=other.ctrl), "effort unrelated to motion", "unexplained by any model")


def test_the_effort_stream_counts_where_there_is_one(good: Log) -> None:
    current = {"effort:motor": 37.0 * good.ctrl[:, 0]}  # any unit
    targets = dataclasses.replace(good, streams=current, metadata={"controller": {"law": "position", "kp": 8}})
    (relation,) = judge(targets).reports[0].relations
    assert relation.source == "effort" and (relation.explained or 0) > 0.95
    shuffled = {"effort:motor": record(PENDULUM, sines((1.5,), pace=0.8, seed=5)).ctrl[:, 0]}
    gate = judge(dataclasses.replace(targets, streams=shuffled))
    assert gate.warnings


def test_the_reason_names_what_would_mend_it(good: Log) -> None:
    late = dataclasses.replace(good, ctrl=np.roll(good.ctrl, 30, axis=0))
    refused(late, "shifting the command by -0.30", "s would explain")
    refused(dataclasses.replace(good, ctrl=-good.ctrl), "the opposite sign would explain")
    warned(dataclasses.replace(good, ctrl=20 * good.ctrl), "no model explains", "another scale")
    degrees = dataclasses.replace(good, qpos=np.degrees(good.qpos), qvel=np.degrees(good.qvel))
    refused(degrees, "positions in degrees would explain")


def test_commands_in_a_unit_that_the_log_declares_are_forces_of_the_model(good: Log) -> None:
    counts = dataclasses.replace(good, ctrl=20 * good.ctrl)
    warned(counts, "no model explains")
    declared = judge(dataclasses.replace(counts, metadata={"controller": {"law": "direct", "scale": 0.05}}))
    assert declared.usable and not declared.warnings and (declared.reports[0].relations[0].explained or 0) > 0.98


def test_one_hidden_push_leaves_the_rest_usable(good: Log) -> None:
    rows = np.arange(len(good)) > 450
    pushed = good.ctrl - np.where(rows, 8 * np.sin(7 * good.time) * good.ctrl[:, 0], 0.0)[:, None]
    refused(dataclasses.replace(good, ctrl=pushed), "the part from 0.0 to 4.0 s", "cut the file")


def test_a_delay_is_a_finding_not_a_fault() -> None:
    log = record(PENDULUM, sines((1.5,)), delay=0.05)
    gate = judge(log)
    assert gate.usable and not gate.warnings
    (text,) = gate.findings
    assert re.search("hinge follows its command (49|50|51) ms late", text)  # the hold's half row is no delay
    assert gate.reports[0].relations[0].delay == pytest.approx(0.05, abs=2e-3)
    faster = judge(record(PENDULUM, sines((1.5,)), delay=0.03)).reports[0]
    (both,) = dataclasses.replace(gate, reports=(*gate.reports, faster)).findings
    assert both.count("late") == 1 and re.search("(29|30|31) to (49|50|51) ms late", both)


def test_clocks_that_disagree_are_warned_about() -> None:
    log = record(PENDULUM, sines((1.5,), pace=0.15), seconds=16.0, delay=0.4)
    gate = judge(log)
    assert gate.reports[0].relations[0].lag == pytest.approx(0.4, abs=0.02)
    assert any("do the clocks agree" in w for w in gate.warnings)


def test_too_little_data(good: Log) -> None:
    refused(good.cut(0, 15), "too short", "15 rows")
    refused(dataclasses.replace(good, time=40 * good.time), "one row per 0.4 s")
    refused(dataclasses.replace(good, streams={"enabled:motor": np.zeros(len(good))}), "drive is off")
    coarse = dataclasses.replace(good.cut(0, 400), time=good.time[:400] * 2)
    assert any("one row per 0.02 s" in w for w in judge(coarse).warnings) or judge(coarse).refused


def test_still_channels(good: Log, arm: Log) -> None:
    refused(dataclasses.replace(good, qpos=np.zeros((len(good), 1))), "nothing moves: hinge")
    held = record(ARM, lambda t, q, v: np.array([3 * np.sin(3 * t), 0.25]))
    warned(held, "ctrl:m_elbow never changes (0.25)", xml=ARM)
    qpos = arm.qpos.copy()
    qpos[:, 1] = 0.0
    assert any(
        "qpos:elbow never moves" in f.text for f in judge(dataclasses.replace(arm, qpos=qpos), ARM).reports[0].remarks
    )


@pytest.mark.parametrize("grain", [0.0, 5e-4])
def test_noise_is_no_motion_however_long_the_logs_are(arm: Log, grain: float) -> None:
    """The range of noise grows with the rows: of 2000 values it is beyond six standard deviations."""
    rng, rows, parts = np.random.default_rng(1), 2000, {"ctrl": np.zeros((2000, 2)), "qvel": np.zeros((2000, 2))}
    still = []
    for i in range(6):
        noise = 5e-4 * rng.normal(size=(rows, 2))
        qpos = [0.3, -0.1] + (np.round(noise / grain) * grain if grain else noise)
        sigma = np.array([noise_level(x) for x in qpos.T])
        own = dataclasses.replace(
            arm, name=f"run{i}", time=0.01 * np.arange(rows), qpos=qpos, sigma_qpos=sigma, **parts
        )
        still.append(dataclasses.replace(own, has_qvel=False))
    assert any(np.ptp(log.qpos, axis=0).max() > 6.0 * log.sigma_qpos.max() for log in still)
    found = check(still, model(ARM), DT)
    assert not found.usable and all("nothing moves: shoulder, elbow" in why for why in found.refused.values())
    creeping = still[0].qpos + 2e-3 * np.sin(2.0 * still[0].time)[:, None] * [0.0, 1.0]
    moved = check([dataclasses.replace(still[0], qpos=creeping), *still[1:]], model(ARM), DT)
    assert [log.name for log in moved.usable] == ["run0"]
    assert any("qpos:shoulder never moves" in text for text in moved.warnings)


def test_jitter_and_clipping(good: Log) -> None:
    time = good.time + np.where(np.arange(len(good)) % 4 == 0, 0.004, 0.0)
    warned(dataclasses.replace(good, time=time), "50 % of the steps are more than 20 % off")
    top = 0.5 * float(good.qpos.max())
    gate = judge(dataclasses.replace(good, qpos=np.minimum(good.qpos, top)))
    assert any("qpos:hinge is clipped at" in f.text for f in gate.reports[0].remarks), gate.reports
    assert not any("clipped" in w for w in judge(good).warnings)


def test_wrapped_registers(good: Log) -> None:
    raw = np.round(300 * good.ctrl[:, 0])
    wrapped = raw % 65536
    refused(dataclasses.replace(good, streams={"effort:motor": wrapped}), "effort:motor", "signed 16-bit", "signed: 16")
    refused(dataclasses.replace(good, streams={"effort:motor": wrapped / 885}), "signed 16-bit")
    warned(dataclasses.replace(good, streams={"temperature": wrapped}), "temperature jumps by", "signed 16-bit")
    assert not judge(dataclasses.replace(good, streams={"effort:motor": raw})).warnings


def test_units_by_magnitude(good: Log) -> None:
    servo = PENDULUM.replace("<motor", '<position kp="8" kv="0.3"')  # no effort that could tell
    fast = record(servo, lambda t, q, v: np.array([2.0 * np.sin(6 * t)]))
    degrees = dataclasses.replace(fast, qpos=np.degrees(fast.qpos), qvel=np.degrees(fast.qvel))
    warned(degrees, "qpos:hinge moves at", "degrees or counts", xml=servo)


@pytest.mark.parametrize(
    ("change", "usable"),
    [
        (lambda v: v, True),
        (lambda v: np.degrees(v), False),
        (lambda v: -v, False),
        (lambda v: np.roll(v, 4, axis=0), False),
        (lambda v: v + 0.2 * np.random.default_rng(0).standard_normal(v.shape), True),
    ],
)
def test_velocities_that_are_not_the_derivative_are_left_alone(good: Log, change, usable: bool) -> None:
    gate = judge(dataclasses.replace(good, qvel=change(good.qvel)))
    assert gate.usable and gate.use_qvel is usable and gate.qvel == {"hinge": usable}
    assert usable or any("qvel:hinge" in w and "positions are used" in w for w in gate.warnings)
    velocity = gate.reports[0].velocities[0]
    assert velocity.lag == pytest.approx(0.04 if change(np.arange(9.0))[0] == 5 else 0.0, abs=0.006)


def test_several_logs_and_a_bad_step(good: Log) -> None:
    bad = dataclasses.replace(good, name="bad.npz", ctrl=-good.ctrl)
    gate = check([good, bad], model(), DT)
    assert gate.usable == (good,) and list(gate.refused) == ["bad.npz"] and gate.use_qvel
    assert gate.warnings[0].startswith("bad.npz: refused: ")
    with pytest.raises(UserError, match="dt = 0"):
        check([good], model(), 0)
    with pytest.raises(UserError, match="no usable log: no logs were given"):
        check([], model(), DT).demand()


ON_A_RAIL = """
<mujoco><option timestep="0.001"/><worldbody><body><joint name="rail" type="slide" axis="1 0 0" damping="1"/>
  <geom size=".1" mass="1" contype="0" conaffinity="0"/></body></worldbody>
<actuator>%s</actuator></mujoco>"""


PUSHED, FOLLOWING = (
    ON_A_RAIL % '<motor name="m" joint="rail"/>',
    ON_A_RAIL % '<position name="m" joint="rail" kp="400" kv="40"/>',
)


def told(log: Log, xml: str) -> str:
    gate = judge(log, xml)
    assert gate.usable
    return " ".join([*gate.warnings, *gate.findings])


def test_a_servo_that_holds_its_target_is_not_clipped() -> None:
    """Ramps between two targets, read by a coarse encoder; a stop is where other targets end on the same value."""
    stiff = FOLLOWING.replace('kp="400" kv="40"', 'kp="40000" kv="400"')

    def follows(target):
        log = record(stiff, lambda t, q, v: np.array([target(t)]), sigma=0.0)
        return dataclasses.replace(log, qpos=np.round(log.qpos, 2))

    assert "clipped" not in told(follows(lambda t: np.clip(0.6 * np.sin(2 * t), -0.3, 0.3)), stiff)
    free = follows(lambda t: 0.6 * np.sin(2 * t))
    assert "a hard stop" in told(dataclasses.replace(free, qpos=np.clip(free.qpos, -0.3, 0.3)), stiff)


def test_what_moves_fast_is_not_told_to_be_in_millimetres() -> None:
    """120 N on 1 kg for a second, back and forth: some 60 m/s."""
    fast = record(PUSHED, lambda t, q, v: np.array([120.0 * np.sign(np.sin(3 * t))]), sigma=1e-3)
    assert np.percentile(np.abs(fast.qvel), 99) > 50 and "millimetres" not in told(fast, PUSHED)
    follows = record(FOLLOWING.replace("400", "4000"), lambda t, q, v: np.array([9.0 * np.sin(9 * t)]))
    assert "millimetres" not in told(follows, FOLLOWING)
    slow = record(FOLLOWING, lambda t, q, v: np.array([0.3 * np.sin(3 * t)]))
    noisy = dataclasses.replace(slow, time=slow.time + np.where(np.arange(len(slow)) % 9, 0.0, 0.0099))
    assert "millimetres" not in told(noisy, FOLLOWING)  # jitter of the stamps is no speed
    millimetres = dataclasses.replace(slow, qpos=1e3 * slow.qpos, qvel=1e3 * slow.qvel)
    assert "millimetres" in told(millimetres, FOLLOWING)


def laden(mass: float) -> str:
    """The arm with a load beyond its end."""
    load = f'<geom type="sphere" size=".03" mass="{mass}" pos="0 0 -.45" contype="0" conaffinity="0"/></body></body>'
    return ARM.replace("</body></body>", load, 1)


def test_a_load_is_no_fault_of_the_log() -> None:
    """1.2 kg, half as much again as the link."""
    gate = judge(record(laden(1.2), sines((6.0, 4.0)), seconds=12.0), ARM)
    assert gate.usable and not gate.warnings, gate.warnings


@pytest.mark.parametrize(("pace", "mass"), [(5.0, 0.9), (2.0, 0.6)])
def test_clocks_that_agree_are_not_doubted_for_a_load(pace: float, mass: float) -> None:
    """A periodic motion fits a quarter of a period later as well, and better where the model is wrong."""
    log = record(laden(mass), lambda t, q, v: np.array([6.0 * np.sin(pace * t), 2.0 * np.sin(pace * t + 1.0)]))
    assert not told(log, ARM)
