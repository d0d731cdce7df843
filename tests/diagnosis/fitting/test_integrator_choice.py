"""The coarsest stable step is the one that theory has: stiff springs and loops, massless axes, what falls over."""

import dataclasses

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting import integrator_choice
from bayessim_mjx.diagnosis.fitting import robot as robots
from bayessim_mjx.diagnosis.phrases import time_step
from bayessim_mjx.diagnosis.setup import _measured
from bayessim_mjx.logs import Channels, Log, estimate_velocity

MODEL = """<mujoco><option timestep="%g" integrator="%s" gravity="0 0 0"/><worldbody>
<body><joint name="rail" type="slide" stiffness="%g" damping="%g"/>
<geom size=".1" mass="%g" contype="0" conaffinity="0"/></body></worldbody><actuator>%s</actuator></mujoco>"""
MOTOR = '<motor name="motor" joint="rail"/>'


def model(h=0.01, kind="Euler", stiffness=0.0, damping=0.0, mass=1.0, actuator=MOTOR):
    return mujoco.MjModel.from_xml_string(MODEL % (h, kind, stiffness, damping, mass, actuator))


def log(own, **metadata) -> Log:
    zero = np.zeros((40, 1))
    time, sigma = 0.01 * np.arange(40), np.full(1, 1e-4)
    return Log("log", time, zero, zero, zero, False, Channels.of(own), sigma, sigma, metadata=metadata)


def needed(own, **metadata) -> integrator_choice.Step:
    return integrator_choice.coarsest_stable(own, [log(own, **metadata)])


@pytest.mark.parametrize("kind", ["Euler", "implicitfast"])
def test_a_spring_asks_for_half_its_time_constant(kind):
    """Semi-implicit Euler is stable up to h = 2 / omega; here 0.02 s."""
    assert needed(model(0.018, kind, 1e4)).factor == 1
    found = needed(model(0.05, kind, 1e4))
    assert found.factor == 4 and found.joint == "rail" and found.reached and not found.changed
    (text,) = time_step.unstable(found)
    assert "unstable at its time step of 50 ms: rail" in text and "12.5 ms" in text
    assert time_step.unstable(needed(model(0.018, kind, 1e4))) == []


def test_loops_are_springs_too():
    """A servo in the model, and one that the log declares."""
    servo = '<position name="motor" joint="rail" kp="10000"/>'
    assert needed(model(0.05, actuator=servo)).factor == 4
    declared = {"controller": {"law": "position", "kp": 10000}}
    assert needed(model(0.05), **declared).factor == 4 and needed(model(0.05)).factor == 1


def test_a_nearly_massless_axis_is_left_to_the_implicit_integrator():
    """A velocity loop of 1 N s/m on 0.1 g: explicitly stable below 2e-4 s, implicitly at any step."""
    servo = '<velocity name="motor" joint="rail" kv="1"/>'
    found = needed(model(0.01, mass=1e-4, actuator=servo))
    assert found.changed and found.factor == 1 and "implicitfast" in time_step.unstable(found)[0]
    changed = found.robot(robots.robot_of(model(0.01, mass=1e-4, actuator=servo)))
    assert changed.mj_model.opt.integrator == integrator_choice.IMPLICITFAST
    assert needed(model(0.01, damping=1.0, mass=1e-4)).factor == 1  # a joint's damping is implicit in Euler's method
    found = needed(model(0.01, "RK4", damping=1.0, mass=1e-4))
    assert found.changed and found.factor == 1  # not so in that of Runge and Kutta


def test_in_a_fluid_the_integrator_stays_which_mjx_can_simulate():
    """The same nearly massless axis: MJX has no fluid forces by implicitfast."""
    light = {"h": 0.01, "damping": 20.0, "mass": 1e-3, "actuator": '<velocity name="motor" joint="rail" kv="50"/>'}
    air, water = model(**light), model(**light)
    water.opt.density = 1000.0
    assert needed(air).integrator == integrator_choice.IMPLICITFAST
    assert needed(water).integrator == int(mujoco.mjtIntegrator.mjINT_EULER)


def test_what_falls_over_is_not_unstable():
    falling = model(0.01, stiffness=-400.0)  # grows by e in 0.05 s
    assert needed(falling).factor == 1


def test_what_no_step_reaches_is_said():
    found = needed(model(0.01, stiffness=1e10, mass=1e-3))
    assert not found.reached and found.factor == integrator_choice.FINEST
    assert "for 0.156 ms too" in time_step.unstable(found)[0] and "armature" in time_step.unstable(found)[0]


@pytest.mark.slow
@pytest.mark.ci
def test_a_loop_that_the_simulators_step_cannot_hold_is_simulated_to_within_the_noise():
    """At its own step the simulator diverges; the truth is MuJoCo's at a hundredth of it."""
    gain, rub, mass, period, noise = 40000.0, 60.0, 1.0, 0.02, 1e-4  # omega h = 4
    own = model(period, mass=mass)
    fine, rng, logs = model(period / 100, "RK4", mass=mass), np.random.default_rng(0), []
    for i in range(4):
        data, table = mujoco.MjData(fine), []
        for k in range(151):
            target = 0.05 * np.sin((3 + i) * period * k)
            table.append((target, data.qpos[0]))
            for _ in range(100):
                data.ctrl[0] = gain * (target - data.qpos[0]) - rub * data.qvel[0]
                mujoco.mj_step(fine, data)
        ctrl, qpos = (np.array(c)[:, None] for c in zip(*table, strict=True))
        qpos = qpos + noise * rng.normal(size=qpos.shape)
        time, channels, sigma = period * np.arange(151), Channels.of(own), np.full(1, noise)
        qvel, spread = estimate_velocity(time, qpos, channels, sigma)
        law = {"controller": {"law": "position", "kp": gain, "kd": rub}}
        logs.append(Log(f"log{i}", time, ctrl, qpos, qvel, False, channels, sigma, spread, metadata=law))
    step = integrator_choice.coarsest_stable(own, logs)
    assert step.factor > 1 and step.reached
    robot = dataclasses.replace(robots.robot_of(own), control_dt=period)
    _, found = _measured(robot.physics(period), logs, None, False, np.full(1, 3 * noise), step.factor)
    assert found.factor >= step.factor and not time_step.beyond(found)
    assert found.left[0] < noise and found.floor[0] < 1.5 * noise
