"""space.write(model, theta) equals recompiling the edited MJCF, over every field; and what write promises besides."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import Parameter, ParameterSpace, set_const
from bayessim_mjx.parameters.constants import mjx
from tests.parameters.parameter_models import (
    CARTPOLE,
    CARTPOLE_SECTION,
    PENDULUM,
    PENDULUM_SECTION,
    WALKER,
    additive,
    scaling,
)
from tests.parameters.recompile import assert_write_equals_recompile, random_thetas, spec_of

NUMBERS = {
    "rigid_body_properties": {
        "mass": scaling(0.2, 3),
        "inertia": scaling(0.5, 2),
        "com_x": additive(-0.05, 0.05, exclude=["block"]),
    },
    "rigid_shape_properties": {"friction": scaling(0.1, 3), "restitution": additive(0.01, 1)},
    "dof_properties": {
        "stiffness": additive(0.1, 5),
        "damping": scaling(0.1, 5, exclude="block_x"),
        "armature": additive(0.0, 0.1),
        "friction": additive(0.01, 0.5, include="left_knee"),
    },
    "tendon_properties": {
        "stiffness": scaling(0.1, 3),
        "damping": additive(0.1, 3),
        "friction": scaling(0.1, 3, include="string"),
    },
    "actuator_properties": {"gain": scaling(0.5, 2), "bias": additive(-1, 1)},
    "option": {"gravity": scaling(0.5, 1.5)},
}
LENGTHS = {
    "rigid_body_properties": {
        "length": scaling(0.5, 2, exclude=["torso", "right_shin"]),
        "mass": scaling(0.5, 2, include="*_thigh"),
    }
}
CASES = {
    "pendulum": (PENDULUM, PENDULUM_SECTION),
    "cartpole": (CARTPOLE, CARTPOLE_SECTION),
    "walker: every number": (WALKER, {"actor_params": {"walker": NUMBERS}}),
    "walker: lengths": (WALKER, {"actor_params": {"walker": LENGTHS}}),
    "walker: scales": (WALKER, {"actor_params": {k: {"scale": scaling(0.5, 2)} for k in ("torso", "block", "swing")}}),
    "walker: absolute and additive": (
        WALKER,
        {
            "option": {"gravity": additive(-2, 2)},
            "actor_params": {
                "walker": {
                    "rigid_body_properties": {"mass": {"range": [0.5, 4], "operation": "absolute"}},
                    "actuator_properties": {
                        "kp": {"range": [10, 80], "operation": "absolute", "include": "*_hip"},
                        "kv": additive(0.1, 2, include="*_hip"),
                    },
                }
            },
        },
    ),
}


LONG = ("walker: lengths", "walker: scales", "walker: absolute and additive")  # "every number" stays


@pytest.mark.parametrize(
    "case", [pytest.param(c, marks=[pytest.mark.slow, pytest.mark.ci] if c in LONG else []) for c in CASES]
)
def test_write_equals_recompiling_the_edited_mjcf(case):
    xml, section = CASES[case]
    spec = spec_of(xml)
    space = ParameterSpace.from_config(section, spec.copy().compile())
    thetas = np.concatenate([space.nominal[None], random_thetas(space, 3), space.low[None], space.high[None]])
    assert_write_equals_recompile(spec, space, thetas)


def pendulum():
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    return mjx.put_model(model, impl="jax"), ParameterSpace.from_config(PENDULUM_SECTION, model)


def test_the_rod_of_a_pendulum_keeps_its_mass_when_it_grows():
    model, space = pendulum()
    longer = space.write(model, space.vector({"pendulum_length_mult": 2.0}))
    assert longer.body_mass[1] == 1.0
    np.testing.assert_allclose(longer.body_ipos[1], [0, 0, 1.0])
    np.testing.assert_allclose(longer.body_inertia[1, :2], 4 / 12, rtol=1e-4)  # m l^2 / 12
    np.testing.assert_allclose(longer.dof_invweight0, 3 / 4, rtol=1e-4)  # 1 / (m l^2 / 3)


def test_nominal_theta_leaves_the_primary_fields_equal():
    model, space = pendulum()
    same = space.write(model, space.nominal)
    for name in ("body_mass", "body_inertia", "body_ipos", "body_subtreemass"):
        np.testing.assert_array_equal(getattr(same, name), getattr(model, name))


def test_untouched_leaves_stay_the_identical_objects():
    model, space = pendulum()
    heavier = space.subset(["pendulum_mass_mult"]).write(model, jnp.array([2.0]))
    before, after = jax.tree_util.tree_leaves_with_path(model), jax.tree.leaves(heavier)
    changed = {jax.tree_util.keystr(p) for (p, a), b in zip(before, after, strict=True) if a is not b}
    assert changed == {
        *(".body_mass", ".body_inertia", ".body_subtreemass", ".body_invweight0", ".dof_invweight0", ".dof_M0"),
        *(".actuator_acc0", ".stat.meanmass", ".stat.meaninertia", ".cam_pos0", ".cam_poscom0"),
    }
    assert ParameterSpace().write(model, jnp.zeros(0)) is model


def test_parameters_of_effects_are_not_written():
    model, _ = pendulum()
    space = ParameterSpace([Parameter("hinge.payload.mass", 0, 0, 5, attribute="mass", target="hinge", kind="effect")])
    assert space.write(model, jnp.ones(1)) is model


def test_many_worlds_at_once_and_no_second_trace():
    model, space = pendulum()
    traces = []

    @jax.jit
    def inertias(thetas):
        traces.append(1)
        return jax.vmap(lambda theta: space.write(model, theta).body_inertia[1])(thetas)

    one = np.stack([random_thetas(space, 1, seed=i)[0] for i in range(4)])
    got = inertias(one)
    alone = np.stack([space.write(model, theta).body_inertia[1] for theta in one])
    np.testing.assert_allclose(got, alone, rtol=1e-5)
    inertias(one[::-1])
    assert len(traces) == 1


def test_the_space_and_the_model_may_be_arguments_of_jit():
    model, space = pendulum()
    write = jax.jit(ParameterSpace.write, static_argnums=0)
    again = ParameterSpace(space.parameters)
    assert again == space and hash(again) == hash(space)
    theta = space.vector([1.5, 0.5])
    np.testing.assert_allclose(write(again, model, theta).body_mass, space.write(model, theta).body_mass)


def test_set_const_of_the_nominal_model_changes_nothing():
    model = mjx.put_model(mujoco.MjModel.from_xml_string(CARTPOLE), impl="jax")
    again = jax.jit(set_const)(model)
    for a, b in zip(jax.tree.leaves(model), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-6)


def test_restitution_is_what_a_bounce_keeps():
    """A sphere's contact as a free damped oscillator keeps the fraction e of its speed over half a period."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body name="ball"><geom size=".1"/></body></worldbody></mujoco>'
    )
    space = ParameterSpace(
        [Parameter("e", 0, 0, 1, operation="additive", attribute="restitution", target="#0", kind="geom")]
    )
    nominal = mjx.put_model(model, impl="jax")
    zeta = float(space.write(nominal, jnp.array([0.5])).geom_solref[0, 1])
    assert np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2)) == pytest.approx(0.5, rel=1e-4)
    assert space.write(nominal, jnp.array([0.0])).geom_solref[0, 1] == nominal.geom_solref[0, 1]


def test_refusals_when_writing_and_editing():
    model, space = pendulum()
    with pytest.raises(UserError, match=r"theta has shape \(3, 2\).*vmap"):
        space.write(model, jnp.ones((3, 2)))
    for p, words in (
        (Parameter("a", 1, 0.1, 2, attribute="mass", target="pendulun", kind="body"), "did you mean pendulum"),
        (
            Parameter("b", 1, 0.1, 2, attribute="masss", target="pendulum", kind="body"),
            "no body 'masss' to write.*body mass",
        ),
    ):
        with pytest.raises(UserError, match=words):
            ParameterSpace([p]).write(model, jnp.ones(1))


def test_masses_that_the_compiler_changes_are_scaled_as_it_leaves_them():
    spec, (_, space) = spec_of(PENDULUM), pendulum()
    spec.compiler.settotalmass, spec.compiler.boundinertia = 3.0, 0.5
    assert_write_equals_recompile(spec, space, random_thetas(space, 1))


def test_edit_leaves_the_given_spec_alone():
    spec, (_, space) = spec_of(PENDULUM), pendulum()
    before = spec.to_xml()
    assert space.edit(spec, [2.0, 0.5]).to_xml() != before
    assert spec.to_xml() == before
