"""The motion of a floating base by an inertial unit, encoders and feet, against closed forms and MuJoCo C."""

import dataclasses

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting import observation
from bayessim_mjx.diagnosis.logcheck.noise import noise_of
from bayessim_mjx.diagnosis.phrases import notes
from bayessim_mjx.errors import UserError
from bayessim_mjx.odometry import base, feet, imu, stand
from tests.odometry.floating import BIAS, STOOL, record, swaying


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(STOOL)


@pytest.fixture(scope="module")
def swayed(model):
    log, pose, twist = record(swaying)
    return log, pose, twist, base.estimate(log, model)


def tilts(quats: np.ndarray) -> np.ndarray:
    """Directions against gravity `[T, 3]`, in the base's frame."""
    return np.stack([imu.rotation(q)[2] for q in quats])


def test_a_pendulum_with_an_accelerometer_reads_the_known_formula():
    """At distance L a pendulum's accelerometer reads (L a + g sin q, L w^2 + g cos q); at its pivot gravity alone."""
    xml = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/>
    <geom type="sphere" size=".05" pos="0 0 -.4" mass="1"/><site name="imu" pos="0 0 -.4"/></body></worldbody>
    <sensor><gyro name="g" site="imu"/><accelerometer name="a" site="imu"/></sensor></mujoco>"""
    swing, length, g = mujoco.MjModel.from_xml_string(xml), 0.4, 9.81
    time = np.arange(0.0, 2.0, 0.01)
    q, w, a = 0.5 * np.sin(4 * time), 2.0 * np.cos(4 * time), -8.0 * np.sin(4 * time)
    formula = np.stack([-length * a - g * np.sin(q), 0 * q, length * w**2 + g * np.cos(q)], 1)
    data = mujoco.MjData(swing)
    for k in (0, 50, 130):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], w[k], a[k]
        mujoco.mj_inverse(swing, data)
        mujoco.mj_sensorAcc(swing, data)
        assert data.sensor("a").data == pytest.approx(formula[k], abs=1e-9)
    log, *_ = record(seconds=0.5)
    log = dataclasses.replace(
        log, time=time, **{k: np.zeros((200, n)) for k, n in (("ctrl", 1), ("qpos", 8), ("qvel", 7))}
    )
    columns = [f"{n}[{i}]" for n in ("gyro:g", "accel:a") for i in range(3)]
    (accel, gyro) = imu.of_columns(columns, swing, "run.csv")
    assert accel.place == pytest.approx([0, 0, -length]) and gyro.turn == pytest.approx(np.eye(3))
    rate = np.stack([0 * w, w, 0 * w], 1)
    pivot = base._at_base(log, rate, formula, accel.place)[20:-20]
    assert pivot == pytest.approx(np.stack([-g * np.sin(q), 0 * q, g * np.cos(q)], 1)[20:-20], abs=0.02)


def test_a_robot_at_rest_shows_its_height_and_the_biases(model):
    log, pose, _ = record()
    found = base.estimate(log, model)
    assert np.abs(found.qpos[:, 2] - pose[:, 2]).max() < 2e-3  # m: it sinks into soft ground by half of that
    assert np.abs(tilts(found.qpos[:, 3:]) - tilts(pose[:, 3:])).max() < 3 * found.sd_qpos[:, 3].max() < 0.03
    turn = next(s.turn for s in found.sensors if s.kind == "gyro")
    assert (np.abs(found.gyro_bias - turn @ BIAS) < 3 * found.sd_gyro_bias + 1e-6).all()
    assert found.sd_gyro_bias.max() < 5e-3 and found.points.rests.all()


def test_a_swaying_robot_is_followed_within_its_own_intervals(swayed):
    _, pose, twist, found = swayed
    off = tilts(found.qpos[:, 3:]) - tilts(pose[:, 3:])
    assert np.degrees(np.abs(off).max()) < 1.5 and np.abs(off).max() < 3 * found.sd_qpos[:, 3].max()
    away = np.ptp(np.degrees(np.arcsin(tilts(pose[:, 3:])[:, 0])))
    assert away > 5.0  # degrees: it is the motion that is followed
    height = found.qpos[:, 2] - pose[:, 2]
    assert np.abs(height).max() < 3 * found.sd_qpos[:, 2].max() < 0.01
    wrong = np.stack([imu.rotation(q).T @ v for q, v in zip(found.qpos[:, 3:], found.qvel[:, :3], strict=True)])
    right = np.stack([imu.rotation(q).T @ v for q, v in zip(pose[:, 3:], twist[:, :3], strict=True)])
    assert np.sqrt(np.mean((wrong - right) ** 2)) < 0.02 < 0.2 * np.abs(right).max()
    assert np.sqrt(np.mean((found.qvel[:, 3:] - twist[:, 3:]) ** 2)) < 5e-3  # rad/s: the sensor's noise is 2e-3


def test_place_and_heading_are_never_known(model, swayed):
    """A turned robot reads the same but for its orientation sensor: nothing else of the estimate changes."""
    assert np.isinf(swayed[3].sd_qpos[:, :2]).all() and not swayed[3].heading
    ways = []
    for heading in (0.0, 2.0):
        log, _, _ = record(swaying, seconds=2.0, heading=heading, quat=True)
        found = base.estimate(log, model)
        assert np.isinf(found.sd_qpos[:, :2]).all() and not found.heading
        ways.append(found)
    one, other = ways
    assert tilts(one.qpos[:, 3:]) == pytest.approx(tilts(other.qpos[:, 3:]), abs=1e-4)
    assert one.qpos[:, 2] == pytest.approx(other.qpos[:, 2], abs=1e-4)
    local = [np.stack([imu.rotation(q).T @ v for q, v in zip(w.qpos[:, 3:], w.qvel[:, :3], strict=True)]) for w in ways]
    assert local[0] == pytest.approx(local[1], abs=1e-3)


def test_windows_begin_where_contacts_hold_the_base(model, swayed):
    """Ten times nearer to the simulator's own height and tilt than what was measured tells."""
    log, pose, _, found = swayed
    done, _ = base.completed(log, model)
    height, tilt = done.qpos[:, 2] - pose[:, 2], tilts(done.qpos[:, 3:7]) - tilts(pose[:, 3:])
    assert np.sqrt(np.mean(height**2)) < 2e-4 < 0.2 * found.sd_qpos[:, 2].max()
    assert np.sqrt(np.mean(tilt**2)) < 1e-3 < 0.2 * found.sd_qpos[:, 3].max()
    assert (done.sigma_dofs[:6] < 2e-3).all()


