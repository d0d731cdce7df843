"""Geoms that can touch something, shared by the effects on contacts; and geoms of a spec by place."""

import dataclasses
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.support.site import Site, find
from bayessim_mjx.errors import UserError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from bayessim_mjx.effects.effect import Effect


def collidable(model: mujoco.MjModel) -> np.ndarray:
    """`[ngeom]` bool: its masks allow contacts, or it is in a declared pair."""
    pairs = np.isin(np.arange(model.ngeom), np.concatenate([model.pair_geom1, model.pair_geom2]))
    return ((model.geom_contype | model.geom_conaffinity) != 0) | pairs


def touching(effect: "Effect", model: mujoco.MjModel, timestep: float, substeps: int) -> Site:
    """Find the site of an effect on geoms; "all": those that can touch something.

    Raises:
        UserError: a geom that cannot touch anything.
    """
    at, able = find(effect, model, timestep, substeps), collidable(model)
    names = [model.geom(i).name or f"geom{i}" for i in np.flatnonzero(able)]
    if effect.where != "all":
        for name, i in zip(at.names, at.ids, strict=True):
            if not able[i]:
                allowed = ", ".join(names) or "none"
                raise UserError(f"{effect.name}: geom {name!r} collides with nothing; allowed: {allowed}")
        return at
    if not able.any():
        raise UserError(f"{effect.name}: no geom of the model collides with anything")
    keep = able[at.ids]
    parts = {f: getattr(at, f)[keep] for f in ("ids", "qadr", "dadr", "slide")}
    return dataclasses.replace(at, names=tuple(names), **parts)


def of_pairs(at: Site, factor: jax.Array) -> jax.Array:
    """Factor of each declared pair `[npair]`: the product of its geoms' (`factor` `[n]`; 1 for others)."""
    each = jnp.ones(at.mj_model.ngeom).at[at.ids].set(factor)
    return each[at.mj_model.pair_geom1] * each[at.mj_model.pair_geom2]


def native(spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> "Iterator[tuple[Any, str, dict[str, float]]]":
    """(geom of the spec, its name, its values) for every place; "all": every geom that can touch something."""
    spec.compile()  # gives the geoms their ids
    able = collidable(spec.compile())
    for place, own in values.items():
        for geom in spec.geoms:
            if place in (geom.name, f"geom{geom.id}") or (place == "all" and able[geom.id]):
                yield geom, geom.name or f"geom{geom.id}", own
