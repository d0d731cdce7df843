"""From a diagnosis to the corrected simulator, its prior, effects.yaml and the MJCF: all say the same."""

import dataclasses
import math

import jax
import mujoco
import numpy as np
import pytest

from bayessim_mjx import config, registry
from bayessim_mjx.diagnosis import correction, result
from bayessim_mjx.diagnosis.correction import Estimate
from bayessim_mjx.diagnosis.fitting.robot import of_file, of_task
from bayessim_mjx.diagnosis.summary import files
from bayessim_mjx.effects.support import storage
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.rollout import replay

from .handwritten import diagnosis

MASS = "pendulum_mass_mult"
FOUND = diagnosis(
    [
        ("coulomb_friction", "hinge", {"level": (0.3, 0.02)}),
        ("actuator_gain", "all", {"gain": (0.6, 0.03)}),
        ("actuator_delay", "torque", {"delay": (0.06, 0.004)}),
    ],
    {MASS: (1.1, 0.01)},
)
ARM = """<mujoco><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" damping="0.1"/><geom size=".05" mass="1"/>
    <body name="lower" pos="0 0 .3"><joint name="elbow" axis="0 1 0"/><geom size=".05" mass=".5" pos="0 0 .1"/></body>
  </body></worldbody>
  <actuator><motor name="m1" joint="shoulder"/><motor name="m2" joint="elbow"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def robot():
    return of_task(registry.make("Pendulum"))


@pytest.fixture(scope="module")
def corrected(robot):
    return FOUND.apply(robot.physics(robot.control_dt))


@pytest.fixture
def arm(tmp_path):
    (tmp_path / "arm.xml").write_text(ARM)
    return of_file(tmp_path / "arm.xml")


def swing(physics, theta):
    """Positions `[T]` under a square wave of torque."""
    command = np.sign(np.sin(np.arange(60) / 5.0))[None, :, None]
    start = np.array([[2.0]]), np.array([[0.5]])
    return np.asarray(replay(physics, *start, command, np.asarray(theta)[None])["qpos"])[0, :, 0]


def test_effects_carry_the_estimates_in_the_librarys_order():
    effects = correction.effects_of(FOUND)
    assert [(e.name, e.where) for e in effects] == [
        ("actuator_gain", "all"),
        ("coulomb_friction", "hinge"),
        ("actuator_delay", "torque"),
    ]
    (gain,), (level,), (delay,) = (e.space().parameters for e in effects)
    assert (delay.nominal, delay.mean, delay.sd, delay.prior) == (0.06, 0.06, 0.004, "gaussian")
    assert gain.name == "all.actuator_gain.gain" and level.low == 0.0  # friction below 0 would drive


@pytest.mark.parametrize(
    ("name", "quantity", "mean", "sd", "low", "high"),
    [
        ("coulomb_friction", "level", 3.0, 0.5, 0.0, 5.0),  # the library ends at 1
        ("actuator_gain", "gain", 0.3, 0.2, 0.15, 1.5),  # never negative
        ("joint_offset", "offset", -0.2, 0.01, -0.24, 0.1),
        ("coulomb_friction", "level", 0.5, math.nan, 0.0, 0.5 + 4 * 1 / 12**0.5),  # sd not known: uniform up to 1
    ],
)
def test_ranges_hold_the_estimate_and_stay_physical(name, quantity, mean, sd, low, high):
    (effect,) = correction.effects_of(diagnosis([(name, "all", {quantity: (mean, sd)})]))
    (p,) = effect.space().parameters
    np.testing.assert_allclose((p.nominal, p.low, p.high), (mean, low, high), rtol=1e-6)


def test_one_effect_at_two_joints_keeps_two_values():
    two = [("coulomb_friction", w, {"level": (v, 0.01)}) for w, v in (("shoulder", 0.1), ("elbow", 0.2))]
    (effect,) = correction.effects_of(diagnosis(two))
    assert effect.where == ("shoulder", "elbow")
    assert dict(zip(effect.space().names, effect.space().nominal.tolist(), strict=True)) == pytest.approx(
        {"shoulder.coulomb_friction.level": 0.1, "elbow.coulomb_friction.level": 0.2}
    )


def test_an_estimate_that_is_missing_is_refused():
    with pytest.raises(UserError, match="payload at link: no value of mass; it has level"):
        correction.effects_of(diagnosis([("payload", "link", {"level": (1.0, 0.1)})]))
    with pytest.raises(UserError, match="no value of level"):
        correction.effects_of(diagnosis([("coulomb_friction", "hinge", {"level": (math.nan, 0.1)})]))
    with pytest.raises(UserError, match="no effect 'coulom'"):
        correction.effects_of(diagnosis([("coulom", "hinge", {"level": (1.0, 0.1)})]))


@pytest.mark.slow
@pytest.mark.ci
def test_the_corrected_simulator_is_nominal_at_what_was_identified(robot, corrected):
    names = (MASS, "all.actuator_gain.gain", "hinge.coulomb_friction.level", "torque.actuator_delay.delay")
    assert corrected.space.names == names
    np.testing.assert_allclose(corrected.space.nominal, [1.1, 0.6, 0.3, 0.06], rtol=1e-6)
    assert (corrected.dt, corrected.mj_model.nv) == (robot.control_dt, 1)
    plain = robot.physics(robot.control_dt)
    assert np.abs(swing(corrected, corrected.space.nominal) - swing(plain, plain.space.nominal)).max() > 0.1


@pytest.mark.slow
def test_the_prior_is_that_of_the_corrected_simulator(robot, corrected):
    q = FOUND.prior(robot.physics(robot.control_dt))
    assert q.space == corrected.space == FOUND.prior(robot.space).space
    draws = np.asarray(q.sample(jax.random.PRNGKey(0), 4000))
    np.testing.assert_allclose(draws.mean(0), [1.1, 0.6, 0.3, 0.06], rtol=0.01)
    np.testing.assert_allclose(draws.std(0), [0.01, 0.03, 0.02, 0.004], rtol=0.1)
    alone = FOUND.prior()  # by the record in the diagnosis: other ranges, the same names and numbers
    assert alone.names == q.names
    np.testing.assert_allclose(alone.mean(), q.mean(), rtol=1e-4)


def test_the_prior_keeps_what_is_known_of_parameters_together(robot, corrected):
    level, delay = "hinge.coulomb_friction.level", "torque.actuator_delay.delay"
    names = [level, MASS, "all.actuator_gain.gain", delay]  # in the fit's order, not the simulator's
    sd, correlation = np.array([0.02, 0.01, 0.03, 0.004]), np.eye(4)
    correlation[0, 2] = correlation[2, 0] = 0.95
    joint = dataclasses.replace(FOUND, covariance={"names": names, "matrix": correlation * np.outer(sd, sd)})
    q = joint.prior(robot.physics(robot.control_dt))
    assert q.names == corrected.space.names
    np.testing.assert_allclose((q.space.low, q.space.high), (corrected.space.low, corrected.space.high))
    draws = np.asarray(q.sample(jax.random.PRNGKey(0), 4000))
    np.testing.assert_allclose(draws.mean(0), [1.1, 0.6, 0.3, 0.06], rtol=0.01)
    np.testing.assert_allclose(draws.std(0), [0.01, 0.03, 0.02, 0.004], rtol=0.05)
    drawn = np.corrcoef(draws.T)
    assert drawn[1, 2] == pytest.approx(0.95, abs=0.01) and abs(drawn[0, 3]) < 0.05


def test_draws_of_the_prior_stay_in_the_ranges(robot):
    wide = dataclasses.replace(FOUND, covariance={"names": ["hinge.coulomb_friction.level"], "matrix": [[1.0]]})
    draws = np.asarray(wide.prior(robot.space).sample(jax.random.PRNGKey(0), 500))
    level = draws[:, 2]
    assert level.min() >= 0.0 and level.std() > 0.1  # friction never drives


def test_a_parameter_that_the_simulator_has_not_is_refused(robot):
    other = dataclasses.replace(FOUND, parameters={"pole_mass_mult": FOUND.parameters[MASS]})
    with pytest.raises(UserError, match="no parameter 'pole_mass_mult'.*pendulum_mass_mult"):
        correction.calibrated_of(other, robot.space)


def test_a_place_that_the_model_has_not_is_refused(robot):
    wrong = diagnosis([("coulomb_friction", "elbow", {"level": (0.3, 0.1)})])
    with pytest.raises(UserError, match="coulomb_friction: no joint 'elbow'"):
        wrong.apply(robot.physics(robot.control_dt))


@pytest.mark.slow
@pytest.mark.ci
def test_effects_yaml_simulates_like_apply(robot, corrected, tmp_path):
    FOUND.save(tmp_path)
    loaded = result.load(tmp_path)  # what a later command has
    sentences = files.write_outputs(loaded, robot, tmp_path)
    settings = config.load("Pendulum", overrides=[f"effects={tmp_path}/effects.yaml"])
    env = registry.make("Pendulum", config=settings)
    np.testing.assert_allclose(
        swing(env.physics, env.space.nominal), swing(corrected, corrected.space.nominal), atol=1e-4
    )
    assert len(storage.read(tmp_path / "effects.yaml").calibrated) == 1
    assert len(sentences) == 1 and "actuator_delay at torque" in sentences[0]


def test_the_mjcf_has_what_mujoco_can_express(robot, tmp_path):
    files.write_outputs(FOUND, robot, tmp_path)
    text = (tmp_path / "model_with_effects.xml").read_text()
    model = mujoco.MjModel.from_xml_string(text)
    assert model.dof_frictionloss[0] == pytest.approx(0.3)
    assert model.actuator_gainprm[0, 0] == pytest.approx(0.6)
    assert model.body_mass[1] == pytest.approx(1.1)
    assert text.startswith("<!-- Not in this model:") and "actuator_delay at torque" in text
    data = mujoco.MjData(model)
    data.qpos[0] = (
        0.03  # 0.16 N m of gravity against 0.3 N m of friction: it stays, although the task has no constraints
    )
    mujoco.mj_step(model, data, 40)
    assert abs(data.qpos[0] - 0.03) < 0.01


def test_known_parameters_without_estimates_stay_out_of_the_file(arm, tmp_path):
    one = diagnosis([], {"upper_mass_mult": (0.9, 0.02)})
    assert files.write_outputs(one, arm, tmp_path) == []
    (p,) = storage.read(tmp_path / "effects.yaml").calibrated
    assert (p.name, p.mean, p.sd, p.low) == ("upper_mass_mult", 0.9, 0.02, pytest.approx(0.3))
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model_with_effects.xml"))
    np.testing.assert_allclose(model.body_mass[1:], [0.9, 0.5], rtol=1e-5)


def test_a_diagnosis_without_findings_changes_nothing(robot):
    nothing = diagnosis([])
    physics = robot.physics(robot.control_dt)
    same = nothing.apply(physics)
    assert same.space == physics.space and same.effects == ()
    assert nothing.prior().space == ParameterSpace()


def test_meshes_are_found_from_the_new_place(tmp_path):
    folder = tmp_path / "robot"
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes" / "tetra.obj").write_text(
        "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    (folder / "robot.xml").write_text(
        '<mujoco><compiler meshdir="meshes"/><asset><mesh name="tetra" file="tetra.obj"/></asset><worldbody>'
        '<body name="link"><joint name="j"/><geom type="mesh" mesh="tetra" contype="0" conaffinity="0"/></body>'
        '</worldbody><actuator><motor name="m" joint="j"/></actuator></mujoco>'
    )
    out = tmp_path / "found"
    out.mkdir()
    files.write_outputs(
        diagnosis([("coulomb_friction", "j", {"level": (0.3, 0.1)})]), of_file(folder / "robot.xml"), out
    )
    model = mujoco.MjModel.from_xml_path(str(out / "model_with_effects.xml"))
    assert model.nmesh == 1 and model.dof_frictionloss[0] == pytest.approx(0.3)


def test_a_value_without_an_interval_is_as_wide_as_its_range(robot):
    """A uniform distribution's standard deviation is its range over the root of twelve."""
    (own,) = [p for p in robot.space.parameters if p.name == MASS]
    found = diagnosis([], {MASS: (1.1, np.nan)})
    (known,) = [p for p in correction.calibrated_of(found, robot.space).parameters if p.name == MASS]
    assert known.nominal == known.mean == 1.1 and known.prior == "gaussian"
    assert known.sd == pytest.approx((own.high - own.low) / 12**0.5)


def test_an_estimate_prints_as_people_read_it():
    """Inside of the dict that README prints, too."""
    found = Estimate(0.119068, 0.00159, "N m")
    assert str(found) == "0.1191 +- 0.0016 N m" and str({"level": found}) == "{'level': 0.1191 +- 0.0016 N m}"
