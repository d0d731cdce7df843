"""Inertial parameters: a link's centre of mass and inertia are not where, and not as large as, its data sheet says."""

import dataclasses
from typing import TYPE_CHECKING, ClassVar

import jax
import mujoco
import numpy as np

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.bodies import inertial_site, native, with_inertials
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.parameters import editing

if TYPE_CHECKING:
    from mujoco import mjx

AXES = "xyz"


@dataclasses.dataclass(frozen=True)
class InertialParameters(Effect):
    """The centre of mass of a body, and the inertia about it; its mass is a parameter of the model itself.

    Parameters: `com_x`, `com_y`, `com_z`, m, by which the centre of mass is off in the body's frame, neutral 0;
    `inertia`, factor on the inertia about it, neutral 1. What a data sheet states: their priors are Gaussian.
    """

    name: ClassVar[str] = "inertial_parameters"
    kind: ClassVar[str] = "body"
    noun: ClassVar[str] = "wrong centre of mass and inertia"
    lacks: ClassVar[str] = "the true centre of mass and inertia"
    separates: ClassVar[str] = "many poses at rest, then the same poses with fast reversals"
    inertial: ClassVar[bool] = True
    tied: ClassVar[bool] = False
    quantities: ClassVar[tuple[Quantity, ...]] = (
        *(
            Quantity(f"com_{a}", 0.0, -0.01, 0.01, unit="m", per="size", reach=(-0.2, 0.2), grid=(0.25,), stated=True)
            for a in AXES
        ),
        Quantity("inertia", 1.0, 0.6, 1.4, grid=(0.25,), stated=True),
    )

    def bind(self, mj_model: mujoco.MjModel, timestep: float, substeps: int) -> Site:
        """See `inertial_site`."""
        return inertial_site(self, mj_model, timestep, substeps)

    def on_model(self, at: Site, model: "mjx.Model", theta: jax.Array) -> "mjx.Model":
        values = at.values(theta)
        away, factor = values[:, :3], values[:, 3:]
        new = {"body_ipos": model.body_ipos[at.ids] + away, "body_inertia": model.body_inertia[at.ids] * factor}
        return with_inertials(model, at.ids, new)

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        """Native: an explicit inertial."""
        for body, _, own in list(native(spec, values)):
            away = np.array([own[f"com_{a}"] for a in AXES])
            if away.any() or own["inertia"] != 1:
                editing.explicit(spec, body)
                body.ipos = np.array(body.ipos) + away
                body.inertia = np.array(body.inertia) * own["inertia"]
        return None
