"""The corrected simulator has the integrator and the time step by which its diagnosis simulated."""

import dataclasses
import warnings

import mujoco
import numpy as np
import pytest

from bayessim_mjx import config, registry
from bayessim_mjx.closed_loop import study
from bayessim_mjx.diagnosis import result
from bayessim_mjx.diagnosis.fitting.robot import of_file, of_task
from bayessim_mjx.diagnosis.summary import files
from bayessim_mjx.effects.support import storage
from bayessim_mjx.rollout import replay

from .handwritten import diagnosis

RK4, FAST = mujoco.mjtIntegrator.mjINT_RK4, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
STEP, PERIOD = 0.005, 0.02  # s
HEAD = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
  <body name="head"><joint name="pan" axis="0 1 0" damping="0.08" armature="0.01"/>
  <geom type="box" size=".05 .08 .02" mass=".6" pos=".05 0 0" contype="0" conaffinity="0"/></body></worldbody>
  <actuator><position name="servo" joint="pan" kp="6" kv=".3"/></actuator></mujoco>"""


def stepped(integrator="RK4", substep=STEP, effects=(), parameters=None):
    """A diagnosis by hand that simulated so, of a model with implicitfast at 5 ms."""
    plain = diagnosis(effects, parameters)
    step = {"timestep": STEP, "substep": substep, "integrator": integrator, "delivered": "implicitfast"}
    return dataclasses.replace(plain, gap=dataclasses.replace(plain.gap, integrator=step))


@pytest.fixture
def head(tmp_path):
    (tmp_path / "head.xml").write_text(HEAD)
    return of_file(tmp_path / "head.xml")


def turned(model, command):
    """Angles in plain MuJoCo, from rest."""
    data, angles = mujoco.MjData(model), []
    for ctrl in command:
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, round(PERIOD / model.opt.timestep))
        angles.append(data.qpos[0])
    return np.array(angles)


def test_the_written_model_and_the_applied_one_are_at_the_error_of_rk4(head, tmp_path):
    """Beside RK4 at .1 ms: a hundredth of the error of the model as delivered."""
    command = 0.5 * np.sign(np.sin(np.arange(100) / 6.0))
    fine = mujoco.MjModel.from_xml_string(HEAD)
    fine.opt.timestep, fine.opt.integrator = 1e-4, RK4
    true, found = turned(fine, command), stepped()
    files.write_outputs(found, head, tmp_path)
    there = mujoco.MjModel.from_xml_path(str(tmp_path / files.MODEL))
    before, after = (np.abs(turned(m, command) - true).max() for m in (head.mj_model, there))
    assert before > 0.005 and after < before / 100
    physics = found.apply(head.physics(PERIOD))
    start = np.zeros((1, 1)), np.zeros((1, 1)), command[None, :, None], physics.space.nominal[None]
    ours = np.asarray(replay(physics, *start)["qpos"])[0, 1:, 0]
    assert np.abs(ours - true).max() < before / 100
    text = (tmp_path / files.MODEL).read_text()
    assert text.startswith("<!-- The diagnosis simulated by RK4 at 5 ms, in place of implicitfast at 5 ms.")


@pytest.mark.parametrize(("found", "steps"), [(stepped("implicitfast", STEP / 4), 16), (stepped("implicitfast"), 4)])
def test_finer_steps_of_the_diagnosis_are_those_of_the_corrected_simulator(head, tmp_path, found, steps):
    physics = found.apply(head.physics(PERIOD))
    assert physics.substeps == steps and physics.mj_model.opt.integrator == FAST
    files.write_outputs(found, head, tmp_path)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / files.MODEL))
    assert model.opt.timestep == pytest.approx(PERIOD / steps)
    assert ("simulated" in (tmp_path / "effects.yaml").read_text()) == (steps > 4)


def test_a_step_that_does_not_divide_another_control_step_is_shortened(head):
    assert stepped().apply(head.physics(0.012)).mj_model.opt.timestep == pytest.approx(0.004)


def test_a_diagnosis_of_before_leaves_the_integrator(head):
    old = diagnosis([])
    assert old.apply(head.physics(PERIOD)).mj_model.opt.integrator == FAST


def test_effects_yaml_has_the_integrator_and_who_trains_with_it_is_warned(tmp_path):
    robot = of_task(registry.make("Pendulum"))
    found = stepped(effects=[("coulomb_friction", "hinge", {"level": (0.3, 0.02)})])
    files.write_outputs(found, robot, tmp_path)
    file = tmp_path / "effects.yaml"
    assert config.read_yaml(file)["simulated"] == {"integrator": "RK4", "timestep": STEP}
    with pytest.warns(UserWarning, match=r'<option integrator="RK4" timestep="0.005"/>.*set it in the task\'s model'):
        config.load("Pendulum", overrides=[f"effects={file}"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [e.name for e in storage.read(file).effects] == ["coulomb_friction"]


def test_the_closed_loop_corrects_by_the_integrator_of_the_diagnosis(tmp_path):
    robot = of_task(registry.make("Pendulum"))
    stepped().save(tmp_path)
    loaded = result.load(tmp_path)
    assert study._integrated(robot, loaded).physics(robot.control_dt).mj_model.opt.integrator == RK4
    assert study._integrated(robot, diagnosis([])) is robot
