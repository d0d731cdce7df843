"""What the finer reality hides and what the library has: the same effects, parameters and motion."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx import effects
from bayessim_mjx.blind.check import Check, effects_of, unasked
from bayessim_mjx.blind.reality import twin
from bayessim_mjx.blind.reality.bodies import ground
from bayessim_mjx.blind.reality.drives import quickest
from bayessim_mjx.blind.reality.menu import CAUSES, KNOWN
from bayessim_mjx.blind.reality.plant import Plant, scales_of
from bayessim_mjx.blind.reality.strength import Ruler, resize
from bayessim_mjx.blind.robot import Motion
from bayessim_mjx.blind.worker import command
from bayessim_mjx.effects import make
from bayessim_mjx.effects.ground_height import ground as ground_of_the_library
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics, control_step
from tests.blind.arms import FALL, MOTOR, SERVO, arm, hidden, sole

PLACES = {
    "lugre_friction": "hinge", "cable_tension": "hinge", "gravity_compensation": "world", "inertial_parameters": "link",
    "gain_drift": "drive", "acceleration_limit": "drive",
}  # fmt: skip
BASE = {"hinge.damping": 1.0, "link.mass": 1.0}


def test_every_effect_of_the_library_can_be_hidden():
    # no robot of a check declares a controller, and what is drawn anew in every step has no size to be found
    others = {name for name in effects.names() if effects.load(name).loop or effects.load(name).random}
    assert set(KNOWN) == set(effects.names()) - others and len(others) == 4


@functools.cache
def library(xml: str, period: float, places: tuple[tuple[str, str], ...]):
    """(physics with effects, the motion in it [T] under parameters, a start and commands)."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.timestep /= 5  # near the finer reality's
    physics = Physics(model, period, ParameterSpace(), [make(name, where=where) for name, where in places])

    def moved(theta: jax.Array, q: jax.Array, v: jax.Array, ctrl: jax.Array) -> jax.Array:
        def step(world, row):
            world, _ = control_step(physics, world, row)
            return world, world.measurement["qpos"][0]

        return jax.lax.scan(step, physics.world(theta, q, v), ctrl)[1]

    return physics, jax.jit(moved)


def simulated(rig, run, places: dict[str, str], name: str, told: dict[str, float]) -> np.ndarray:
    """A run again in the library's physics, with one effect on."""
    physics, moved = library(rig.xml, rig.period, tuple(places.items()))
    theta = np.concatenate([b.neutral for b in physics.blocks if b.effect])
    (own,) = (b for b in physics.blocks if b.effect and b.effect.name == name)
    assert not told or {q.name for q in own.quantities} == set(told)
    theta[own.slice] = [told.get(q.name, q.neutral) for q in own.quantities]
    return np.asarray(moved(*map(jnp.float32, (theta, run.clean[0], run.clean_v[0], run.ctrl[:-1]))))


# of the largest size; and what may differ, of what the effect changes
SIZES = {"gain_drift": 1.0, "acceleration_limit": 0.002}
CLOSE = {"acceleration_limit": 0.003}


@pytest.mark.parametrize("name", list(PLACES))
def test_the_librarys_effect_with_the_true_parameters_moves_as_the_cause_does(name):
    rig = arm(SERVO)
    cause = hidden(rig, name, seed=1)
    assert cause.where == PLACES[name]
    cause.size = SIZES.get(name, 0.2) * cause.largest
    run, plain = (rig.record(Plant(rig, {}, own), 2, 0, noise=False) for own in ([cause], []))
    assert np.array_equal(run.ctrl, plain.ctrl)
    # what the effect changes: the rest is what the coarser step loses
    change = run.clean[1:, 0] - plain.clean[1:, 0]
    own = simulated(rig, run, PLACES, name, cause.parameters()) - simulated(rig, run, PLACES, name, {})
    assert np.abs(own - change).max() < CLOSE.get(name, 0.05) * np.abs(change).max()