def test_the_depth_of_feet_is_that_of_a_robot_that_stands(model):
    log, pose, _ = record(seconds=0.5)
    stands = np.concatenate([pose[-1], log.qpos[-1, 7:]])
    data = mujoco.MjData(model)
    data.qpos[:] = stands
    mujoco.mj_forward(model, data)
    deep = np.mean([-c.dist for c in data.contact[: data.ncon]])
    high = np.concatenate([pose[-1] + np.array([0, 0, 0.2, 0, 0, 0, 0]), log.qpos[-1, 7:]])
    assert data.ncon == 3 and stand.depth(model, high) == pytest.approx(deep, rel=0.2)


def test_an_orientation_sensor_narrows_the_tilt(model, swayed):
    log, pose, _ = record(swaying, quat=True)
    found = base.estimate(log, model)
    assert found.sd_qpos[:, 3].max() < swayed[3].sd_qpos[:, 3].max()
    assert np.abs(tilts(found.qpos[:, 3:]) - tilts(pose[:, 3:])).max() < 3 * found.sd_qpos[:, 3].max()


def test_rates_are_compared_and_the_rest_of_the_base_is_not(model, swayed):
    log, _, twist, _ = swayed
    (done,), found = observation.completed([log], model)
    assert done.has_qvel and list(done.seen_speeds) == [False] * 3 + [True] * 3 + [False]
    assert list(done.seen_dofs) == [False] * 6 + [True]
    sigma_q, sigma_v, spread = noise_of([done], [done], use_qvel=True)
    assert list(np.isfinite(sigma_q)) == [False] * 6 + [True] and list(np.isfinite(sigma_v)) == [False] * 3 + [
        True
    ] * 3 + [False]
    assert (sigma_v[3:6] > 1e-3).all() and (sigma_v[3:6] < 5e-3).all() and np.isfinite(spread).all()
    assert done.qpos[:, 7:] == pytest.approx(log.qpos[:, 7:]) and len(found) == 1
    text = " ".join(notes.inertial(found, []))
    assert "Its place on the ground and its heading are unknown" in text and "bias is" in text


def test_a_delay_that_is_stated_is_taken_out(model, swayed):
    log, _, twist, _ = swayed
    late = {n: np.interp(log.time - 0.03, log.time, x) for n, x in log.streams.items()}
    stated = dataclasses.replace(log, streams=late, metadata={"imu_late": 0.03})
    right, wrong = (
        base.estimate(own, model).qvel[5:-5, 4] - twist[5:-5, 4]
        for own in (stated, dataclasses.replace(stated, metadata={}))
    )
    assert np.std(right) < 0.5 * np.std(wrong)


