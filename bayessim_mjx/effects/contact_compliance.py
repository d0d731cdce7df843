"""Contact compliance: soles, tyres, fingertips or the floor are softer or harder than modelled."""

import dataclasses
from typing import TYPE_CHECKING, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.geoms import native, of_pairs, touching
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.errors import UserError

if TYPE_CHECKING:
    from mujoco import mjx


@dataclasses.dataclass(frozen=True)
class ContactCompliance(Effect):
    """T' = T exp(softness), T the time constant of the geom's contacts (solref): their stiffness goes with 1 / T'^2.

    MuJoCo averages T of the two geoms of a contact (by solmix), and holds it above two timesteps: smaller ones change
    nothing. A pair that the MJCF declares has a T of its own: scaled by the product of its geoms'.

    Parameters: `softness`, no unit, neutral 0.
    """

    name: ClassVar[str] = "contact_compliance"
    kind: ClassVar[str] = "geom"
    noun: ClassVar[str] = "contact compliance"
    separates: ClassVar[str] = "drops from several heights"
    quantities: ClassVar[tuple[Quantity, ...]] = (Quantity("softness", 0.0, -2.0, 2.0, grid=(0.1, 0.3, 0.7)),)

    def bind(self, mj_model: mujoco.MjModel, timestep: float, substeps: int) -> Site:
        """Bind the site: geoms that can touch something; refuse solref in the direct format."""
        at = touching(self, mj_model, timestep, substeps)
        for name, i in zip(at.names, at.ids, strict=True):
            if mj_model.geom_solref[i, 0] <= 0:
                given = " ".join(f"{x:g}" for x in mj_model.geom_solref[i])
                raise UserError(f"{self.name}: geom {name!r} has solref {given}; allowed: (time constant > 0, ratio)")
        return at

    def on_model(self, at: Site, model: "mjx.Model", theta: jax.Array) -> "mjx.Model":
        factor = jnp.exp(at.values(theta)[:, 0])
        model = model.replace(geom_solref=model.geom_solref.at[at.ids, 0].multiply(factor))
        if not at.mj_model.npair:
            return model
        standard = at.mj_model.pair_solref[:, 0] > 0
        pairs = jnp.where(standard, of_pairs(at, factor), 1.0)
        return model.replace(pair_solref=model.pair_solref.at[:, 0].multiply(pairs))

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        factor: dict[str, float] = {}
        for geom, name, own in native(spec, values):
            factor[name] = float(np.exp(own["softness"]))
            geom.solref[0] *= factor[name]
        for pair in spec.pairs:
            if pair.solref[0] > 0:
                pair.solref[0] *= factor.get(pair.geomname1, 1.0) * factor.get(pair.geomname2, 1.0)
        return None
