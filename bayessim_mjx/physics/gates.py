"""Hooks of many effects, of which a call needs few: what none of its worlds has costs nothing."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

T = TypeVar("T")
Carry = TypeVar("Carry")


def gated(active: jax.Array | None, index: int, hook: Callable[[], T], otherwise: T) -> T:
    """Return the output of the hook of effect `index`; `otherwise`, its inputs, where the effect is not active.

    At neutral numbers both are the same. `active` `[effects]` is one for all worlds of a call: under `vmap` the branch
    stays a branch, and effects that no world has cost nothing. None: all of them are computed.
    """
    return hook() if active is None else jax.lax.cond(active[index], hook, lambda: otherwise)


def chained(
    active: jax.Array | None,
    effects: Sequence[int],
    hook: Callable[[int, Any, Carry], tuple[Any, Carry]],
    memory: Sequence[Any],
    carry: Carry,
) -> tuple[tuple, Carry]:
    """(memories of these effects, carry) after their hooks, one after the other, each `gated`.

    Halves of which no effect is active are passed by at once: a branch costs about a microsecond on a CPU, as much as
    hundreds of lanes' additions, and a step of a small robot has few of these.

    Args:
        active: `[effects]`, see `gated`.
        effects: indices, increasing.
        hook: (index, the effect's memory, carry) -> (its memory, carry).
        memory: one entry for each of these effects.
        carry: what goes from effect to effect.
    """
    if active is None or len(effects) < 2:
        remembered = list(memory)
        for k, i in enumerate(effects):
            one = functools.partial(hook, i, remembered[k], carry)
            remembered[k], carry = gated(active, i, one, (remembered[k], carry))
        return tuple(remembered), carry
    after: tuple = ()
    middle = len(effects) // 2
    for half, own in ((effects[:middle], memory[:middle]), (effects[middle:], memory[middle:])):
        through = functools.partial(chained, active, half, hook, tuple(own), carry)
        if len(half) > 1:
            as_they_are = functools.partial(tuple, (tuple(own), carry))
            through = functools.partial(jax.lax.cond, jnp.any(active[np.asarray(half)]), through, as_they_are)
        passed, carry = through()
        after += passed
    return after, carry


def chained_in(
    active: jax.Array | None, effects: Sequence[int], hook: Callable[[int, Any, Carry], tuple[Any, Carry]],
    memory: Sequence[Any], carry: Carry,
) -> tuple[tuple, Carry]:  # fmt: skip
    """`chained`, where memory has one entry for each effect of the stack."""
    own, carry = chained(active, effects, hook, tuple(memory[i] for i in effects), carry)
    after = dict(zip(effects, own, strict=True))
    return tuple(after.get(i, memory[i]) for i in range(len(memory))), carry


__all__ = ["chained", "chained_in", "gated"]
