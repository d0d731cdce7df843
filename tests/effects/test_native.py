"""Parameters and effects written into an MJCF: what compiles, and what is said of the rest."""

import dataclasses

import mujoco
import pytest

from bayessim_mjx import effects
from bayessim_mjx.effects.coulomb_friction import CoulombFriction
from bayessim_mjx.effects.support.native import write_model
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import Parameter, ParameterSpace

ARM = """<mujoco><option integrator="implicitfast"/><worldbody><body name="a"><joint name="first" damping="0.1"/>
  <geom size="0.1" mass="1"/><body><joint type="slide"/><geom size="0.1" mass="2"/></body></body></worldbody>
  <actuator><motor joint="first"/></actuator></mujoco>"""
SPACE = ParameterSpace([Parameter("damping", 1.0, 0.5, 2.0, attribute="damping", target="first", kind="joint")])


@pytest.fixture
def spec():
    return mujoco.MjSpec.from_string(ARM)


def test_parameters_and_effects_are_both_in_the_model(spec):
    stack = [effects.make("coulomb_friction", where="first"), effects.make("armature", where="first")]
    values = {"first.coulomb_friction.level": 0.3, "first.armature.inertia": 0.02}
    written, missing = write_model(spec, SPACE, [1.5], stack, values)
    model = mujoco.MjModel.from_xml_string(written.to_xml())
    assert missing == []
    assert (model.dof_frictionloss[0], model.dof_armature[0]) == pytest.approx((0.3, 0.02))
    assert model.dof_damping[0] == pytest.approx(0.15) and spec.compile().dof_damping[0] == pytest.approx(0.1)


def test_all_places_and_unnamed_joints(spec):
    everywhere = effects.make("coulomb_friction", where="all")
    model = write_model(spec, SPACE, {}, [everywhere], {"all.coulomb_friction.level": 0.3})[0].compile()
    assert list(model.dof_frictionloss) == pytest.approx([0.3, 0.3]) and model.joint(1).name == "joint1"
    each = effects.make("coulomb_friction", where=("first", "joint1"))
    values = {"first.coulomb_friction.level": 0.1, "joint1.coulomb_friction.level": 0.2}
    model = write_model(spec, SPACE, {}, [each], values)[0].compile()
    assert list(model.dof_frictionloss) == pytest.approx([0.1, 0.2])


def test_identified_values_are_nominal_where_none_are_given(spec):
    (p,) = effects.make("coulomb_friction", where="first").space().parameters
    known = CoulombFriction("first", parameters=(dataclasses.replace(p, nominal=0.25),))
    assert write_model(spec, SPACE, {}, [known])[0].compile().dof_frictionloss[0] == 0.25


@dataclasses.dataclass(frozen=True)
class Broken(CoulombFriction):
    """Its edit leaves an MJCF that does not compile."""

    def edit(self, spec, values):
        spec.joint("first").type = mujoco.mjtJoint.mjJNT_FREE
        spec.joint("first").frictionloss = 3.0
        spec.bodies[2].add_freejoint()
        return None


def test_what_cannot_be_written_is_said_with_the_reason_and_leaves_no_trace(spec):
    stack = [effects.make("actuator_delay", where="all"), Broken("first"), effects.make("coulomb_friction", "first")]
    written, missing = write_model(spec, SPACE, {}, stack, {"first.coulomb_friction.level": 0.3})
    assert missing[0].startswith("actuator_delay at all: MuJoCo's delay buffer holds whole timesteps")
    assert missing[1].startswith("coulomb_friction at first: MuJoCo refuses it: ") and len(missing) == 2
    model = written.compile()
    assert model.joint(0).type[0] == int(mujoco.mjtJoint.mjJNT_HINGE)
    assert model.dof_frictionloss[0] == pytest.approx(0.3)


@pytest.mark.parametrize("name", ["stribeck_friction", "lugre_friction"])
def test_of_friction_that_falls_with_speed_the_level_is_written_and_the_rest_is_named(spec, name):
    """Left out as a whole, the model for plain MuJoCo would lose most of the friction that was found."""
    stack = [effects.make("coulomb_friction", where="all"), effects.make(name, where="first")]
    values = {"all.coulomb_friction.level": 0.08, f"first.{name}.level": 0.17, f"first.{name}.excess": 0.04}
    written, missing = write_model(spec, SPACE, {}, stack, values)
    assert list(written.compile().dof_frictionloss) == pytest.approx([0.25, 0.08])
    assert len(missing) == 1 and missing[0].startswith(f"a part of {name} at first: ") and "excess" in missing[0]


def test_of_friction_that_differs_by_direction_the_mean_is_written(spec):
    numbers = {"level_forward": 0.3, "level_backward": 0.1, "viscous_forward": 0.05, "viscous_backward": 0.01}
    effect = effects.make("asymmetric_friction", where="first")
    values = {f"first.asymmetric_friction.{number}": value for number, value in numbers.items()}
    before = spec.compile().dof_damping[0]
    written, missing = write_model(spec, SPACE, {}, [effect], values)
    model = written.compile()
    assert (model.dof_frictionloss[0], model.dof_damping[0] - before) == pytest.approx((0.2, 0.03))
    assert missing == [
        "a part of asymmetric_friction at first: its dependence on the direction, which MuJoCo's joints do not have; "
        "use effects.yaml"
    ]


def test_masses_that_mujoco_fixes_by_their_sum_are_those_that_it_found(spec):
    spec.compiler.settotalmass = 6.0  # twice what the geoms have
    space = ParameterSpace([Parameter("mass", 1.0, 0.5, 2.0, attribute="mass", target="a", kind="body")])
    load = effects.make("payload", where="body2")
    written, missing = write_model(spec, space, [1.1], [load], {"body2.payload.mass": 0.5})
    model = mujoco.MjModel.from_xml_string(written.to_xml())
    assert missing == [] and model.body_mass[1:] == pytest.approx([2.2, 4.5])


def test_an_unknown_place_is_refused(spec):
    with pytest.raises(UserError, match=r"no joint 'frist' in the model; did you mean first"):
        write_model(spec, SPACE, {}, [effects.make("coulomb_friction", where="frist")])
