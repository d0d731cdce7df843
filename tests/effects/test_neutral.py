"""At neutral parameters a rollout with effects is bit-identical to one without them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import effects, registry
from bayessim_mjx.compat import compiler_options

STEPS = 200
WHERE = {"Pendulum": "hinge", "Cartpole": "cart_to_pole", "Ant": "ankle_1"}


def observations(env, theta):
    """`[STEPS, worlds, S]`: everything observed in two worlds under random actions."""
    actions = jax.random.uniform(jax.random.PRNGKey(1), (STEPS, 2, env.action_size), minval=-1.0)

    # bit for bit is a matter of the compiler: as users have it, not as quick as the other tests'
    @functools.partial(jax.jit, compiler_options=compiler_options(fused=True))
    def run(theta, actions):
        state = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(jax.random.PRNGKey(0), 2), theta)

        def body(state, action):
            state = jax.vmap(env.step)(state, action)
            return state, (state.obs["policy"], state.reward)

        return jax.lax.scan(body, state, actions)[1]

    return run(jnp.asarray(theta, jnp.float32), actions)


IN_CI = {"Ant", "Pendulum"}


@pytest.mark.slow
@pytest.mark.parametrize("task", [pytest.param(t, marks=[pytest.mark.ci] if t in IN_CI else []) for t in sorted(WHERE)])
def test_neutral_effects_change_no_bit(task):
    bare = registry.make(task)
    stack = [effects.make("actuator_delay", where="all"), effects.make("coulomb_friction", where=WHERE[task])]
    full = registry.make(task, effects=stack)
    assert full.space.names == bare.space.names + tuple(n for e in stack for n in e.space().names)
    theta = np.asarray(bare.space.vector(bare.real_parameters))
    neutral = np.concatenate([theta, full.space.nominal[len(bare.space) :]])
    for one, two in zip(observations(bare, theta), observations(full, neutral), strict=True):
        assert np.array_equal(one, two)


@pytest.mark.parametrize("name", effects.names())
def test_every_effect_names_its_parameters_and_is_neutral_at_nominal(name):
    effect = effects.make(name, where="somewhere")
    space = effect.space()
    assert all(p.kind == "effect" and p.name.startswith(f"somewhere.{name}.") for p in space.parameters)
    assert effect == effects.make(name, where="somewhere") and hash(effect) == hash(effect)
