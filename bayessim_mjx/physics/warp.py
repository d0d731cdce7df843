"""MuJoCo Warp under MJX: whole timesteps by its kernels, for `env.impl=warp` (pip install "bayessim-mjx[warp]").

Warp computes a timestep as a whole, so effects that act inside of it cannot be simulated. Its contacts lie in one
buffer for all worlds, here of the size that MJX's own would have for that many; where it is full, worlds diverge.
"""

import copy
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import mujoco

from bayessim_mjx.compat import mjx
from bayessim_mjx.effects.effect import Effect, overrides
from bayessim_mjx.errors import UserError

INSIDE = ("on_actuator", "on_force")  # hooks within a timestep
LEAST_WORLDS = 256
LEAST_ITERATIONS = 20  # of the solver and its line search; Warp's stop by themselves where they have converged


class Warp:
    """A model that Warp steps.

    Args:
        mj_model: the nominal MuJoCo model.
        template: the JAX implementation's data, whose numbers of contacts and constraints are the bounds of Warp's.
        effects: those of the physics.
        worlds: how many are simulated together.

    Raises:
        UserError: where warp-lang is missing, or an effect acts inside the timestep.
    """

    def __init__(
        self, mj_model: mujoco.MjModel, template: mjx.Data, effects: Sequence[Effect], worlds: int | None
    ) -> None:
        for effect in effects:
            if any(overrides(effect, hook) for hook in INSIDE):
                raise UserError(
                    f"env.impl = 'warp': {effect.name} acts inside the timestep, which Warp computes as a whole; leave "
                    "the effect out or set env.impl to jax"
                )
        mj_model = copy.copy(mj_model)
        mj_model.opt.iterations = max(mj_model.opt.iterations, LEAST_ITERATIONS)
        mj_model.opt.ls_iterations = max(mj_model.opt.ls_iterations, LEAST_ITERATIONS)
        try:
            model = mjx.put_model(mj_model, impl="warp")
        except RuntimeError as error:
            raise without_warp(error) from None
        wanted = {"opt._impl.run_rne_postconstraint": True}  # forces on bodies, as tasks want
        self.model = model.tree_replace(wanted | quieter(model))
        leaves, _ = jax.tree_util.tree_flatten_with_path(self.model)
        self._shapes = {jax.tree_util.keystr(path, simple=True, separator="."): x.shape for path, x in leaves}
        self.room = max(1, template._impl.contact.dist.shape[0] * max(LEAST_WORLDS, worlds or 0))
        rows = max(1, template._impl.efc_J.shape[0])
        self.data = mjx.make_data(mj_model, impl="warp", naconmax=self.room, naccdmax=self.room, njmax=rows)

    def model_of(self, fields: Mapping[str, jax.Array]) -> mjx.Model:
        """The model with these arrays of the JAX implementation's, by dotted name, in place of the nominal ones."""
        return self.model.tree_replace({name: x.reshape(self._shape(name)) for name, x in fields.items()})

    def _shape(self, name: str) -> tuple[int, ...]:
        if name not in self._shapes:
            raise UserError(f"env.impl = 'warp': a parameter changes {name}, which Warp's models do not have")
        return self._shapes[name]

    def step(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        """One timestep; not a number where the contacts of all worlds had no room."""
        after = mjx.step(model, data)
        found = jnp.maximum(after._impl.nacon, after._impl.ncollision)  # contacts, and pairs that might be in contact
        fits = jnp.all(found <= self.room)
        return after.replace(qpos=jnp.where(fits, after.qpos, jnp.nan))


def without_warp(error: RuntimeError) -> Exception:
    """What to raise where MJX could not make a model for Warp: how to get Warp where that is missing, else the same."""
    if "warp-lang" not in str(error):
        return error
    return UserError(
        "env.impl = 'warp' needs the package warp-lang: pip install \"bayessim-mjx[warp]\", or set it to jax"
    )


def quieter(model: mjx.Model) -> dict[str, int]:
    """No line is printed where a solver ends at its limit, for a world and timestep each; MuJoCo tells none either."""
    try:
        from mujoco.mjx.third_party.mujoco_warp import OverflowType
    except ImportError:  # of a version that prints none
        return {}
    off = OverflowType.ITERATIONS | OverflowType.LS_ITERATIONS
    return {"opt._impl.warn_overflow": int(model.opt._impl.warn_overflow) & ~int(off)}


def wrenches(model: mjx.Model, data: mjx.Data) -> jax.Array:
    """`[nbody, 6]` torque (about the centre of mass of the body's tree) and force of contacts, world axes (N m, N).

    model: the JAX implementation's; data: of either implementation, as `control_step` gives it.
    """
    return (mjx.rne_postconstraint(model, data) if data.impl.value == "jax" else data)._impl.cfrc_ext
