"""Effects from settings: the list, the group of `randomization_params`, and both at once."""

import jax
import numpy as np
import pytest

from bayessim_mjx import config, effects, registry
from bayessim_mjx.effects.support.reading import listed, stack
from bayessim_mjx.errors import UserError
from bayessim_mjx.rollout import replay

MODEL = ("pendulum_mass_mult", "pendulum_length_mult")
DELAY = "all.actuator_delay.delay"
FRICTION = "hinge.coulomb_friction.level"
KEY = "task.randomization_params.effects"


def delay(**setting):
    return {"effects": {"actuator_delay": {"all": {"delay": setting}}}}


def pendulum(*overrides):
    return registry.make("Pendulum", config=config.load("Pendulum", overrides=list(overrides)))


@pytest.fixture(scope="module")
def delayed():
    return pendulum(f"{KEY}.actuator_delay.all.delay.range=[0, 0.1]")


def motion(env, theta):
    command = 2.0 * np.sign(np.sin(np.arange(24)))[None, :, None].astype(np.float32)
    start = np.array([[2.0]], np.float32), np.array([[0.3]], np.float32)
    return jax.tree.map(np.asarray, replay(env.physics, *start, command, np.float32([theta])))


@pytest.mark.slow
@pytest.mark.ci
def test_a_group_builds_its_effect(delayed):
    assert delayed.space.names == (*MODEL, DELAY)
    assert [type(e).__name__ for e in delayed.physics.effects] == ["ActuatorDelay"]
    none, zero, late = (motion(*a) for a in ((pendulum(), [1, 1]), (delayed, [1, 1, 0]), (delayed, [1, 1, 0.1])))
    for name in ("qpos", "qvel"):
        np.testing.assert_allclose(none[name], zero[name], atol=1e-6)
    assert np.abs(zero["qpos"] - late["qpos"]).max() > 0.01


def test_the_list_alone_gives_the_default_ranges():
    env = pendulum("effects=[{effect: coulomb_friction, where: hinge}, {effect: actuator_delay, where: all}]")
    assert env.space.names == (*MODEL, FRICTION, DELAY)
    np.testing.assert_allclose((env.space.low[2:], env.space.high[2:]), [[0, 0], [1, 0.1]])


def test_listed_and_grouped_effects_are_one_and_the_listed_come_first():
    env = pendulum(
        f"{KEY}={{coulomb_friction: {{hinge: null}}, actuator_delay: {{all: {{delay: {{range: [0, 0.02]}}}}}}}}",
        "effects=[{effect: actuator_delay, where: all, high: 0.2}]",
    )
    assert env.space.names == (*MODEL, DELAY, FRICTION)
    np.testing.assert_allclose(env.space.high[2:], [0.02, 1.0])
    assert env.physics.effects[0].high == 0.2


def test_prior_unit_and_nominal_of_a_group():
    (effect,) = stack(delay(range=[0.01, 0.5], distribution="loguniform"))
    (parameter,) = effect.space().parameters
    assert (parameter.prior, parameter.low, parameter.high, parameter.unit) == ("loguniform", 0.01, 0.5, "s")
    assert parameter.nominal == 0.01  # the end of the range next to the neutral 0
    assert hash(effect) == hash(stack(delay(range=[0.01, 0.5], distribution="loguniform"))[0])
    (effect,) = stack(delay(distribution="gaussian", mean=0.02, sd=0.01))
    assert effect.space().parameters[0].high == 0.1 and effect.space().parameters[0].mean == 0.02


def test_the_delays_memory_is_as_long_as_its_range():
    """Sub-steps of 0.05 s: 1 s are 20 of them, and one more for the part of a sub-step."""
    physics = registry.make("Pendulum", effects=stack(delay(range=[0, 1]))).physics
    assert physics._memory[0]["history"].shape == (21, 1)


def test_an_effect_below_an_actor_counts_too():
    section = {"actor_params": {"pendulum": {"effects": {"coulomb_friction": {"hinge": {}}}}}}
    assert registry.make("Pendulum", effects=stack(section)).space.names[-1] == FRICTION


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ({"effects": 3}, r"task\.randomization_params\.effects = 3: expected a section"),
        ({"effects": {"actuator_delay": 3}}, r"effects\.actuator_delay = 3: expected a section"),
        (
            {"effects": {"actuator_dely": {"all": {}}}},
            r"effects\.actuator_dely\.all: no effect.*did you mean actuator_delay",
        ),
        ({"effects": {"actuator_delay": {"all": {"dely": {}}}}}, r"all\.dely: .*did you mean delay"),
        (delay(rnage=[0, 1]), r"delay\.rnage: unknown key; did you mean range"),
        (delay(range=[1, 0]), r"delay\.range: \[1, 0\] is empty"),
        (delay(range=[-1, 1]), r"range begins at -1 s; allowed: from 0"),
        (delay(operation="scaling"), r"delay\.operation: 'scaling' is none of absolute"),
        (delay(range=[0, 1], schedule="linear"), r"delay\.schedule_steps: a linear schedule needs"),
    ],
)
def test_refusals_of_the_group_name_the_key(section, words):
    with pytest.raises(UserError, match=words):
        stack(section)


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ({"effect": "actuator_delay"}, r"effects\[0\]\.where is missing"),
        ({"where": "all"}, r"effects\[0\]\.effect is missing.*one of acceleration_limit, actuator_"),
        ({"effect": "actuator_delay", "where": "all", "high": "abc"}, r"effects\[0\].*high = 'abc': expected a number"),
        ({"effect": "actuator_delay", "where": "all", "hgih": 1}, r"effects\[0\].*'hgih'; allowed are high"),
        ({"effect": "actuator_delay", "where": "all", "high": -1}, r"effects\[0\].*high = -1 s, must be positive"),
        ({"effect": "actuator_delay", "where": 3}, r"effects\[0\].*where = 3: expected"),
        ({"effect": "friction", "where": "all"}, r"effects\[0\]: no effect 'friction'; did you mean "),
        ({"effect": 3, "where": "all"}, r"effects\[0\]: no effect 3"),
        (3, r"effects\[0\] = 3: expected"),
    ],
)
def test_refusals_of_the_list_name_the_entry(spec, words):
    with pytest.raises(UserError, match=words):
        listed([spec])


def test_an_unknown_place_is_refused_with_the_close_one():
    with pytest.raises(UserError, match=r"no joint 'hing' in the model; did you mean hinge"):
        pendulum(f"{KEY}.coulomb_friction.hing={{}}")
    with pytest.raises(UserError, match=r"no actuator 'al' in the model; did you mean all"):
        registry.make("Pendulum", effects=[effects.make("actuator_delay", where="al")])


@pytest.mark.slow
def test_without_randomisation_there_are_neither_parameters_nor_effects():
    assert len(pendulum("task.randomize=False", f"{KEY}.actuator_delay.all={{}}").space) == 0
    with pytest.warns(UserWarning, match="effects: they are off"):
        bare = pendulum("task.randomize=False", "effects=[{effect: actuator_delay, where: all}]")
    assert len(bare.space) == 0 and bare.physics.effects == ()
    np.testing.assert_allclose(motion(bare, [])["qpos"], motion(pendulum(), [1, 1])["qpos"], atol=1e-5)
