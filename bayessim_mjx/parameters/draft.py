"""A model under change: its leaves by dotted name, and contact pairs that follow their geoms."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

if TYPE_CHECKING:
    from mujoco import mjx


class Draft:
    """Leaves of a model that have been changed so far, by dotted name."""

    def __init__(self, model: "mjx.Model") -> None:
        self.model = model
        self.leaves: dict[str, jax.Array] = {}
        self.resized: set[int] = set()  # geoms whose size changed

    def __getitem__(self, name: str) -> jax.Array:
        if name in self.leaves:
            return self.leaves[name]
        value: Any = self.model
        for part in name.split("."):
            value = getattr(value, part)
        return value

    def __setitem__(self, name: str, value: jax.Array) -> None:
        self.leaves[name] = value


def follow_geoms(draft: Draft) -> None:
    """Explicit contact pairs whose numbers are what their geoms combine to follow their geoms; others stay."""
    model = draft.model
    if not model.npair:
        return
    one, two = np.asarray(model.pair_geom1), np.asarray(model.pair_geom2)
    rank = model.geom_priority[one] - model.geom_priority[two]
    mix = _mix(model.geom_solmix[one], model.geom_solmix[two])[:, None]

    def friction(values: jax.Array) -> jax.Array:
        a, b = values[one, 0], values[two, 0]
        return jnp.where(rank > 0, a, jnp.where(rank < 0, b, jnp.maximum(a, b)))

    def solref(values: jax.Array) -> jax.Array:
        a, b = values[one], values[two]
        same = jnp.where(((a[:, 0] > 0) & (b[:, 0] > 0))[:, None], mix * a + (1 - mix) * b, jnp.minimum(a, b))
        return jnp.where((rank > 0)[:, None], a, jnp.where((rank < 0)[:, None], b, same))

    if "geom_friction" in draft.leaves:
        nominal, new, pair = friction(model.geom_friction), friction(draft["geom_friction"]), model.pair_friction
        follows = (jnp.abs(pair[:, :2] - nominal[:, None]) <= 1e-6 * nominal[:, None]).all(-1, keepdims=True)
        draft["pair_friction"] = pair.at[:, :2].set(jnp.where(follows, new[:, None], pair[:, :2]))
    if "geom_solref" in draft.leaves:
        nominal, new = solref(model.geom_solref), solref(draft["geom_solref"])
        follows = (jnp.abs(model.pair_solref - nominal) <= 1e-6 * jnp.abs(nominal)).all(-1, keepdims=True)
        draft["pair_solref"] = jnp.where(follows, new, model.pair_solref)


def _mix(a: jax.Array, b: jax.Array) -> jax.Array:
    """Weight of the first geom's contact parameters."""
    small = float(mujoco.mjMINVAL)
    return jnp.where(
        (a >= small) & (b >= small),
        a / jnp.maximum(a + b, small),
        jnp.where((a < small) & (b < small), 0.5, jnp.where(a < small, 0.0, 1.0)),
    )
