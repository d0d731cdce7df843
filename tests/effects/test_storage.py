"""effects.yaml: written, read back, and used by tasks as what the simulator now knows."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx import config, effects, registry
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.effects.support import storage
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.physics import control_step

MASS = {"name": "pendulum_mass_mult", "attribute": "mass", "target": "pendulum", "kind": "body"}
ARMATURE = {"name": "hinge_armature", "attribute": "armature", "target": "hinge", "kind": "joint"}
SCALE = Parameter(**MASS, nominal=1.0, low=0.8, high=1.2)
ADDED = Parameter(**ARMATURE, nominal=0.0, low=0.0, high=0.1, operation="additive", unit="kg m^2")
STACK = (
    effects.make("actuator_delay", where="all", high=0.3),
    effects.make("coulomb_friction", where=("hinge",), high=2.0),
)
FOUND = {
    "pendulum_mass_mult": (1.1, 0.02),
    "hinge_armature": (0.03, 0.004),
    "all.actuator_delay.delay": (0.03, 0.002),
    "hinge.coulomb_friction.level": (0.4, 0.05),
}


@pytest.fixture
def file(tmp_path):
    return storage.write(tmp_path / "effects.yaml", STACK, FOUND, ParameterSpace([SCALE, ADDED]))


def pendulum(*overrides):
    return registry.make("Pendulum", config=config.load("Pendulum", overrides=list(overrides)))


def test_what_is_written_is_read_back(file):
    found = storage.read(file)
    assert [e.name for e in found.effects] == ["actuator_delay", "coulomb_friction"]
    assert found.effects[0].high == 0.3 and found.effects[1].where == ("hinge",)
    parameters = [*found.calibrated, *(p for e in found.effects for p in e.space().parameters)]
    assert {p.name: (p.nominal, p.sd) for p in parameters} == FOUND
    assert all(p.prior == "gaussian" and p.mean == p.nominal for p in parameters)
    assert (parameters[1].operation, parameters[1].unit, parameters[1].high) == ("additive", "kg m^2", 0.1)
    assert (parameters[2].high, parameters[2].unit) == (0.3, "s")
    again = storage.write(file.with_name("again.yaml"), found.effects, FOUND, ParameterSpace(found.calibrated))
    assert again.read_text().splitlines()[1:] == file.read_text().splitlines()[1:]


def test_a_distribution_is_written_by_its_moments(tmp_path):
    space = ParameterSpace([SCALE]) + STACK[0].space()
    q = Distribution.gaussian(space, [1.05, 0.1], [0.01, 0.005])
    (delay,) = storage.read(storage.write(tmp_path / "e.yaml", STACK[:1], q)).effects[0].space().parameters
    np.testing.assert_allclose((delay.mean, delay.sd), (0.1, 0.005), rtol=0.05)


def test_a_value_at_the_end_of_the_range_and_a_certain_one(tmp_path):
    path = storage.write(tmp_path / "e.yaml", STACK[:1], {"all.actuator_delay.delay": (-1e-9, 0.0)})
    (delay,) = storage.read(path).effects[0].space().parameters
    assert delay.nominal == 0.0 and 0 < delay.sd < 1e-6
    with pytest.raises(UserError, match=r"no value of all\.actuator_delay\.delay; there are: x"):
        storage.write(tmp_path / "e.yaml", STACK[:1], {"x": (0, 1)})


def test_the_loops_simulator_is_the_corrected_one(file):
    env, plain = pendulum(f"effects={file}"), pendulum()
    names = ("pendulum_mass_mult", "pendulum_length_mult", "all.actuator_delay.delay", "hinge.coulomb_friction.level")
    assert env.space.names == names
    np.testing.assert_allclose(env.space.nominal, [1.1, 1.0, 0.03, 0.4], rtol=1e-6)
    mass = env.space.parameters[0]
    assert (mass.prior, mass.mean, mass.sd, mass.low, mass.high) == ("gaussian", 1.1, 0.02, 0.01, 2.0)
    # the task has no armature of its own: it is in the model, and in the spec that compiles to it
    assert env.mj_model.dof_armature[0] == pytest.approx(0.03) == env.spec().compile().dof_armature[0]
    assert plain.mj_model.dof_armature[0] == 0.0
    draws = np.asarray(Distribution.prior(env.space).sample(np.uint32([0, 1]), 2000))
    np.testing.assert_allclose(draws.std(0)[[0, 2, 3]], [0.02, 0.002, 0.05], rtol=0.1)


@pytest.mark.slow
@pytest.mark.ci
def test_nominal_physics_is_corrected_also_without_randomisation(file):
    env = pendulum(f"effects={file}", "task.randomize=False")
    assert env.space.names == ("all.actuator_delay.delay", "hinge.coulomb_friction.level")
    # m l^2 / 3 of the heavier rod, and the armature; friction holds the rod upright where it is unstable without
    fell = control_step(env.physics, env.physics.world(env.space.nominal, np.float32([0.02])), np.zeros(1))[0]
    assert abs(float(fell.qvel[0])) < 1e-6
    assert env.mj_model.body_mass[1] == pytest.approx(1.1) and env.mj_model.dof_armature[0] == pytest.approx(0.03)


def test_the_resolved_config_holds_the_contents(file, tmp_path):
    loaded = config.load("Pendulum", overrides=[f"effects={file}"])
    (tmp_path / "env.yaml").write_text(config.to_yaml(loaded.to_dict()))
    file.unlink()
    again = config.load(cfg_env=tmp_path / "env.yaml")
    assert again == loaded and len(again.effects) == len(again.calibrated) == 2
    assert registry.make("Pendulum", config=again).space == registry.make("Pendulum", config=loaded).space


def test_a_config_file_may_name_the_file_and_later_effects_replace_all(file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "c.yaml").write_text("effects: effects.yaml\n")
    assert len(config.load("Pendulum", cfg_env=tmp_path / "c.yaml").calibrated) == 2
    other = config.load("Pendulum", cfg_env=tmp_path / "c.yaml", overrides=["effects=[]"])
    assert other.effects == () == other.calibrated


def test_ranges_of_the_task_still_win_over_those_of_the_file(file):
    env = pendulum(
        f"effects={file}", "task.randomization_params.effects.actuator_delay.all.delay={range: [0, 0.05], sd: 0.01}"
    )
    delay = env.space.parameters[2]
    assert (delay.high, delay.sd, delay.mean, delay.nominal) == (0.05, 0.01, 0.03, 0.03)


PART = """<mujoco><worldbody><body name="b"><joint name="j" damping="0.5" armature="0.1"/><geom size="0.1" mass="2"/>
</body></worldbody></mujoco>"""


@pytest.mark.parametrize("theirs", ["scaling", "additive", "absolute"])
@pytest.mark.parametrize("ours", ["scaling", "additive", "absolute"])
def test_calibrated_numbers_are_converted_between_operations(ours, theirs):
    """Damping 0.5 was found to be 0.6 +- 0.01, whichever way it was said."""
    mean = {"scaling": 1.2, "additive": 0.05, "absolute": 0.3}[theirs]  # with factor 2
    sd = {"scaling": 0.02, "additive": 0.005, "absolute": 0.005}[theirs]
    found = Parameter(
        "x", mean, 0, 2, mean=mean, sd=sd, prior="gaussian", operation=theirs, attribute="damping", target="#0",
        kind="joint", factor=1.0 if theirs == "scaling" else 2.0,
    )  # fmt: skip
    ranges = {"scaling": [0.9, 1.1], "additive": [-0.05, 0.05], "absolute": [0.45, 0.55]}
    section = {"actor_params": {"robot": {"dof_properties": {"damping": {"range": ranges[ours], "operation": ours}}}}}
    spec, model, space = storage.corrected(mujoco.MjSpec.from_string(PART), section, [found])
    (own,) = space.parameters
    slope = 0.5 if ours == "scaling" else 1.0
    assert own.operation == ours and own.sd == pytest.approx(0.01 / slope)
    assert own.high == pytest.approx(own.mean + 3 * own.sd)  # widened to hold what was found
    assert model.dof_damping[0] == 0.5
    assert space.edit(spec, space.nominal).compile().dof_damping[0] == pytest.approx(0.6)


def test_what_the_task_does_not_randomise_is_fixed_and_the_rest_untouched():
    found = Parameter("m", 3.0, 1, 5, mean=3.0, sd=0.1, prior="gaussian", operation="absolute", attribute="mass",
                      target="b", kind="body")  # fmt: skip
    spec, model, space = storage.corrected(mujoco.MjSpec.from_string(PART), {}, [found])
    assert len(space) == 0 and model.body_mass[1] == pytest.approx(3.0) and model.dof_damping[0] == 0.5
    with pytest.raises(UserError, match=r"calibrated m: no body 'c' in the model; "):
        storage.corrected(mujoco.MjSpec.from_string(PART), {}, [Parameter(**{**vars(found), "target": "c"})])


GOOD = "schema: 1\neffects: [{effect: coulomb_friction, where: hinge, parameters: {level: {nominal: 0.2}}}]\n"
ENTRY = "{name: a, mean: 1, sd: 0.1, low: 0, high: 2, kind: joint, attribute: damping, target: hinge}"
BAD = {
    "[1, 2]": r"e\.yaml: expected sections",
    "schema: 2\n": r"e\.yaml: schema = 2: expected schema: 1",
    GOOD + "efects: []\n": r"e\.yaml: key 'efects' is unknown\. Did you mean effects",
    GOOD.replace("level", "levl"): r"effects\[0\]\.parameters\.levl: .*did you mean level",
    GOOD.replace("0.2", "many"): r"effects\[0\]\.parameters\.level\.nominal: 'many' is not a number",
    GOOD.replace("hinge", "[hinge]"): r"effects\[0\]\.parameters\.level: there are: hinge",
    GOOD.replace("coulomb_friction", "colomb_friction"): r"effects\[0\]: no effect.*did you mean coulomb_friction",
    GOOD + f"calibrated: [{ENTRY.replace('sd: 0.1', 'sd: 0')}]": r"calibrated\[0\]: .*needs mean and sd > 0",
    GOOD + f"calibrated: [{ENTRY.replace('sd: 0.1', 'ds: 1')}]": r"calibrated\[0\]: key 'ds' is unknown",
    GOOD + f"calibrated: [{ENTRY.replace('target: hinge', '')}]": r"calibrated\[0\]\.target is missing",
    GOOD + f"calibrated: [{ENTRY.replace('mean: 1', 'mean: 3')}]": r"calibrated\[0\]: .*outside its range",
}


@pytest.mark.parametrize("text", BAD)
def test_a_bad_file_is_one_line_that_names_it(text, tmp_path):
    (tmp_path / "e.yaml").write_text(text)
    with pytest.raises(UserError, match=BAD[text]) as caught:
        storage.read(tmp_path / "e.yaml")
    assert str(caught.value).startswith(str(tmp_path / "e.yaml")) and "\n" not in str(caught.value)
    with pytest.raises(UserError, match=BAD[text]):
        pendulum(f"effects={tmp_path / 'e.yaml'}")


def test_a_missing_file_is_named_and_foreign_environments_take_none():
    with pytest.raises(
        UserError, match=r"effects = 'no\.yaml' \(override 'effects=no\.yaml'\): no such file; expected"
    ):
        pendulum("effects=no.yaml")
    settings = config.replace(config.load("brax:ant"), effects=(config.freeze({"effect": "cogging", "where": "all"}),))
    with pytest.raises(UserError, match="effects: brax:ant is not simulated here"):
        registry.make("brax:ant", config=settings)