def test_a_base_that_a_weld_holds_has_no_motion_to_estimate(swayed):
    held = mujoco.MjModel.from_xml_string(
        STOOL.replace("</worldbody>", "</worldbody><equality><weld body1='trunk'/></equality>")
    )
    (done,), found = observation.completed([swayed[0]], held)
    assert done.qpos[:, :7] == pytest.approx(np.tile(held.qpos0[:7], (len(done), 1))) and not found
    assert not done.has_qvel and not done.seen_dofs[:6].any() and (done.sigma_dofs[:6] < 1e-3).all()


def test_a_stand_that_leans_shows_in_the_accelerometer(swayed):
    fixed = mujoco.MjModel.from_xml_string(STOOL.replace('<freejoint name="root"/>', ""))
    time, lean = np.arange(0.0, 2.0, 0.02), 0.1
    rng = np.random.default_rng(0)
    pulls = 9.81 * np.array([0.0, -np.sin(lean), np.cos(lean)]) + 0.02 * rng.normal(size=(100, 3))
    streams = {f"accel:pulls[{i}]": x for i, x in enumerate(pulls.T)}
    streams |= {f"gyro:turns[{i}]": 0.002 * rng.normal(size=100) for i in range(3)}
    log = dataclasses.replace(swayed[0].cut(0, 100), time=time, streams=streams)
    found = stand.measure(log, fixed)
    assert found.lean == pytest.approx(lean, abs=2e-3) and found.shake < 3e-3
    assert found.sensors == ("accel:pulls", "gyro:turns")
    text = " ".join(notes.inertial([], [found, None]))
    assert "leans by 5.7 deg" in text and "tilt the model's gravity" in text
    assert notes.inertial([], [dataclasses.replace(found, lean=0.01)])[-1].endswith("rad/s (rms)")
    measured = stand.measure(swayed[0], mujoco.MjModel.from_xml_string(STOOL))
    assert "gyro:turns: not compared, for other channels" in notes.inertial([], [measured])[0].replace(
        "accel:pulls and ", ""
    )
    bare = mujoco.MjModel.from_xml_string(STOOL[: STOOL.index("<sensor>")].replace('name="imu"', "") + "</mujoco>")
    assert "set aside: run.csv: column 'accel:pulls[0]'" in notes.inertial([], [stand.measure(log, bare)])[0]
    assert stand.measure(dataclasses.replace(log, streams={}), fixed) is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda xml: xml.replace('<geom name="floor" type="plane" size="5 5 .1" contype="1"/>', ""), "no planes"),
        (lambda xml: xml.replace('type="plane" size', 'type="plane" euler="5 0 0" size'), "'floor' is not level"),
        (lambda xml: xml.replace('gyro name="turns"', 'gyro name="other"'), "'gyro:turns.0.'.*other"),
    ],
)
def test_what_cannot_be_estimated_is_refused_by_name(swayed, change, words):
    with pytest.raises(UserError, match=words):
        base.estimate(swayed[0], mujoco.MjModel.from_xml_string(change(STOOL)))


def test_a_missing_sensor_is_named(model, swayed):
    only = {n: x for n, x in swayed[0].streams.items() if n.startswith("gyro")}
    with pytest.raises(UserError, match="'root' was not measured, and there is no accelerometer on body 'trunk'"):
        base.estimate(dataclasses.replace(swayed[0], streams=only), model)
    part = {n: x for n, x in swayed[0].streams.items() if n != "gyro:turns[1]"}
    with pytest.raises(UserError, match=r"allowed: all of gyro:turns\[0\], gyro:turns\[1\]"):
        base.estimate(dataclasses.replace(swayed[0], streams=part), model)


def test_a_unit_without_a_name_is_the_only_one(model, swayed):
    bare = {n.replace(":turns", "").replace(":pulls", ""): x for n, x in swayed[0].streams.items()}
    found = base.estimate(dataclasses.replace(swayed[0], streams=bare), model)
    assert found.qpos == pytest.approx(swayed[3].qpos)


def test_a_lifted_foot_does_not_rest(model):
    """Tilted about its rear feet by 10 degrees the front one hangs 4.5 cm above ground."""
    log, _, _ = record(seconds=0.5)
    half = np.radians(-10.0) / 2
    attitude = np.tile([np.cos(half), 0.0, np.sin(half), 0.0], (len(log), 1))
    found = feet.measured(model, log, attitude, np.tile([0.0, 0.0, 9.81], (len(log), 1)), (), None)
    assert dict(zip(found.names, found.rests.all(axis=0), strict=True)) == {"ahead": False, "left": True, "right": True}
    falling = feet.measured(model, log, attitude, np.zeros((len(log), 3)), (), None)
    assert not falling.rests.any()
