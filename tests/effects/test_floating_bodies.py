"""Drag and wind of floating bodies against closed forms and MuJoCo C; where they are on offer."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from bayessim_mjx.effects.support.bodies import resisted
from bayessim_mjx.effects.support.site import places
from bayessim_mjx.errors import UserError
from tests.effects.truths import CONTROL, moved, physics, truth

DRONE = """<mujoco><option timestep="{dt}"/><worldbody><body name="drone"><freejoint/>
<inertial pos=".02 -.01 .03" mass=".8" diaginertia="5e-3 6e-3 9e-3"/><geom size=".1" contype="0" conaffinity="0"/>
<site name="left" pos="0 .15 0"/><site name="right" pos="0 -.15 0"/></body>
<body name="arm"><joint name="hinge" axis="0 1 0"/><geom size=".1" pos=".2 0 0" contype="0" conaffinity="0"/></body>
</worldbody><actuator><motor name="left" site="left" gear="0 0 1 0 0 .02"/>
<motor name="right" site="right" gear="0 0 1 0 0 -.02"/></actuator></mujoco>"""
XML, FINE = (DRONE.format(dt=dt) for dt in (0.004, 0.0002))
MASS, WEIGHT = 0.8, 0.8 * 9.81
WORLD = physics(XML, [make("wind", where="drone")])
START = np.array([0, 0, 0, 1, 0, 0, 0, 0.0])
T = 150
IDLE = np.zeros((T, 2))


def flown(theta, command=IDLE, qvel=(0,) * 7):
    """Poses and the hinge's angle `[T + 1, 8]` under (k, c, r, wind)."""
    return moved(WORLD, [theta], command, START, qvel)[0]


# Euler's method moves positions with the new speeds, so that speeds lie half a timestep of .004 s before positions
AT_REST = (0, 0, 9.81 * 0.002, 0, 0, 0, 0)


def speeds(q):
    """Of the body's origin, amid the control steps `[T, 3]`, m/s."""
    return np.diff(q[:, :3], axis=0) / CONTROL


def resistance(qvel, drag, medium, dt=1e-6, quat=(1, 0, 0, 0), axes=None):
    """Generalised force `[7]` of one sub-step, and the model and data of MuJoCo C that it is computed from."""
    model = mujoco.MjModel.from_xml_string(XML)
    data = mujoco.MjData(model)
    data.qpos[3:7], data.qvel[:] = quat, qvel
    mujoco.mj_forward(model, data)
    inverse = np.zeros((model.nv, model.nv))
    mujoco.mj_solveM(model, data, inverse, np.eye(model.nv))
    at = make("wind", where="drone").bind(model, 0.004, 1)
    force = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator
    step = SimpleNamespace(data=data, qvel=data.qvel, inverse=inverse, force=force, dt=dt)
    axes = None if axes is None else np.float32([axes])
    return np.asarray(resisted(at, step, np.float32([drag]), np.float32([medium]), axes)), model, data


def test_at_its_final_speed_drag_carries_the_weight_whatever_the_timestep():
    for drag, speed in (([4.0, 0, 0], WEIGHT / 4), ([0, 2.0, 0], np.sqrt(WEIGHT / 2))):
        force, *_ = resistance([0, 0, -speed, 0, 0, 0, 0], drag, [0, 0, 0], dt=0.02)
        np.testing.assert_allclose(force[:3], [0, 0, WEIGHT], atol=1e-4)


def test_drag_of_an_axis_is_that_of_the_body_however_it_is_turned():
    """A body on its side, that moves along its own y axis (the world's -x), feels the factor of y alone."""
    side = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    force, *_ = resistance([-2.0, 0, 0, 0, 0, 0, 0], [0.5, 0.1, 0], [0, 0, 0], quat=side, axes=[1, 3, 9])
    np.testing.assert_allclose(force[:3], [3 * (0.5 + 0.1 * 2) * 2, 0, 0], atol=1e-4)


def test_drag_acts_at_the_centre_of_mass_along_the_air_that_comes_by():
    """As MuJoCo projects the same force and moment, of a body that is turned and turns."""
    quat, wind, qvel = np.array([0.8, 0.2, -0.4, 0.4]), np.array([3.0, 1.0, 0.5]), [1, 2, -1, 3, -2, 1, 0.7]
    force, model, data = resistance(qvel, [0.3, 0.2, 0.01], wind, quat=quat)
    v = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, 1, v, 0)
    by = v[3:] - wind  # of the centre of mass
    expected = np.zeros(model.nv)
    push = -(0.3 + 0.2 * np.linalg.norm(by)) * by
    mujoco.mj_applyFT(model, data, push, -0.01 * v[:3], data.xipos[1], 1, expected)
    np.testing.assert_allclose(force, expected, atol=2e-5)
    assert np.abs(expected[:6]).min() > 1e-3


