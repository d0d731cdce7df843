"""Ranges that may move from round to round without a program being compiled again, and where physics ends."""

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.parameters.parameter import Parameter
from bayessim_mjx.parameters.reading import own_value
from bayessim_mjx.parameters.space import ParameterSpace

SIGNED = ("bias", "com_x", "com_y", "com_z", "gravity")  # numbers of the model that may be negative


@jax.tree_util.register_pytree_node_class
class Ranged(ParameterSpace):
    """The parameters of `start` with other ranges. A pytree of the ends, so never a static argument under `jit`.

    A prior keeps its kind: restricted to the range of `start` it is the prior there, times a constant.

    Attributes:
        start: the space that the run begins with; it says what the parameters are.
        low, high: `[d]` float32, or with leading axes in a batched distribution.
    """

    def __init__(self, start: ParameterSpace, low: Any = None, high: Any = None) -> None:
        super().__init__(start.parameters)
        self.start = start
        self.low = jnp.asarray(start.low if low is None else low, jnp.float32)
        self.high = jnp.asarray(start.high if high is None else high, jnp.float32)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Ranged) and self.start == other.start and self.same(other)

    __hash__ = None  # type: ignore[assignment]

    @property
    def unbatched(self) -> "Ranged":
        d = len(self)
        return Ranged(self.start, self.low.reshape(-1, d)[0], self.high.reshape(-1, d)[0])

    def same(self, other: ParameterSpace) -> bool:
        """Whether both have the same ranges."""
        return np.array_equal(self.low, other.low) and np.array_equal(self.high, other.high)

    def subset(self, names: Sequence[str]) -> ParameterSpace:
        index = np.asarray([self.index(name) for name in names], int)
        return Ranged(self.start.subset(names), self.low[..., index], self.high[..., index])

    def tree_flatten(self) -> tuple[tuple[Any, Any], ParameterSpace]:
        return (self.low, self.high), self.start

    @classmethod
    def tree_unflatten(cls, start: ParameterSpace, ends: tuple[Any, Any]) -> "Ranged":
        made = object.__new__(cls)
        made.__dict__.update(start.__dict__)
        made.start, (made.low, made.high) = start, ends
        return made


def ends(p: Parameter, model: Any = None) -> tuple[float, float]:
    """(lowest, highest) theta at which a parameter of the model has a meaning; infinite where nothing limits it.

    Masses, sizes, friction, damping, stiffness and gains are not negative; a restitution is a share.

    Args:
        p: of kind "effect": nothing is known here, see `effects.Quantity.ends`.
        model: the nominal `mujoco.MjModel`, to which an additive parameter is added; None: its own range is the limit.
    """
    if p.kind == "effect":
        return -math.inf, math.inf
    if p.attribute in SIGNED:
        return -math.inf, math.inf
    if p.factor < 0:
        return p.low, p.high
    highest = 1 / p.factor if p.attribute == "restitution" else math.inf
    if p.operation != "additive":
        return 0.0, highest
    if model is None:
        return p.low, p.high
    return -own_value(model, p.kind, p.attribute, p.target) / p.factor, highest
