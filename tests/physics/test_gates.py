"""Hooks one after the other, of which only those of active effects are computed."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.physics.gates import chained, chained_in


def hook(i, memory, carry):
    """Order matters: what comes first is doubled by all that follow."""
    return memory + i, 2 * carry + i


def by_hand(active, effects, memory, carry):
    memory = list(memory)
    for i in effects:
        if active[i]:
            memory[i], carry = hook(i, memory[i], carry)
    return memory, carry


@pytest.mark.parametrize("effects", [[], [3], [0, 2], [0, 1, 2, 4, 5]])
def test_active_hooks_in_their_order_and_no_others(effects):
    memory = tuple(jnp.float32(10 * i) for i in range(6))
    run = jax.jit(lambda active: chained_in(active, effects, hook, memory, jnp.float32(1)))
    for active in itertools.product((False, True), repeat=6):
        found, carry = run(jnp.array(active))
        expected, last = by_hand(active, effects, memory, 1.0)
        np.testing.assert_array_equal(found, expected)
        assert carry == last
    found, carry = chained(None, effects, hook, tuple(memory[i] for i in effects), jnp.float32(1))
    expected, last = by_hand([True] * 6, effects, memory, 1.0)
    assert len(found) == len(effects) and carry == last
    np.testing.assert_array_equal(np.array(found), np.array([expected[i] for i in effects]))


def test_a_half_without_active_effects_is_one_branch():
    """Sixteen effects of which one is active: its own branch and those of the halves above, not sixteen."""
    ran = []

    def seen(i, memory, carry):
        jax.debug.callback(lambda: ran.append(i))
        return memory, carry + 1

    active = jnp.arange(16) == 11
    _, carry = jax.jit(lambda a: chained(a, list(range(16)), seen, (0,) * 16, jnp.float32(0)))(active)
    jax.effects_barrier()
    assert carry == 1 and ran == [11]
    text = jax.jit(lambda a: chained(a, list(range(16)), hook, (0.0,) * 16, jnp.float32(0))).lower(active).as_text()
    assert text.count("stablehlo.case") + text.count("stablehlo.if") == 2 + 4 + 8 + 16
