"""Forces of MuJoCo that MJX leaves out: added, moved to the joint, or refused with what to write in their place."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting import robot
from bayessim_mjx.effects import make
from bayessim_mjx.effects.support.native import write_model
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics
from bayessim_mjx.physics.native import absent, moved_to_joints
from bayessim_mjx.rollout import replay

XML = """
<mujoco><option timestep="0.001" integrator="{integrator}"/>
  <worldbody><body><joint name="hinge" axis="0 1 0" {joint}/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".8" contype="0"/></body></worldbody>
  <actuator>{actuator}</actuator></mujoco>
"""
MOTOR = '<motor name="drive" joint="hinge"/>'
SERVO = '<position name="drive" joint="hinge" kp="6" kv=".4" gear="2" forcerange="-2 2" {}/>'
DC_MOTOR = '<dcmotor name="drive" joint="hinge" motorconst=".5" resistance="2" gear="2"/>'
EARLY = '<general name="drive" joint="hinge" dyntype="filterexact" dynprm=".05" gainprm="2" actearly="{}"/>'
DT, STEPS = 0.01, 60


def xml(joint="", actuator=MOTOR, integrator="implicitfast"):
    return XML.format(joint=joint, actuator=actuator, integrator=integrator)


def commands():
    return np.sin(2 * np.pi * 1.3 * DT * np.arange(STEPS))[:, None] * 1.2


def by_mujoco(model, start=0.4):
    """`[STEPS, 1]`, positions behind each command."""
    data, out = mujoco.MjData(model), []
    data.qpos[:] = start
    for u in commands():
        data.ctrl[:] = u
        mujoco.mj_step(model, data, round(DT / model.opt.timestep))
        out.append(data.qpos.copy())
    return np.array(out)


def by_us(model, effects=(), theta=(), start=0.4):
    physics = Physics(model, DT, ParameterSpace(), effects)
    moved = replay(physics, np.full((1, 1), start), np.zeros((1, 1)), commands()[None], np.reshape(theta, (1, -1)))
    return np.asarray(moved["qpos"])[0, 1:]


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
@pytest.mark.parametrize("joint", ['damping=".1 .2 .05"', 'stiffness="1 .8 2" springref="20"'])
def test_polynomial_forces_move_a_joint_as_mujoco_moves_it(joint, integrator):
    model = mujoco.MjModel.from_xml_string(xml(joint, integrator=integrator))
    plain = mujoco.MjModel.from_xml_string(
        xml(joint.replace(" .2 .05", "").replace(" .8 2", ""), integrator=integrator)
    )
    true = by_mujoco(model)
    change = np.ptp(true - by_mujoco(plain))
    assert change > 0.05  # the forces matter
    assert np.abs(by_us(model) - true).max() < 0.01 * change


def test_an_actuators_damping_and_armature_are_those_of_its_joint():
    spec = mujoco.MjSpec.from_string(xml('damping=".1"', SERVO.format('damping=".05" armature=".02"')))
    before = by_mujoco(spec.copy().compile())
    moved_to_joints(spec)
    after = spec.compile()
    assert absent(after) == ""
    assert after.dof_damping[0] == pytest.approx(0.1 + 0.05 * 4) and after.dof_armature[0] == pytest.approx(0.02 * 4)
    assert np.abs(by_mujoco(after) - before).max() < 1e-12


def test_a_robots_file_is_read_so(tmp_path):
    (tmp_path / "a.xml").write_text(xml("", SERVO.format('damping=".05"')))
    assert robot.of_file(tmp_path / "a.xml").mj_model.dof_damping[0] == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("joint", "actuator", "said"),
    [
        ("", SERVO.format('delay=".02" nsample="4"'), r"an actuator's delay \(take delay= out"),
        ("", SERVO.format('damping=".1"'), r"an actuator's damping \(write damping times gear squared at its joint"),
        ('stiffness="1" springyield="20"', MOTOR, r"a joint's springyield"),
        ("", DC_MOTOR, r"dcmotor at drive \(write <general gainprm=\"K/R\""),
        ("", '<pid name="drive" joint="hinge" kp="5" ki="2"/>', r"pid at drive \(write <position kp= kv=/>"),
        ("", EARLY.format("true"), r"actearly at drive \(take actearly out"),
        ("", '<general joint="hinge" gaintype="user"/>', r"gaintype user at actuator0"),
    ],
)
def test_what_is_neither_is_refused_with_what_to_write(joint, actuator, said):
    with pytest.raises(UserError, match=said):
        Physics(mujoco.MjModel.from_xml_string(xml(joint, actuator)), DT, ParameterSpace())


def test_what_is_written_in_the_place_of_a_dcmotor_moves_as_it_does():
    K, R = 0.5, 2.0
    written = f'<general joint="hinge" gear="2" gainprm="{K / R}" biastype="affine" biasprm="0 0 {-K * K / R}"/>'
    true = by_mujoco(mujoco.MjModel.from_xml_string(xml("", DC_MOTOR)))
    model = mujoco.MjModel.from_xml_string(xml("", written))
    assert np.abs(by_mujoco(model) - true).max() < 1e-12
    assert np.abs(by_us(model) - true).max() < 1e-5


def test_a_robots_file_is_refused_so_too(tmp_path):
    """A pid has two commands, more than there are actuators."""
    (tmp_path / "a.xml").write_text(xml("", MOTOR + '<pid name="loop" joint="hinge" kp="5" ki="2"/>'))
    with pytest.raises(UserError, match=r"a\.xml: MJX does not simulate pid at loop"):
        robot.of_file(tmp_path / "a.xml")


def test_iterations_that_mjx_has_not_are_told(tmp_path):
    (tmp_path / "a.xml").write_text(xml('frictionloss=".1"').replace("<option ", '<option noslip_iterations="3" '))
    with pytest.warns(UserWarning, match="noslip_iterations = 3: MJX has no such iterations"):
        robot.of_file(tmp_path / "a.xml")


def test_a_group_of_actuators_that_is_off_is_refused_by_name():
    text = xml("", MOTOR + '<position name="trim" joint="hinge" kp="3" group="2"/>')
    text = text.replace("<option ", '<option actuatorgroupdisable="2" ')
    model = mujoco.MjModel.from_xml_string(text)
    alone = mujoco.MjModel.from_xml_string(xml())
    assert np.abs(by_mujoco(model) - by_mujoco(alone)).max() < 1e-12  # what the refusal says to write
    with pytest.raises(UserError, match=r"actuatorgroupdisable of trim \(take it out of <option>, and these actuators"):
        Physics(model, DT, ParameterSpace())


@pytest.mark.parametrize(
    ("name", "change"), [("servo_stiffness", {"kp": 'kp="2.1"'}), ("servo_damping", {"kv": 'kv="1.4"'})]
)
def test_a_servos_gain_times_a_factor_is_another_servo(name, change):
    wrong = xml("", SERVO.format(""))
    true = wrong.replace('kp="6"', change.get("kp", 'kp="6"')).replace('kv=".4"', change.get("kv", 'kv=".4"'))
    factor = {"servo_stiffness": 0.35, "servo_damping": 3.5}[name]
    model = mujoco.MjModel.from_xml_string(wrong)
    found = by_us(model, [make(name, where="drive")], [factor])
    expected = by_mujoco(mujoco.MjModel.from_xml_string(true))
    assert np.abs(by_mujoco(model) - expected).max() > 0.05
    assert np.abs(found - expected).max() < 1e-3
    spec = mujoco.MjSpec.from_string(wrong)
    assert make(name, where="drive").edit(spec, {"drive": {"factor": factor}}) is None
    assert np.abs(by_mujoco(spec.compile()) - expected).max() < 1e-9


def test_a_motor_has_no_servo_gains():
    with pytest.raises(UserError, match=r"servo_stiffness: actuator 'drive' has none of what servo_stiffness changes"):
        make("servo_stiffness", where="drive").bind(mujoco.MjModel.from_xml_string(xml()), 0.01, 1)


def test_written_at_all_servos_it_leaves_motors_as_they_are():
    spec = mujoco.MjSpec.from_string(xml("", SERVO.format("") + '<motor name="plain" joint="hinge" gear="3"/>'))
    tied = [make("servo_stiffness", where="all")]
    written, missing = write_model(spec, ParameterSpace(), [], tied, {"all.servo_stiffness.factor": 0.5})
    model = written.compile()
    assert not missing and model.actuator_gainprm[0, 0] == 3 and model.actuator_biasprm[0, 1] == -3
    assert model.actuator_gainprm[1, 0] == 1 and not model.actuator_biasprm[1].any()
