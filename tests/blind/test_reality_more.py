"""Causes in links, ground and drives against what is worked out by hand."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.blind.reality.bodies import ground, lift
from bayessim_mjx.blind.reality.drives import quickest
from bayessim_mjx.blind.reality.menu import places
from bayessim_mjx.blind.reality.plant import Plant
from bayessim_mjx.blind.reality.system import System
from tests.blind.arms import ARM, FALL, GRAVITY, LENGTH, MASS, MOTOR, SERVO, arm, hidden, sole


def still(plant: Plant, q: float, u: float = 0.0) -> float:
    """Acceleration of the only joint at rest, rad/s^2, by a sub-step so short that it stays there."""
    plant.model.opt.timestep = 1e-7
    plant.reset(np.array([q]), np.zeros(1), np.array([u]))
    plant.advance(np.array([u]), 1)
    return float(plant.data.qvel[0]) / 1e-7


def test_bristles_slide_by_their_steady_law_and_bend_before():
    cause = hidden(arm(), "lugre_friction", 0.05, ratio=1.6, speed=0.4, stiffness=0.08 / 0.02)
    plant = Plant(arm(), {}, [cause])
    told = cause.parameters()
    assert told == pytest.approx({"level": 0.05, "excess": 0.03, "speed": 0.4, "bend": 0.02})
    cause.reset(plant, np.zeros(1))
    # a spring of (level + excess) / bend, and its damper, as long as the way is short beside the bend
    slow = 1e-3
    forces = [cause.bristle.step(slow, cause.level(plant, slow)) for _ in range(200)]
    z = slow * 200 * plant.timestep
    assert forces[-1] == pytest.approx(-(0.08 / 0.02 * z + cause.bristle.s1 * slow), rel=2e-2)
    for w in (0.05, 0.3, -2.0):  # then level + excess exp(-(w / speed)^2), against the motion
        for _ in range(round(1.0 / abs(w) / plant.timestep)):
            force = cause.bristle.step(w, cause.level(plant, w))
        assert force == pytest.approx(-np.sign(w) * (0.05 + 0.03 * np.exp(-((w / 0.4) ** 2))), rel=1e-3)


def test_bristles_are_bent_by_the_motion_before_a_window():
    rig = arm()
    cause = hidden(rig, "lugre_friction", 0.05, stiffness=1.5)
    plant = Plant(rig, {}, [cause])
    run = rig.record(plant, 0, 0, noise=False)
    bent, bristle = cause.bristle.z, cause.bristle
    plant.reset(run.clean[-1], run.clean_v[-1], run.ctrl[-1])
    assert cause.bristle is not bristle and cause.bristle.z == 0.0
    plant.resume(run, len(run.time) - 1)
    plant.advance(run.ctrl[-1])  # a recording ends a row after its last one
    assert cause.bristle.z == pytest.approx(bent, rel=2e-2) and abs(bent) > 0.01


def test_bristles_hold_a_load_that_rests_on_them_from_the_start():
    rig = arm()
    cause = hidden(rig, "lugre_friction", 0.4, ratio=1.0, stiffness=4.0)
    plant = Plant(rig, {}, [cause])
    plant.reset(np.array([0.2]), np.zeros(1), np.zeros(1))
    for _ in range(25):
        plant.advance(np.zeros(1))
    weight = MASS * GRAVITY * LENGTH * np.sin(0.2)
    assert plant.link()[0][0] == pytest.approx(0.2, abs=1e-6)
    assert cause.bristle.z == pytest.approx(-weight / 0.4 * 0.1, rel=1e-3)


def test_a_cable_pulls_on_one_side_of_its_angle():
    cause = hidden(arm(), "cable_tension", 2.0, taut=0.3, side=1.0, other=0.25)
    assert cause.parameters() == {"forward": 2.0, "backward": 0.5, "taut": 0.3}
    plain = Plant(arm(), {})
    inertia = 1 / float(plain.model.dof_invweight0[0])
    for q in (0.3, 0.9, -0.4):
        pull = -2.0 * max(q - 0.3, 0) + 0.5 * max(0.3 - q, 0)
        assert inertia * (still(Plant(arm(), {}, [cause]), q) - still(Plant(arm(), {}), q)) == pytest.approx(
            pull, abs=1e-4
        )


def test_a_share_of_the_weight_is_carried():
    cause = hidden(arm(), "gravity_compensation", 0.3, sign=1.0)
    for q in (0.4, -1.2):
        weight = MASS * GRAVITY * LENGTH * np.sin(q)  # falls back to hanging
        held = still(Plant(arm(), {}, [cause]), q, u=0.7 * weight)
        assert held == pytest.approx(0.0, abs=1e-5)


def test_of_two_links_each_joint_carries_what_lies_beyond():
    text = ARM.format(MOTOR).replace("</body></body>", '<body name="end" pos="0 0 -.4"><joint name="tip" axis="0 1 0"/>'
        '<inertial pos="0 0 -.1" mass=".3" diaginertia=".001 .001 .001"/></body></body></body>')  # fmt: skip
    rig = System("two", text, 0.02, False, (3.0,), (0.3,), (0.6,), (1.0,), 0.5, (4e-4,) * 2)
    plant = Plant(rig, {}, [hidden(rig, "gravity_compensation", 1.0, sign=1.0)])
    plant.reset(np.array([0.5, 0.8]), np.zeros(2), np.zeros(1))
    for _ in range(20):
        plant.advance(np.zeros(1))
    np.testing.assert_allclose(plant.link()[0], [0.5, 0.8], atol=1e-9)  # weightless, it stays where it is


def test_a_shifted_centre_of_mass_changes_weight_and_period():
    cause = hidden(arm(), "inertial_parameters", 0.02, direction=np.array([0.6, 0.0, -0.8]))
    cause.swell = 0.25 * cause.largest / cause.size
    told = cause.parameters()
    assert told == pytest.approx({"com_x": 0.012, "com_y": 0.0, "com_z": -0.016, "inertia": 1.25})
    plant = Plant(arm(), {"link.mass": 1.1}, [cause])
    x, z, mass = 0.012, -LENGTH - 0.016, 1.1 * MASS
    inertia = 0.006 + 1.25 * 1.1 * 0.008 + mass * (x * x + z * z)
    at_rest = np.arctan2(x, -z)  # where the centre of mass hangs below the hinge
    assert still(plant, at_rest) == pytest.approx(0.0, abs=1e-6)
    assert still(plant, 0.0) == pytest.approx(mass * GRAVITY * x / inertia, rel=1e-6)
    small = still(plant, at_rest + 1e-3) / -1e-3  # w^2 = m g l / I
    assert small == pytest.approx(mass * GRAVITY * np.hypot(x, z) / inertia, rel=1e-4)


@pytest.mark.parametrize("compiler", ["", '<compiler inertiafromgeom="true"/>'])
def test_other_links_stay_as_they_are_compiled(compiler):
    text = ARM.format(MOTOR).replace("<mujoco>", f"<mujoco>{compiler}")
    text = text.replace(
        '.008 .001"/>', '.008 .001"/><geom name="rod" type="capsule" fromto="0 0 0 .1 .2 -.3" size=".02"/>'
    )
    rig = System("arm", text, 0.02, False, (3.0,), (0.3,), (0.6,), (1.0,), 0.5, (4e-4,))
    plain, cause = Plant(rig, {}), hidden(rig, "inertial_parameters", 0.01)
    moved = Plant(rig, {}, [cause])
    for field in ("body_mass", "body_inertia", "body_ipos", "body_iquat"):
        was, now = getattr(plain.model, field).copy(), getattr(moved.model, field).copy()
        if field == "body_ipos":
            now[2] -= cause.shift
        if field == "body_inertia":
            now[2] /= cause.factor
        np.testing.assert_allclose(now, was, atol=1e-12, err_msg=field)


@pytest.mark.parametrize("height", [0.03, -0.02])
def test_what_stands_rests_higher_by_the_ground(height):
    rig = sole()
    cause = hidden(rig, "ground_height", abs(height), sign=np.sign(height))
    plants = Plant(rig, {}), Plant(rig, {}, [cause])
    for plant in plants:
        plant.reset(np.array([0.1]), np.zeros(1), np.zeros(1))
        for _ in range(100):
            plant.advance(np.zeros(1))
    rest, moved = (float(p.link()[0][0]) for p in plants)
    assert moved - rest == pytest.approx(height, abs=1e-6) and cause.parameters() == {"height": height}
    # sunk a little into the step, whose top is at 0: the foot's centre stands 0.5 above the slide's zero, less 0.1
    assert rest == pytest.approx(-0.4, abs=2e-3)


def test_a_drive_fades_with_the_minutes_and_its_limit_with_it():
    text = arm(MOTOR.replace("/>", ' forcerange="-1 1"/>'))
    cause = hidden(text, "gain_drift", 0.8, sign=-1.0)
    plant = Plant(text, {}, [cause])
    for seconds in (0.0, 30.0, 90.0):
        plant.reset(np.zeros(1), np.zeros(1), np.zeros(1))
        plant.data.time = seconds
        for u in (0.5, 3.0):
            plant.advance(np.array([u]), 1)
            assert plant.data.actuator_force[0] == pytest.approx(min(u, 1) * max(1 - 0.8 * seconds / 60, 0), abs=1e-4)
    run = text.record(plant, 0, 0, noise=False)
    plant.reset(run.clean[100], run.clean_v[100], run.ctrl[100])
    plant.resume(run, 100)
    plant.advance(np.array([1.0]), 1)
    assert plant.data.actuator_force[0] == pytest.approx(1 - 0.8 * 100 * 0.02 / 60, rel=1e-6)


def test_a_profile_takes_the_time_of_its_triangle_or_trapezoid_and_keeps_its_limits():
    rng = np.random.default_rng(0)
    for top, seconds in ((np.inf, 2 * np.sqrt(0.9 / 4)), (1.2, 0.9 / 1.2 + 1.2 / 4)):  # 2 sqrt(w/a); w/v + v/a
        assert quickest(0.9, 0.0, top, 4.0, seconds - 1e-6)[0] == pytest.approx(0.9, abs=1e-9)
        assert quickest(-0.9, 0.0, top, 4.0, seconds / 2)[0] == pytest.approx(-0.45)
        u = v = 0.0
        path = []
        for command_of in rng.normal(size=30):
            for _ in range(50):  # one command for 1 s
                way, v = quickest(command_of - u, v, top, 4.0, 0.02)
                u += way
                path.append((u, v))
        _, speed = np.array(path).T
        assert np.abs(speed).max() <= min(top, 10) + 1e-9
        assert np.abs(np.diff(speed)).max() <= 4.0 * 0.02 + 1e-9


def test_steps_in_parts_are_the_step_as_a_whole():
    u = v = 0.0
    for _ in range(50):
        way, v = quickest(0.7 - u, v, 1.1, 4.0, 0.01)
        u += way
    whole = quickest(0.7, 0.0, 1.1, 4.0, 0.5)
    assert (u, v) == pytest.approx(whole, abs=1e-9)


def test_a_servo_follows_its_profile():
    rig = arm(SERVO)
    cause = hidden(rig, "acceleration_limit", 0.1, slow=0.0)
    plant = Plant(rig, {}, [cause])
    most = 0.1 / cause.parameters()["inertness"]  # the largest command
    bound = most / 0.1
    plant.reset(np.zeros(1), np.zeros(1), np.zeros(1))
    sent = []
    for _ in range(round(1.5 * 2 * np.sqrt(most / bound) / rig.period)):
        plant.advance(np.array([most]))
        sent.append(cause.value)
    assert sent[-1] == pytest.approx(most, abs=1e-12) and max(sent) <= most + 1e-12
    assert np.abs(np.diff(sent, 2)).max() <= bound * rig.period**2 * (1 + 1e-9)
    assert not places(arm(), "acceleration_limit", hidden(arm(), "gain_drift").scales)  # torques have no set-point


def test_ground_is_moved_in_the_world_whatever_is_turned_above_it():
    spec = mujoco.MjSpec.from_string(FALL)
    models = [spec.compile()]
    lift(spec, ground(spec), np.array([0.1, -0.2, 0.3]))
    models.append(spec.compile())
    data = [mujoco.MjData(m) for m in models]
    for model, d in zip(models, data, strict=True):
        mujoco.mj_kinematics(model, d)
    np.testing.assert_allclose(data[1].geom_xpos - data[0].geom_xpos, [[0.1, -0.2, 0.3], [0] * 3, [0] * 3], atol=1e-12)


@pytest.mark.parametrize("first", ["joint_offset", "sensor_gain", "sensor_filter"])
def test_two_sensors_of_one_joint_both_act(first):
    """A late sensor shows what the one before it does; alone it would show the joint."""
    rig = arm()
    sensor, late = hidden(rig, first, 0.05, sign=1.0), hidden(rig, "sensor_delay", 0.04)
    plants = [Plant(rig, {}, causes) for causes in ([sensor], [sensor, late], [late])]
    shown = []
    for plant in plants:
        plant.reset(np.array([0.3]), np.zeros(1), np.zeros(1))
        rows = []
        for k in range(30):
            plant.advance(np.array([np.sin(k * rig.period * 5)]))
            rows.append(np.concatenate(plant.measure()))
        shown.append(np.array(rows))
    alone, both, bare = shown
    np.testing.assert_allclose(both[2:], alone[:-2], atol=1e-12)  # 40 ms are two periods
    assert np.abs(both - bare).max() > 5e-3
