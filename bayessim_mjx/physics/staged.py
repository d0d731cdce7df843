"""Effects whose force follows the state within a timestep, in the stages of a Runge-Kutta method."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from bayessim_mjx.compat import mjx
from bayessim_mjx.effects.support.substep import springs
from bayessim_mjx.physics.gates import gated
from bayessim_mjx.physics.pushed import Memory

if TYPE_CHECKING:
    from bayessim_mjx.physics.timestep import Timestep


class Staged:
    """The effects whose force is that of each stage (`Effect.rates`), and the part of their memory that stages move.

    Args:
        own: the timestep; first: its data at the beginning, with the forces there; carry: memory and forces, likewise.
    """

    def __init__(self, own: "Timestep", first: mjx.Data, carry: Memory) -> None:
        self.own, self.effects, self.remembered = own, own.having("rates"), carry[0]
        self.held = dict(zip(own.physics.having("on_force"), carry[1], strict=True))  # their forces at the beginning
        self.others = first.qfrc_applied - sum((self.held[i] for i, *_ in self.effects), jnp.zeros_like(first.qvel))
        self.first = tuple(effect.rates(at, self.remembered[i]) for i, effect, at, _ in self.effects)

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
        memory, step, active = self.memory(rates, time), self.own.view(data), self.own.drive.active
        known = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator + self.others
        known = known + springs(data)[1] if data._impl.ne else known
        found, total = [], self.others
        for (i, effect, at, theta), own in zip(self.effects, rates, strict=True):

            def force(i: int = i, effect: Any = effect, at: Any = at, theta: jax.Array = theta) -> tuple:
                seen = step.within_a_branch().seen_by(known, self.held[i])
                left, force = effect.on_force(at, memory[i], seen, theta)
                return effect.rates(at, left), force

            there, pushing = gated(active, i, force, (own, jnp.zeros_like(self.others)))
            found.append(there)
            total = total + pushing
        return data.replace(qfrc_applied=total), tuple(found)


__all__ = ["Staged"]
