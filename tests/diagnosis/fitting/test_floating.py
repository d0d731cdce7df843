"""Robots without hinges are accepted; what their floating bodies may carry, and how large it may be."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting import candidates, robot, scales
from bayessim_mjx.effects import make
from bayessim_mjx.effects.support.native import write_model
from bayessim_mjx.logs import Channels, Log
from bayessim_mjx.parameters import ParameterSpace

DRONE = """<mujoco><option timestep="0.005"/><worldbody><body name="drone" pos="0 0 1"><freejoint name="root"/>
<inertial pos="0 0 0" mass=".8" diaginertia="5e-3 6e-3 9e-3"/><site name="left" pos="0 .15 0"/>
<site name="right" pos="0 -.15 0"/></body>{more}</worldbody>
<actuator><motor name="left" site="left" gear="0 0 1 0 0 .02"/>
<motor name="right" site="right" gear="0 0 1 0 0 -.02"/>{motor}</actuator></mujoco>"""
ALONE = DRONE.format(more="", motor="")
ARM = """<body name="arm"><joint name="hinge" axis="0 1 0"/>
<geom size=".1" pos=".2 0 0" contype="0" conaffinity="0"/></body>"""
BESIDE = DRONE.format(more=ARM, motor='<motor name="motor" joint="hinge"/>')


def log(model):
    """Along x at 2 m/s at most, turning about z at 3 rad/s at most, each rotor at 5 N."""
    time = np.arange(0, 2, 0.01)
    q, v = np.tile(model.qpos0, (len(time), 1)), np.zeros((len(time), model.nv))
    q[:, 0], v[:, 0] = 0.5 * np.sin(4 * time), 2 * np.cos(4 * time)
    turn = 0.5 * np.sin(6 * time)
    q[:, 3], q[:, 6], v[:, 5] = np.cos(turn / 2), np.sin(turn / 2), 3 * np.cos(6 * time)
    if model.nv > 6:
        q[:, 7], v[:, 6] = np.sin(time), np.cos(time)
    sigma = [np.full(model.nq, 1e-3), np.full(model.nv, 1e-3)]
    return Log("it", time, np.full((len(time), model.nu), 5.0), q, v, True, Channels.of(model), *sigma)


def test_a_body_that_floats_without_a_hinge_is_a_robot():
    own = robot.robot_of(mujoco.MjSpec.from_string(ALONE))
    assert own.space.names == ("drone_mass_mult",)


def test_its_centre_of_mass_may_move_in_a_model_of_the_same_numbers():
    spec = mujoco.MjSpec.from_string(ALONE)
    plain, own = spec.compile(), robot.robot_of(spec).mj_model
    assert plain.body_simple[1] and not own.body_simple[1]
    runs = []
    for model in (plain, own):
        data = mujoco.MjData(model)
        data.ctrl[:], data.qvel[:] = [3.0, 5.0], [1, 2, 3, 1, -2, 3]
        for _ in range(100):
            mujoco.mj_step(model, data)
        runs.append(data.qpos.copy())
    np.testing.assert_allclose(runs[1], runs[0], atol=1e-12)


@pytest.mark.parametrize("name", ["payload", "inertial_parameters"])
def test_what_moves_its_centre_of_mass_is_written_into_its_mjcf(name):
    spec, effect = mujoco.MjSpec.from_string(ALONE), make(name, where="drone")
    values = {p.name: p.nominal for p in effect.space().parameters} | {f"drone.{name}.com_x": 0.02}
    values |= {"drone.payload.mass": 0.2} if name == "payload" else {}
    new, missing = write_model(spec, ParameterSpace(), [], [effect], values)
    model = new.compile()
    centre = 0.2 * 0.02 / 1.0 if name == "payload" else 0.02
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert missing == [] and data.subtree_com[1][0] == pytest.approx(centre)


def test_ranges_grow_with_thrust_and_speed():
    """Thrust of 10 N against 2 m/s (98th percentile), weight 7.85 N; moments of inertia against 3 rad/s."""
    model = robot.robot_of(mujoco.MjSpec.from_string(ALONE)).mj_model
    here = scales.measure(model, [log(model)]).at("body", "drone")
    assert here["force"] == pytest.approx(10.0, rel=1e-6) and here["speed"] == pytest.approx(2.0, rel=0.01)
    assert here["rate"] == pytest.approx(3.0, rel=0.01) and here["moment"] == pytest.approx(9e-3 * 18, rel=0.05)


EVERYWHERE = {
    "body_drag",
    "directional_drag",
    "wind",
    "payload",
    "inertial_parameters",
    "external_force",
    "actuator_gain",
    "actuator_lag",
}


@pytest.mark.parametrize("text", [ALONE, BESIDE])
def test_drag_load_and_rotors_are_on_offer(text):
    model = robot.robot_of(mujoco.MjSpec.from_string(text)).mj_model
    stack, left_out = candidates.stack(candidates.kinds_of("all"), scales.measure(model, [log(model)]))
    places = {e.name: e.places() for e in stack}
    assert set(places) >= EVERYWHERE and "base_flexibility" not in places
    assert places["body_drag"] == places["wind"] == ("drone",) and places["actuator_gain"][:2] == ("left", "right")
    # a rotor at a site has no angle; the motor beside it keeps what needs one
    assert places.get("cogging") == (("motor",) if text == BESIDE else None)
    assert any(t.startswith("cogging") for t in left_out) == (text == ALONE)


def test_thrusters_at_the_free_joint_itself_are_rotors_too():
    """Such an actuator has six gears and no angle."""
    text = ALONE.replace('site="left" gear="0 0 1 0 0 .02"', 'joint="root" gear="0 0 2 0 0 .02"')
    model = robot.robot_of(mujoco.MjSpec.from_string(text)).mj_model
    size = scales.measure(model, [log(model)])
    stack, _ = candidates.stack(candidates.kinds_of("all"), size)
    places = {e.name: e.places() for e in stack}
    assert set(places) >= EVERYWHERE and places["actuator_lag"] == ("left", "right") and "cogging" not in places
    assert size.at("body", "drone")["force"] == pytest.approx(15.0, rel=1e-6)


def test_fixed_robots_hear_nothing_of_floating_bodies():
    spec = mujoco.MjSpec.from_string(BESIDE)
    spec.delete(spec.body("drone"))
    model = spec.compile()
    one = Log("it", *(np.arange(0, 2, 0.01), *3 * [np.zeros((200, 1))]), True, Channels.of(model), *2 * [np.ones(1)])
    stack, left_out = candidates.stack(candidates.kinds_of("all"), scales.measure(model, [one]))
    said = {e.name for e in stack} | {text.split(":")[0] for text in left_out}
    assert not said & {"body_drag", "directional_drag", "wind"} and "payload" in said
