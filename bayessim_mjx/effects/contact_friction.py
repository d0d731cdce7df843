"""Contact friction: soles, tyres, grippers or the floor are more or less slippery than modelled."""

import dataclasses
from typing import TYPE_CHECKING, ClassVar

import jax
import mujoco

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.geoms import native, of_pairs, touching
from bayessim_mjx.effects.support.site import Site

if TYPE_CHECKING:
    from mujoco import mjx


@dataclasses.dataclass(frozen=True)
class ContactFriction(Effect):
    """mu' = scale mu, the geom's coefficient of sliding friction.

    A contact takes the larger coefficient of its two geoms (or that of higher priority), so that only scaling that one
    up or down shows. A pair that the MJCF declares has a coefficient of its own: scaled by the product of its geoms'.

    Parameters: `scale`, no unit, neutral 1.
    """

    name: ClassVar[str] = "contact_friction"
    kind: ClassVar[str] = "geom"
    noun: ClassVar[str] = "changed contact friction"
    lacks: ClassVar[str] = "the true contact friction"
    separates: ClassVar[str] = "sliding at two normal loads"
    quantities: ClassVar[tuple[Quantity, ...]] = (Quantity("scale", 1.0, 0.2, 3.0, grid=(0.1, 0.3, 0.7)),)

    def bind(self, mj_model: mujoco.MjModel, timestep: float, substeps: int) -> Site:
        """Bind the site: geoms that can touch something."""
        return touching(self, mj_model, timestep, substeps)

    def on_model(self, at: Site, model: "mjx.Model", theta: jax.Array) -> "mjx.Model":
        scale = at.values(theta)[:, 0]
        model = model.replace(geom_friction=model.geom_friction.at[at.ids, 0].multiply(scale))
        if not at.mj_model.npair:
            return model
        pairs = of_pairs(at, scale)[:, None]
        return model.replace(pair_friction=model.pair_friction.at[:, :2].multiply(pairs))

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        factor: dict[str, float] = {}
        for geom, name, own in native(spec, values):
            factor[name] = own["scale"]
            geom.friction[0] *= own["scale"]
        for pair in spec.pairs:
            pair.friction[:2] *= factor.get(pair.geomname1, 1.0) * factor.get(pair.geomname2, 1.0)
        return None
