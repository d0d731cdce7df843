"""Robots from tasks and from MJCF files: what is read, what is refused."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx import registry
from bayessim_mjx.diagnosis.fitting import robot
from bayessim_mjx.errors import UserError

ARM = """
<mujoco model="arm">
  <option timestep="0.002"/>
  <option {option}/>
  <worldbody>
    {world}
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" {geom}/>
      <body pos="0 0 -0.3">
        <joint axis="0 1 0" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" {geom}/>
      </body>
    </body>
  </worldbody>
  {rest}
</mujoco>
"""
MOTOR = '<actuator><motor name="m" joint="shoulder"/></actuator>'


def write(path, option="", world="", geom='contype="0" conaffinity="0"', rest=MOTOR):
    path.write_text(ARM.format(option=option, world=world, geom=geom, rest=rest))
    return path


def test_a_file_gives_a_robot_with_the_default_space(tmp_path):
    found = robot.of_file(write(tmp_path / "arm.xml"))
    assert (found.name, found.control_dt) == ("arm", None)
    assert found.space.names == ("shoulder_damping_mult", "joint1_armature_mult", "upper_mass_mult", "body2_mass_mult")
    np.testing.assert_allclose(
        [found.space.low, found.space.nominal, found.space.high], [[0.3] * 4, [1] * 4, [2.0] * 4]
    )
    edited = found.space.edit(found.spec(), [1.1, 1.2, 0.9, 0.8]).compile()
    assert edited.dof_damping[0] == pytest.approx(0.11) and edited.dof_armature[1] == pytest.approx(0.012)
    np.testing.assert_allclose(edited.body_mass[1:], found.mj_model.body_mass[1:] * [0.9, 0.8], rtol=1e-6)


def test_names_with_wildcards_and_a_body_called_robot(tmp_path):
    text = ARM.format(option="", world="", geom="", rest=MOTOR).replace("upper", "robot")
    (tmp_path / "a.xml").write_text(text.replace("shoulder", "joint[*]"))
    model = robot.of_file(tmp_path / "a.xml").mj_model
    assert robot.default_space(model).names[0] == "joint[*]_damping_mult"
    assert len(robot.default_space(model)) == 4


def test_a_task_gives_its_model_and_its_step():
    env = registry.make("Pendulum")
    found = robot.of_task(env)
    assert (found.name, found.control_dt) == ("Pendulum", 0.05) and found.space.names == ("pendulum_mass_mult",)
    physics = found.physics(0.02)
    assert physics.dt == pytest.approx(0.02) and physics.substeps == 1 and physics.max_qvel[0] == 8.0
    assert found.mj_model.opt.timestep == 0.05  # the task's model is not touched
    with pytest.raises(UserError, match="--task Foreign: it has no MuJoCo model of ours"):
        robot.of_task(type("Foreign", (), {"name": "Foreign"})())


@pytest.mark.parametrize(("dt", "substeps"), [(0.02, 10), (0.001, 1), (1 / 30, 17), (0.002, 1), (0.0033, 2)])
def test_the_timestep_divides_the_logs_period(tmp_path, dt, substeps):
    model = robot.of_file(write(tmp_path / "arm.xml")).mj_model
    fitted = robot.with_timestep(model, dt)
    assert fitted.opt.timestep == pytest.approx(dt / substeps, rel=1e-12) and fitted.opt.timestep <= 0.002 * (1 + 1e-6)
    assert model.opt.timestep == 0.002


def test_implicit_becomes_implicitfast_with_a_warning(tmp_path):
    with pytest.warns(UserWarning, match=r"arm\.xml: MJX has no integrator implicit; implicitfast"):
        found = robot.of_file(write(tmp_path / "arm.xml", option='integrator="implicit"'))
    fast = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    assert int(found.mj_model.opt.integrator) == fast == int(found.spec().compile().opt.integrator)


def test_what_mjx_leaves_out_is_refused_by_name(tmp_path):
    delayed = MOTOR.replace("/>", ' delay="0.01" nsample="4"/>')
    with pytest.raises(UserError, match=r"a\.xml: MJX does not simulate an actuator's delay \(take delay= out"):
        robot.of_file(write(tmp_path / "a.xml", rest=delayed))


def test_an_actuator_without_a_gear_is_said(tmp_path):
    idle = MOTOR.replace("</actuator>", '<motor name="idle" joint="shoulder" gear="0"/></actuator>')
    with pytest.warns(UserWarning, match=r"a\.xml: gear = 0 of idle: these commands do nothing"):
        robot.of_file(write(tmp_path / "a.xml", rest=idle))


def test_a_free_base_is_fine(tmp_path):
    world = '<body name="b"><freejoint/><geom size="0.1" contype="0" conaffinity="0"/></body>'
    assert "b_mass_mult" in robot.of_file(write(tmp_path / "arm.xml", world=world)).space.names


SOLID = '<geom type="box" size="1 1 1"/><body pos="0 0 5"><freejoint/><geom type="ellipsoid" size="1 1 1"/></body>'
DCMOTOR = '<actuator><dcmotor joint="shoulder" motorconst="0.1" resistance="1"/></actuator>'
BAD = {
    "no joints": ({"rest": ""}, r"a\.xml: the model has no actuator"),
    "collision": ({"world": SOLID}, r"MJX cannot simulate this model: .*ELLIPSOID.*BOX.* \(switch the contacts"),
    "actuator": ({"rest": DCMOTOR}, r"MJX does not simulate dcmotor at actuator0 \(write <general gainprm"),
    "solver": ({"option": 'solver="PGS"'}, r"a\.xml: MJX cannot simulate this model: mjtSolver.mjSOL_PGS .use CG"),
    "timestep": ({"option": 'timestep="0"'}, r"a\.xml: <option timestep> = 0; allowed: seconds > 0"),
    "nan": ({"option": 'timestep="nan"'}, r"a\.xml: <option timestep> = nan; allowed: seconds > 0"),
    "gain": (
        {"rest": MOTOR.replace("/>", ' gear="nan"/>')},
        r"a\.xml: numbers that are not finite in .*actuator_gear.*; allowed: finite",
    ),
    "gear": ({"rest": MOTOR.replace("/>", ' gear="0"/>')}, r"a\.xml: gear = 0 of every actuator \(m\)"),
    "line": ({"world": "<geom typ='box'/>"}, r"a\.xml: MuJoCo cannot load it: .*typ.*line 6"),
    "size": ({"world": '<geom type="box"/>'}, r"a\.xml: MuJoCo cannot compile it: .*size"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_model_is_one_clear_message(tmp_path, case):
    settings, words = BAD[case]
    with pytest.raises(UserError, match=words) as caught:
        robot.of_file(write(tmp_path / "a.xml", **settings))
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_model_without_joints(tmp_path):
    with pytest.raises(UserError, match=r"--model .*nothing\.xml: no such file"):
        robot.of_file(tmp_path / "nothing.xml")
    (tmp_path / "b.xml").write_text('<mujoco><worldbody><body><geom size="1"/></body></worldbody></mujoco>')
    with pytest.raises(UserError, match="the model has no joint, so there is no motion"):
        robot.of_file(tmp_path / "b.xml")


PARAMS = "actor_params: {arm: {dof_properties: {damping: {range: [0.5, 2.0], include: shoulder}}}}"


@pytest.mark.parametrize(
    "text",
    [
        PARAMS,
        "randomization_params: {" + PARAMS + "}",
        "task: {randomization_params: {" + PARAMS + "}}",
        "env: {numEnvs: 3}\ntask: {randomize: True, randomization_params: {" + PARAMS + "}}",
    ],
)
def test_params_yaml_in_all_its_forms(tmp_path, text):
    (tmp_path / "p.yaml").write_text(text)
    space = robot.of_file(write(tmp_path / "arm.xml"), tmp_path / "p.yaml").space
    assert space.names == ("shoulder_damping_mult",) and float(space.low[0]) == 0.5


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("actor_params: {arm: {dof_properties: {dampin: {range: [0, 1]}}}}", r"p\.yaml: .*did you mean damping"),
        ("bayessim: {lr: 1}", r"p\.yaml: no parameters: expected task\.randomization_params"),
        ("actor_params: {}", r"p\.yaml: it names no parameter"),
        ("task: 3", r"p\.yaml: no parameters"),
        ("a: [", r"p\.yaml, line \d: not valid YAML"),
    ],
)
def test_a_bad_params_yaml_names_the_file(tmp_path, text, words):
    (tmp_path / "p.yaml").write_text(text)
    with pytest.raises(UserError, match=words):
        robot.of_file(write(tmp_path / "arm.xml"), tmp_path / "p.yaml")


def test_a_diagnosis_simulates_no_sensors_and_leaves_the_model_its_own():
    xml = """<mujoco><worldbody><body><joint name="j"/><geom size=".1"/><site name="s"/></body></worldbody>
      <actuator><motor joint="j"/></actuator><sensor><gyro site="s"/></sensor></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    off = int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    simulated = robot.robot_of(model).physics(0.01).mj_model
    assert simulated.opt.disableflags & off and not model.opt.disableflags & off
