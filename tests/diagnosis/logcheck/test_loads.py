"""What a robot can carry, by hand; and a payload far beyond its flange's own mass found again by the fit."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx import effects
from bayessim_mjx.diagnosis.fitting import robot, scales
from bayessim_mjx.diagnosis.logcheck import drives
from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.selection.search_state import ranked
from bayessim_mjx.diagnosis.setup import prepare
from bayessim_mjx.logs import Channels, Log, estimate_velocity
from tests.diagnosis import singles

ARM = """<mujoco><option timestep="%g" integrator="%s"/><worldbody><body name="upper" pos="0 0 1">
  <joint name="shoulder" axis="0 1 0" damping="1" %s/>
  <geom type="capsule" size=".05" fromto="0 0 0 .6 0 0" mass="6" contype="0" conaffinity="0"/>
  <body name="lower" pos=".6 0 0"><joint name="elbow" axis="0 1 0" damping=".5" %s/>
    <geom type="capsule" size=".04" fromto="0 0 0 .5 0 0" mass="3" contype="0" conaffinity="0"/>
    <body name="flange" pos=".5 0 0">
      <geom type="sphere" size=".04" mass=".2" contype="0" conaffinity="0"/>%s</body></body></body></worldbody>
<actuator><motor name="m1" joint="shoulder"/><motor name="m2" joint="elbow" gear="2"/></actuator></mujoco>"""
LIMITS = ('actuatorfrcrange="-150 150"', 'actuatorfrcrange="-40 40"')
LOAD = '<body pos=".2 0 .05"><inertial pos="0 0 0" mass="3" diaginertia="1e-9 1e-9 1e-9"/></body>'
G = 9.81


def compiled(limits=LIMITS, load="", step=0.002, integrator="Euler"):
    return mujoco.MjModel.from_xml_string(ARM % (step, integrator, *limits, load))


def test_the_drives_hold_so_much_by_hand():
    """Stretched out level: m g lever = limit + own gravity torque, at the joint that gives way first."""
    held = drives.carried(compiled(), np.zeros((1, 2)))
    own = (6 * 0.3 + 3 * 0.85 + 0.2 * 1.1, 3 * 0.25 + 0.2 * 0.5)  # kg m beyond shoulder and elbow
    ruled = ((150 / G + own[0]) / 1.1, (40 / G + own[1]) / 0.5)
    assert held[3] == pytest.approx(min(9.2, *ruled), rel=1e-9) and held[3] == pytest.approx(9.2)  # all that moves
    weak = drives.carried(compiled(('actuatorfrcrange="-20 20"', LIMITS[1])), np.zeros((1, 2)))
    assert weak[3] == pytest.approx((20 / G + own[0]) / 1.1, rel=1e-9)
    assert weak[1] > weak[3]  # nearer to the joint
    hanging = drives.carried(compiled(('actuatorfrcrange="-20 20"', LIMITS[1])), np.array([[np.pi / 2, 0.0]]))
    assert hanging[3] == pytest.approx(9.2)  # no lever
    assert drives.carried(compiled(), np.zeros((1, 2)), {3: 7.0}).tolist() == [*held[:3], 7.0]  # as rated


def test_limits_of_force_and_command_count_through_the_gear():
    xml = ARM % (0.002, "Euler", "", "", "")
    xml = xml.replace('joint="shoulder"', 'joint="shoulder" ctrlrange="-7 9" ctrllimited="true"')
    xml = xml.replace('gear="2"', 'gear="-2" forcerange="-5 4" forcelimited="true"')
    assert drives.force_limits(mujoco.MjModel.from_xml_string(xml)).tolist() == [9.0, 10.0]
    assert np.isinf(drives.force_limits(compiled(("", "")))).all()


def test_a_light_flange_may_carry_what_the_arm_can():
    model = compiled()
    mass, *where = scales.ranges(effects.load("payload"), "flange", scales.measure(model, [follow(model, 0, 2.0)]))
    assert mass.high > 5.0  # 0.67 kg before: three times the mass of the flange
    # the arm is 1.14 m long: 0.3 of it
    assert all(p.high == pytest.approx(0.3 * 1.14, rel=1e-6) and p.low == -p.high for p in where)


def follow(model, i, seconds, period=0.02, sigma=1e-4):
    """A log of the arm following sines with its own weight held, from MuJoCo C."""
    data, nominal, rng = mujoco.MjData(model), mujoco.MjData(model), np.random.default_rng(i)
    rows, each = [], round(period / model.opt.timestep)
    data.qpos[:] = -0.5, 0.8
    for k in range(round(seconds / period) + 1):
        t = k * period
        goal = np.array([-0.5, 0.8]) + 0.5 * np.sin(2 * np.pi * np.array([0.3 + 0.1 * i, 0.5 + 0.15 * i]) * t)
        nominal.qpos[:] = data.qpos
        mujoco.mj_fwdPosition(model, nominal)
        mujoco.mj_fwdVelocity(model, nominal)
        torque = np.array([400, 120]) * (goal - data.qpos) - np.array([60, 18]) * data.qvel + nominal.qfrc_bias
        command = torque / [1.0, 2.0]
        rows.append([t, *command, *data.qpos])
        data.ctrl[:] = command
        for _ in range(each):
            mujoco.mj_step(model, data)
    time, u, q = np.split(np.array(rows), [1, 3], axis=1)
    q = q + sigma * rng.normal(size=q.shape)
    channels, noise = Channels.of(model), np.full(2, sigma)
    qvel, spread = estimate_velocity(time[:, 0], q, channels, noise)
    return Log(f"log{i}", time[:, 0], u, q, qvel, False, channels, noise, spread)


@pytest.mark.xfail(strict=True, reason="known defect: from one start the fit rests at 4.5 kg")
@pytest.mark.slow
def test_a_load_fifteen_times_its_flange_is_found_again(tmp_path):
    """3 kg, 0.2 m beyond and 0.05 m above the flange's centre; integrated by Runge-Kutta at a quarter of the step."""
    truth = compiled(load=LOAD, step=0.0005, integrator="RK4")
    path = tmp_path / "arm.xml"
    path.write_text(ARM % (0.002, "Euler", *LIMITS, ""))
    setup = prepare(robot.of_file(path), [follow(truth, i, 2.0) for i in range(3)], Request(("payload",)))
    candidates = [c for c in setup.candidates if c.where == "flange"]  # the same rigid body as the lower arm
    found = ranked(singles.fitted(setup, candidates))[0]
    assert [c.label for c in found.effects] == ["payload@flange"]
    mass, x, _, z = found.values_of(found.effects[0])
    assert mass == pytest.approx(3.0, rel=0.03) and x == pytest.approx(0.2, abs=0.02)
    assert z == pytest.approx(0.05, abs=0.02)  # the joints turn about y: that one is not told