@pytest.mark.slow
@pytest.mark.ci
def test_a_falling_body_reaches_the_speed_at_which_drag_carries_it():
    """v = W / k (linear) and sqrt(W / c) (quadratic), on the way (W / k) (1 - exp(-k t / m)) and tanh."""
    t = CONTROL * (np.arange(T) + 0.5)
    fall = speeds(flown([4.0, 0, 0, 0, 0, 0], qvel=AT_REST))[:, 2]
    np.testing.assert_allclose(fall, -WEIGHT / 4 * (1 - np.exp(-4 * t / MASS)), atol=2e-3)
    final = np.sqrt(WEIGHT / 2)
    fall = speeds(flown([0, 2.0, 0, 0, 0, 0], qvel=AT_REST))[:, 2]
    np.testing.assert_allclose(fall, -final * np.tanh(9.81 * t / final), atol=2e-3)
    assert abs(fall[-1] + final) < 2e-3


@pytest.mark.slow
@pytest.mark.ci
def test_a_turning_body_slows_down_by_the_drag_of_turning_alone():
    """About a principal axis w falls as exp(-r t / I); without drag it keeps turning."""
    rates = []
    for r in (0.0, 0.02):
        quat = flown([0, 0, r, 0, 0, 0], qvel=(0, 0, 0, 0, 0, 3.0, 0))[:, 3:7]
        angle = np.unwrap(2 * np.arctan2(quat[:, 3], quat[:, 0]))
        rates.append(np.diff(angle) / CONTROL)
    t = CONTROL * (np.arange(T) + 0.5)
    np.testing.assert_allclose(rates[0], 3.0, atol=2e-3)
    np.testing.assert_allclose(rates[1], 3.0 * np.exp(-0.02 * (t + 0.002) / 9e-3), atol=5e-3)


@pytest.mark.slow
@pytest.mark.ci
def test_a_body_without_a_push_drifts_with_the_wind():
    """Along the wind it ends as fast as the wind; across it falls as in still air."""
    v = speeds(flown([4.0, 0, 0, 2.0, -1.0, 0]))[-1]
    np.testing.assert_allclose(v, [2.0, -1.0, -WEIGHT / 4], atol=5e-3)
    still = speeds(flown([4.0, 0, 0, 0, 0, 0]))[-1]
    np.testing.assert_allclose(still, [0, 0, -WEIGHT / 4], atol=5e-3)


@pytest.mark.slow
@pytest.mark.ci
def test_tumbling_under_thrust_it_moves_as_in_mujoco():
    """Forces at the centre of mass, which is off the frame; to a thousandth of how far drag moves it."""
    k, c, r, wind = 0.3, 0.1, 4e-3, np.array([3.0, -2.0, 1.0])
    time = CONTROL * np.arange(T)
    command = np.stack([4 + np.sin(5 * time), 4 + np.cos(4 * time)], 1)
    spin = (1, -2, 0, 0.5, 1.0, -2.0, 0)

    def push(model, data):
        out = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, 1, out, 0)
        turn, v = out[:3], out[3:] - wind
        data.xfrc_applied[1] = [*(-(k + c * np.linalg.norm(v)) * v), *(-r * turn)]

    model = mujoco.MjModel.from_xml_string(FINE)
    real = truth(model, command, START, spin, push)
    bare = truth(mujoco.MjModel.from_xml_string(FINE), command, START, spin)
    q = flown([k, c, r, *wind], command, spin)
    far = np.abs(real - bare)[:, :7].max(0)
    assert (far[:3] > 1).all() and far[3:].max() > 0.5
    off, own = np.abs(q - real)[:, :7].max(0), np.abs(flown([0] * 6, command, spin) - bare)[:, :7].max(0)
    assert (off < own + 1e-3 * np.array([*far[:3], *[far[3:].max()] * 4])).all(), (off, own, far)


@pytest.mark.slow
@pytest.mark.ci
def test_still_air_is_wind_at_no_speed_and_neutral_changes_no_bit():
    drag = physics(XML, [make("body_drag", where="drone")])
    sides = physics(XML, [make("directional_drag", where="drone")])
    spin = (1, -2, 0, 0.5, 1.0, -2.0, 0)
    (one,) = moved(drag, [[0.4, 0.2, 0.01]], IDLE, START, spin)
    np.testing.assert_array_equal(flown([0.4, 0.2, 0.01, 0, 0, 0], qvel=spin), one)
    (even,) = moved(sides, [[0.4, 0.2, 0.01, 1, 1]], IDLE, START, spin)
    np.testing.assert_array_equal(even, one)
    (off,) = moved(drag, [[0.0] * 3], IDLE, START, spin)
    bare = moved(physics(XML, []), [[]], IDLE, START, spin)[0]
    np.testing.assert_array_equal(off, bare)


def test_only_floating_bodies_carry_them():
    model = mujoco.MjModel.from_xml_string(XML)
    for name in ("body_drag", "directional_drag", "wind"):
        assert places(make(name, where="all"), model) == ("drone",)
        with pytest.raises(UserError, match="body 'arm' .*allowed: drone"):
            physics(XML, [make(name, where="arm")])
