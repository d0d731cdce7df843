"""Meshes that only show a robot are not simulated, and not read for the names of its joints."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting.robot import names_of, of_file
from bayessim_mjx.effects import make
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics
from bayessim_mjx.physics.visuals import without_visuals
from bayessim_mjx.rollout import replay

TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 .2 0\nv 0 0 .3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
ARM = """<mujoco>{compiler}<option timestep=".005" integrator="implicitfast"/>
  <asset><mesh name="cover" file="cover.obj"/></asset><worldbody>
  <geom type="plane" size="2 2 .1" pos="0 0 -3" conaffinity="1" contype="0"/>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping=".5"/>
    <geom type="mesh" mesh="cover" contype="0" conaffinity="0"/>
    <geom type="sphere" size=".03" contype="0" conaffinity="0" name="pulley"/>
    <body name="lower" pos=".2 0 0"><joint name="elbow" axis="0 1 0" damping=".5"/>
      <geom type="mesh" mesh="cover" pos="0 .1 0" euler="10 20 30" contype="0" conaffinity="0"/>
      <geom type="sphere" size=".02" conaffinity="0" {more}/></body></body></worldbody>
  <actuator><motor name="a" joint="shoulder" gear="3"/><motor name="b" joint="elbow"/></actuator>{after}</mujoco>"""
DYNAMICS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_subtreemass", "body_invweight0", "dof_M0",
            "dof_invweight0")  # fmt: skip
STRING = """<tendon><spatial><site site="s"/><geom geom="pulley"/><site site="e"/></spatial></tendon>"""


def written(folder, compiler="", more="", after="", text=ARM):
    (folder / "cover.obj").write_text(TETRAHEDRON)
    (folder / "arm.xml").write_text(text.format(compiler=compiler, more=more, after=after))
    return folder / "arm.xml"


@pytest.mark.parametrize(
    "compiler", ["", '<compiler settotalmass="2"/>', '<compiler inertiafromgeom="true" boundinertia=".01"/>']
)
def test_masses_of_what_is_simulated_are_the_models_to_the_bit(tmp_path, compiler):
    robot = of_file(written(tmp_path, compiler))
    assert robot.lean.ngeom == 2 and robot.lean.nmesh == 0 and robot.mj_model.ngeom == 5
    for field in DYNAMICS:
        assert np.array_equal(getattr(robot.lean, field), getattr(robot.mj_model, field)), field


def test_geoms_that_remain_keep_the_names_that_they_are_counted_by(tmp_path):
    robot = of_file(written(tmp_path))
    assert [robot.lean.geom(i).name for i in range(2)] == ["geom0", "geom4"]
    assert make("contact_friction", where="geom4").bind(robot.lean, 0.005, 1).names == ("geom4",)


def test_what_a_tendon_or_a_sensor_needs_stays(tmp_path):
    sites = ARM.replace('<body name="lower"', '<site name="s" pos="0 0 .1"/><body name="lower"')
    sites = sites.replace('name="elbow" axis="0 1 0" damping=".5"/>', 'name="elbow" axis="0 1 0"/><site name="e"/>')
    wrapped = of_file(written(tmp_path, after=STRING, text=sites))
    assert [wrapped.lean.geom(i).name for i in range(3)] == ["geom0", "pulley", "geom4"]
    seen = '<sensor><distance geom1="pulley" geom2="floor" cutoff="1"/></sensor>'
    spec = mujoco.MjSpec.from_file(str(written(tmp_path, after=seen.replace("floor", "tip"), more='name="tip"')))
    model = spec.compile()
    assert without_visuals(spec, model) is model


def test_a_model_without_meshes_stays_the_same_object(tmp_path):
    spec = mujoco.MjSpec.from_file(str(written(tmp_path)))
    for geom in list(spec.geoms):
        if geom.meshname:
            spec.delete(geom)
    for body in spec.bodies[1:]:
        body.mass, body.inertia, body.ipos, body.explicitinertial = 1.0, [1e-2] * 3, [0.1, 0, 0], True
    model = spec.compile()
    assert without_visuals(spec, model) is model


def test_options_that_a_diagnosis_changes_reach_what_is_simulated(tmp_path):
    robot = of_file(written(tmp_path))
    robot.mj_model.opt.integrator, robot.mj_model.opt.iterations = mujoco.mjtIntegrator.mjINT_EULER, 7
    model = robot.physics(0.01).mj_model
    assert (model.opt.integrator, model.opt.iterations, model.ngeom) == (0, 7, 2)


@pytest.mark.slow
@pytest.mark.ci
def test_the_motion_is_that_of_the_whole_model(tmp_path):
    robot = of_file(written(tmp_path))
    load = make("payload", where="lower")
    whole = Physics(robot.mj_model, 0.01, ParameterSpace(), (load,))
    lean = robot.physics(0.01, (load,), ParameterSpace())
    command = np.random.default_rng(0).normal(size=(1, 40, 2))
    theta = np.array([[0.5, 0.1, 0.0, 0.05]])
    one, two = (
        np.asarray(replay(p, np.zeros((1, 2)), np.zeros((1, 2)), command, theta)["qpos"]) for p in (whole, lean)
    )
    assert np.ptp(one) > 0.3 and np.abs(one - two).max() < 2e-6


def test_names_are_read_without_the_meshes(tmp_path):
    path = written(tmp_path)
    (tmp_path / "cover.obj").unlink()
    model = names_of(path)
    assert [model.joint(j).name for j in range(2)] == ["shoulder", "elbow"] and model.nu == 2 and model.nmesh == 0
