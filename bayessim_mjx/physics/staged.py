"""Effects whose force follows the state within a timestep, in the stages of a Runge-Kutta method."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from bayessim_mjx.compat import mjx
from bayessim_mjx.effects.support.substep import SubStep
from bayessim_mjx.physics.gates import gated
from bayessim_mjx.physics.pushed import Memory, felt


class Staged:
    """The effects whose force is that of each stage (`Effect.rates`), and the part of their memory that stages move.

    Args:
        effects: (index, effect, site, slice of theta) of each; active: see `gates.gated`.
        view: data -> the timestep as effects see it.
        forcing: indices of all effects that exert a force.
        first: data at the timestep's beginning, with the forces there; carry: memory and forces, likewise.
    """

    def __init__(
        self,
        effects: Sequence[tuple],
        active: jax.Array | None,
        view: Callable[[mjx.Data], SubStep],
        forcing: Sequence[int],
        first: mjx.Data,
        carry: Memory,
    ) -> None:
        self.effects, self.active, self.view, self.remembered = effects, active, view, carry[0]
        self.held = dict(zip(forcing, carry[1], strict=True))  # their forces at the beginning
        self.others = first.qfrc_applied - sum((self.held[i] for i, *_ in effects), jnp.zeros_like(first.qvel))
        self.first = tuple(effect.rates(at, self.remembered[i]) for i, effect, at, _ in effects)

    def memory(self, rates: tuple, time: jax.Array) -> tuple:
        """Return the memory of all effects `time` after the beginning at these rates."""
        after = list(self.remembered)
        for (i, *_), own in zip(self.effects, rates, strict=True):
            if own:
                after[i] = after[i] | {name: after[i][name] + time * rate for name, rate in own.items()}
        return tuple(after)

    def pushed(self, data: mjx.Data, rates: tuple, time: jax.Array) -> tuple[mjx.Data, tuple]:
        """Return (data with the forces of this stage in qfrc_applied, the rates there)."""
        if not self.effects:
            return data, ()
        memory, step = self.memory(rates, time), self.view(data)
        known = felt(data, self.others)
        found, total = [], self.others
        for (i, effect, at, theta), own in zip(self.effects, rates, strict=True):

            def force(i: int = i, effect: Any = effect, at: Any = at, theta: jax.Array = theta) -> tuple:
                seen = step.within_a_branch().seen_by(known, self.held[i])
                left, force = effect.on_force(at, memory[i], seen, theta)
                return effect.rates(at, left), force

            there, pushing = gated(self.active, i, force, (own, jnp.zeros_like(self.others)))
            found.append(there)
            total = total + pushing
        return data.replace(qfrc_applied=total), tuple(found)


__all__ = ["Staged"]
