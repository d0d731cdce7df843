"""Messages on a bus that arrive after random times, or never: what is drawn for each, shared by both directions."""

import dataclasses
import math
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.errors import UserError

if TYPE_CHECKING:
    import mujoco

LAWS = ("gamma", "uniform", "two_point")
LOST = ("hold", "zero")
TAIL = 6.0  # sd of a delay beyond its mean that a memory holds: 3e-4 of a gamma law of sd = mean lie beyond (its tail)
SLOTS = 256  # messages on the way at once; source: memory of thousands of worlds, a rule of thumb


@dataclasses.dataclass(frozen=True)
class Packets(Effect):
    """The settings and parameters of messages in either direction: `command_packets`, `sensor_packets`.

    Attributes:
        law: of the delay: gamma, uniform or two_point (mean +- jitter, one as often as the other).

    Raises:
        UserError: naming an unknown law, or `lost`, and what is allowed.
    """

    where: str | tuple[str, ...] = "all"
    law: str = "gamma"
    lost: str = "hold"
    late: ClassVar[bool] = True
    random: ClassVar[bool] = True
    offered: ClassVar[bool] = False
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("delay", 0.0, 0.0, 0.02, unit="s"),
        Quantity("jitter", 0.0, 0.0, 0.02, unit="s"),
        Quantity("loss", 0.0, 0.0, 0.5, most=1.0),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for setting, value, allowed in (("law", self.law, LAWS), ("lost", self.lost, LOST)):
            if value not in allowed:
                raise UserError(f"{self.name}: {setting} = {value!r}; allowed: {', '.join(allowed)}")

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        return "MuJoCo has no messages with random delays; use effects.yaml"


def slots(effect: Any, at: Site) -> int:
    """Return how many control steps the longest delay lasts, rounded up, and one more.

    Raises:
        UserError: more than a memory should hold.
    """
    high = {q.name: 0.0 for q in effect.quantities}
    for block in effect.blocks():
        for p, q in block.pairs():
            high[q.name] = max(high[q.name], p.high)
    longest = high["delay"] + TAIL * high["jitter"]
    count = math.ceil(longest / at.dt - 1e-6) + 1
    if count > SLOTS:
        raise UserError(
            f"{effect.name}: delays up to {longest:.3g} s are {count} control steps of {at.dt:.3g} s; "
            f"allowed: {SLOTS}; give delay and jitter smaller ranges (parameters: {{jitter: {{range: [0, ...]}}}})"
        )
    return count


def draw(key: jax.Array, values: jax.Array, law: str) -> tuple[jax.Array, jax.Array]:
    """(delays `[n]` s >= 0, whether lost `[n]`) of a message to each of n receivers; values `[n, 3]` as `quantities`.

    A delay has the mean and the standard deviation (`jitter`) stated, where the law allows it: below 0 it is 0.
    """
    mean, spread, loss = values.T
    one, two = jax.random.split(key)
    if law == "gamma":
        on = (mean > 0) & (spread > 0)
        shape = jnp.where(on, mean / jnp.where(on, spread, 1.0), 1.0) ** 2
        drawn = jnp.where(on, mean * jax.random.gamma(one, shape) / shape, mean)
    elif law == "uniform":
        drawn = mean + math.sqrt(3.0) * spread * jax.random.uniform(one, mean.shape, minval=-1.0)
    else:
        drawn = mean + spread * jnp.where(jax.random.bernoulli(one, 0.5, mean.shape), 1.0, -1.0)
    return jnp.maximum(drawn, 0.0), jax.random.uniform(two, mean.shape) < loss


def receivers(at: Site, values: jax.Array) -> jax.Array:
    """Return the values of independent messages: one for all places where these are tied, else one for each."""
    return values[:1] if at.tied else values