TWO = """<mujoco><option timestep=".005" integrator="implicitfast"/>
<default><geom type="capsule" contype="0" conaffinity="0" size=".03"/>
<joint axis="0 1 0" damping=".08" armature=".01"/></default>
<worldbody><body name="base"><geom type="sphere" size=".05" mass="3"/>
<body name="upper"><joint name="shoulder"/><geom fromto="0 0 0 0 0 -.3" mass=".8"/>
<body name="lower" pos="0 0 -.3"><joint name="elbow"/><geom fromto="0 0 0 0 0 -.25" mass=".5"/></body></body></body>
</worldbody><actuator><motor name="one" joint="shoulder" ctrlrange="-9 9"/>
<motor name="two" joint="elbow" ctrlrange="-4 4"/></actuator></mujoco>"""


@pytest.mark.parametrize(("where", "told"), [("one", "to_next"), ("two", "to_previous")])
def test_the_librarys_coupling_moves_as_the_cause_does(where, told):
    rig = Motion("two", TWO, 0.01, False, (9.0, 4.0), (0.9, 0.3), (0.4, 0.3), (0.5, 0.5), 0.5, (4e-4, 4e-4), only=2)
    plant = Plant(rig, {})
    scales = scales_of(plant, [rig.record(plant, 2, 0, noise=False)])
    assert scales.chain == {"shoulder": ("", "elbow"), "elbow": ("shoulder", "")}
    cause = CAUSES["effort_coupling"](where, scales, np.random.default_rng(0), 0.1)
    found = {k: v for k, v in cause.parameters().items() if v}
    assert list(found) == [told] and abs(found[told]) == pytest.approx(0.1)
    run, plain = (rig.record(Plant(rig, {}, own), 2, 0, noise=False) for own in ([cause], []))
    names = {"effort_coupling": where}

    def own(log, parameters):
        return simulated(rig, log, names, "effort_coupling", parameters)

    # commands are those of a controller outside, so each run is compared with its own
    apart = [np.abs(own(r, p) - r.clean[1:, 0]).max() for r, p in ((run, cause.parameters()), (run, {}), (plain, {}))]
    assert apart[0] < 0.1 * apart[1] and apart[0] < 3 * apart[2] + 1e-3
    (again,) = twin.twins(rig, scales, [{"name": "effort_coupling", "where": where, "parameters": told_as(cause)}])
    assert again.parameters() == pytest.approx(cause.parameters()) and again.other == cause.other


def test_a_coupled_drive_gives_its_own_effort_where_another_one_is_beside_it():
    """Its gear times its force, as much less as the joint's limit takes from both: -2 of 6 N m arrive as -1 of 3."""
    text = TWO.replace('name="shoulder"', 'name="shoulder" actuatorfrcrange="-3 3"').replace(
        "</actuator>", '<motor name="beside" joint="shoulder" gear="-2" ctrlrange="-9 9"/></actuator>'
    )
    rig = Motion("two", text, 0.01, False, (9.0, 4.0), (0.9, 0.3), (0.4, 0.3), (0.5, 0.5), 0.5, (4e-4, 4e-4), only=2)
    plant = Plant(rig, {})
    model, data = plant.model, plant.data
    scales = SimpleNamespace(chain={"shoulder": ("", "elbow")}, drives={"one": "shoulder", "beside": "shoulder"})
    for name, ctrl, effort in (("beside", [8, 0, 1], -1.0), ("one", [8, 0, 1], 4.0), ("one", [1, 0, 0.5], 1.0)):
        cause = CAUSES["effort_coupling"](name, scales, np.random.default_rng(0), 0.5)
        data.ctrl[:] = ctrl
        mujoco.mj_forward(model, data)
        cause.reset(plant, data.ctrl)
        data.qfrc_applied[:] = 0
        cause.force(plant)
        assert cause.sign * data.qfrc_applied[plant.dof("elbow")] == pytest.approx(0.5 * effort)


def told_as(cause):
    """A cause's parameters as a diagnosis.json has them."""
    return {name: {"mean": value} for name, value in cause.parameters().items()}


