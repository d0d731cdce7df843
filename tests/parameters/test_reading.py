"""BayesSimIG's YAML: names and order of the flat vector, which MuJoCo elements are meant, and what is refused."""

import mujoco
import pytest

from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import ParameterSpace
from tests.parameters.parameter_models import (
    CARTPOLE,
    CARTPOLE_SECTION,
    PENDULUM,
    PENDULUM_SECTION,
    WALKER,
    additive,
    scaling,
)


def read(xml, section):
    return ParameterSpace.from_config(section, mujoco.MjModel.from_xml_string(xml))


def actor(name="walker", **groups):
    return {"actor_params": {name: groups}}


def test_cartpole_has_the_thirteen_parameters_in_bayessimig_order():
    space = read(CARTPOLE, CARTPOLE_SECTION)
    assert space.names == (
        *("slider_mass_mult", "cart_mass_mult", "pole_mass_mult"),
        *("slider_friction_mult", "slider_restitution", "cart_friction_mult", "cart_restitution"),
        *("pole_friction_mult", "pole_restitution"),
        *("slider_to_cart_stiffness", "cart_to_pole_stiffness", "slider_to_cart_damping", "cart_to_pole_damping"),
    )
    assert space.parameters[9].unit == "N/m" and space.parameters[10].unit == "N m/rad"
    assert space.high[-1] == 100 and space.nominal[0] == 1
    assert space.nominal[-1] == pytest.approx(0.01)  # the model's 0 lies below the range: its end


def test_pendulum_without_geoms_has_a_length():
    space = read(PENDULUM, PENDULUM_SECTION)
    assert space.names == ("pendulum_mass_mult", "pendulum_length_mult")
    assert space.parameters[1].axis == (0.0, 0.0, 1.0)


def test_actors_are_subtrees_and_further_shapes_are_numbered():
    names = read(WALKER, actor("torso", rigid_shape_properties={"friction": scaling(0.1, 2)})).names
    assert names[:2] == ("torso_friction_mult", "torso_1_friction_mult")
    assert len(names) == 7
    two = {
        "actor_params": {
            "block": {"scale": scaling(0.5, 2)},
            "walker": {"rigid_body_properties": {"mass": scaling(1, 2)}},
        }
    }
    names = read(WALKER, two).names
    assert names[0] == "block_scale_mult" and "block_mass_mult" not in names and "torso_mass_mult" in names


def test_an_actor_takes_from_the_whole_model_the_property_that_it_states_and_no_other():
    mass = {"mass": scaling(1, 2)}
    two = {
        "block": {"rigid_body_properties": mass},
        "walker": {"rigid_body_properties": mass, "rigid_shape_properties": {"friction": scaling(0.5, 2)}},
    }
    names = read(WALKER, {"actor_params": two}).names
    assert names.count("block_mass_mult") == 1 and "torso_mass_mult" in names
    assert {"block_friction_mult", "torso_friction_mult"} <= {*names}


def test_marks_of_pictures_have_no_mass():
    marked = PENDULUM.replace(
        "</worldbody>",
        '<body name="goal" mocap="true"><geom size="0.1" contype="0" conaffinity="0"/></body></worldbody>',
    )
    for name in ("pendulum", "robot"):
        section = actor(name, rigid_body_properties={"mass": scaling(0.1, 2)})
        assert read(marked, section).names == ("pendulum_mass_mult",)


def test_free_joints_are_no_dofs_and_tendons_are_interleaved():
    space = read(
        WALKER,
        actor(
            dof_properties={"armature": additive(0, 1)},
            tendon_properties={"stiffness": additive(0, 2), "damping": additive(0, 2)},
        ),
    )
    assert "root_armature" not in space.names
    assert space.names[-4:] == ("couple_stiffness", "couple_damping", "string_stiffness", "string_damping")


def test_scaling_the_stiffness_of_a_springless_joint_means_its_servo():
    space = read(WALKER, actor(dof_properties={"stiffness": scaling(0.1, 2, include=["left_hip", "right_hip"])}))
    assert space.names == ("left_hip_stiffness_mult", "right_hip_stiffness_mult")
    assert [(p.kind, p.attribute) for p in space.parameters] == [("joint", "stiffness"), ("actuator", "kp")]