@pytest.mark.parametrize("timestep", [0.0005, 0.005])
@pytest.mark.parametrize(("slowness", "inertness"), [(0.0, 0.00013), (0.068, 0.00084), (0.0, 0.02), (0.3, 0.02)])
def test_the_librarys_profile_is_that_of_the_cause_at_any_time_step(timestep, slowness, inertness):
    t, rows = 0.01 * np.arange(400), round(0.01 / timestep)
    command = (1.2 * np.sin(np.pi * t) + 0.3 * np.sin(2.6 * np.pi * t + 1)).astype(np.float32).repeat(rows)
    effect = make("acceleration_limit", where="drive")
    at = effect.bind(mujoco.MjModel.from_xml_string(arm(SERVO).xml), timestep, len(command))
    run = jax.jit(lambda *given: effect.on_command(at, effect.init(at), *given)[1])
    got = run(jnp.asarray(command)[:, None], jnp.array([slowness, inertness], jnp.float32))[:, 0]
    (u, v), expected = (float(command[0]), 0.0), []
    for c in command.astype(float):
        mean = 0.0
        for _ in range(10):  # of the set-point over a sub-step
            way, v = quickest(c - u, v, 1 / slowness if slowness else np.inf, 1 / inertness, timestep / 10)
            mean, u = mean + (u + 0.5 * way) / 10, u + way
        expected.append(mean)
    assert np.abs(np.array(expected) - command).max() > 0.015  # the profile changes it
    smooth = inertness > 0.001 or timestep < 0.001  # trapezium rule over the tenths
    np.testing.assert_allclose(got, expected, atol=2e-5 if smooth else 2e-4)


def test_the_ground_of_the_library_is_that_of_the_cause():
    rig = sole(-0.35)
    cause = hidden(rig, "ground_height", 0.02, sign=1.0)
    run = rig.record(Plant(rig, {}, [cause]), 2, 0, noise=False)
    of = {"ground_height": "world"}
    off = [simulated(rig, run, of, "ground_height", told) - run.clean[1:, 0] for told in (cause.parameters(), {})]
    assert np.abs(off[0]).max() < 0.1 * np.abs(off[1]).max()
    spec = mujoco.MjSpec.from_string(FALL)
    model = spec.compile()
    assert [g.name for g in ground(spec)] == [model.geom(i).name for i in ground_of_the_library(model)] == ["step"]


def rig_of(name: str):
    return arm(SERVO if name == "acceleration_limit" else MOTOR)


@pytest.mark.parametrize("name", list(PLACES))
def test_a_cause_has_the_strength_that_is_asked_for(name):
    ruler, cause, goal = Ruler(rig_of(name), BASE, 0.15, 0), hidden(rig_of(name), name, seed=1), 4.0
    raw, left = resize(cause, ruler, goal)
    assert 0.85 * goal < min(raw, 3 * left) < 1.15 * goal and cause.size < cause.largest


@pytest.mark.parametrize("name", [*PLACES, "ground_height"])
def test_a_twin_of_the_true_parameters_is_the_cause_and_closes_the_gap(name):
    rig = sole(-0.35) if name == "ground_height" else rig_of(name)
    base = {} if name == "ground_height" else BASE
    ruler, cause = Ruler(rig, base or {"sole.mass": 1.0}, 0.15, 0), hidden(rig, name, seed=2)
    cause.size = 0.1 * cause.largest
    numbers = {k: {"mean": v} for k, v in cause.parameters().items()}
    (again,) = twin.twins(rig, cause.scales, [{"name": name, "where": cause.where, "parameters": numbers}]) or []
    assert again.parameters() == pytest.approx(cause.parameters())
    truth = Plant(rig, base, [cause])
    assert twin.closed(ruler, truth, Plant(rig, base, [again])) == pytest.approx(1.0, abs=2e-3)
    assert twin.closed(ruler, truth, Plant(rig, base)) < 0.5


def test_what_a_diagnosis_tries_only_where_it_is_named_is_hidden_only_then(tmp_path):
    assert set(KNOWN) - set(unasked()) == {"lugre_friction", "cable_tension", "ground_height"}
    assert effects_of("all") == () and effects_of("backlash, armature") == ("backlash", "armature")
    assert effects_of("all,lugre_friction,backlash") == (*unasked(), "lugre_friction")
    named = Check("out", model="robot.xml", effects=("lugre_friction", "backlash"))
    words = command(named, tmp_path / "logs", tmp_path / "out")
    assert words[words.index("--effects") + 1] == "all,lugre_friction"
    assert "--effects" not in command(Check("out", model="robot.xml"), tmp_path / "logs", tmp_path / "out")