def test_priors_units_factors_and_the_keys_of_bayessimig():
    section = actor(
        dof_properties={
            "damping": {
                **additive("1e-3", 1, include="left_hip"),
                "distribution": "log_uniform",
                "schedule": "constant",
                "schedule_steps": 0,
                "factor": 0.01,
                "unit": "%",
            },
            "armature": {**additive(0, 1), "distribution": "gaussian", "mean": 0.1, "sd": 0.05, "exclude": "left_*"},
        },
        color=True,
    ) | {"frequency": 1, "observations": None, "sim_params": {}}
    space = read(WALKER, {"randomize": True, "randomization_params": section})
    assert space.names[0] == "left_hip_damping" and space.parameters[0].prior == "loguniform"
    assert space.parameters[0].factor == 0.01 and space.units[0] == "%"
    assert space.parameters[1].prior == "gaussian" and space.parameters[1].sd == 0.05
    assert not any("left" in name for name in space.names[1:])


def test_gravity_beside_the_actors():
    effects = {"actuator_delay": {"all": {"delay": {"range": [0, 0.05]}}}}  # an effect's are not the model's
    assert read(PENDULUM, {"option": {"gravity": additive(-1, 1)}, "effects": effects}).names == ("gravity",)
    assert len(read(PENDULUM, {})) == 0


def test_harmless_keys_of_isaac_gym_are_passed_over():
    for key in ("num_buckets", "setup_only"):
        mass = {**scaling(1, 2, include="torso"), key: 1}
        assert len(read(WALKER, actor(rigid_body_properties={"mass": mass}))) == 1


@pytest.mark.parametrize(
    ("section", "words"),
    [
        (actor(rigid_body_propertys={}), "did you mean rigid_body_properties"),
        (
            actor(rigid_body_properties={"mas": scaling(1, 2)}),
            "rigid_body_properties.mas: unknown key; did you mean mass",
        ),
        (actor(rigid_body_properties={"mass": scaling(2, 2)}), r"mass.range: \[2, 2\] is empty"),
        (actor(rigid_body_properties={"mass": {"operation": "scaling"}}), "mass.range: missing"),
        (actor(rigid_body_properties={"mass": scaling("a", 2)}), "'a' is not a number"),
        (
            actor(rigid_body_properties={"mass": {**scaling(1, 2), "rnage": 1}}),
            "mass.rnage: unknown key; did you mean range",
        ),
        (actor(rigid_body_properties={"mass": scaling(1, 2, include=["torsi"])}), "'torsi' here; did you mean torso"),
        (actor(rigid_body_properties={"mass": {**scaling(1, 2), "operation": "mult"}}), "'mult' is none of scaling"),
        (actor(rigid_body_properties={"length": scaling(1, 2, include="torso")}), "no principal axis"),
        (actor(rigid_body_properties={"com_x": additive(-1, 1, include="block")}), "block is compiled as 'simple'"),
        (actor(dof_properties={"friction": additive(0, 1)}), "MJX ignores friction that is 0"),
        (actor(dof_properties={"stiffness": scaling(0.1, 1)}), "left_knee: scaling a number that is 0"),
        ({"actor_params": {"torsi": {}, "block": {}}}, "no actor 'torsi'; did you mean torso"),
        ({"actor_params": {"wolker": {}}}, "no actor 'wolker'; did you mean walker"),
        ({"actor_parms": {}}, "did you mean actor_params"),
        ({"actor_params": 3}, r"task\.randomization_params\.actor_params = 3: expected a section"),
        ({"actor_params": {"walker": 3}}, r"actor_params\.walker = 3: expected a section"),
        (actor(rigid_body_properties=3), r"rigid_body_properties = 3: expected a section with keys of mass"),
        (
            actor(rigid_body_properties={"mass": 3}),
            r"rigid_body_properties\.mass = 3: expected a section with keys of range",
        ),
        (actor(scale=3), r"walker\.scale = 3: expected a section"),
        (actor(rigid_body_properties={"mass": scaling(1, 2, include=3)}), r"mass\.include = 3: expected names"),
        (
            actor(rigid_body_properties={"mass": {**scaling(1, 2), "schedule": "linear"}}),
            r"mass\.schedule_steps: a linear schedule needs the number of steps",
        ),
        (actor(rigid_body_properties={"mass": {**scaling(1, 2), "schedule_steps": -9}}), r"mass\.schedule_steps = -9"),
        (actor(scale={**scaling(1, 2), "schedule": "step"}), r"scale\.schedule: 'step' is none of"),
    ],
)
def test_refusals_name_the_key_and_what_there_is(section, words):
    with pytest.raises(UserError, match=words):
        read(WALKER, section)
