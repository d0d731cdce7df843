"""MuJoCo Warp under MJX: whole timesteps by its kernels, for `env.impl=warp` (pip install "bayessim-mjx[warp]").

Warp computes a timestep as a whole, so effects that act inside of it cannot be simulated. Its contacts lie in one
buffer for all worlds, here of the size that MJX's own would have for that many. How many step together is counted where
`vmap` batches a control step (`Warp.together`): no caller has to say it. Contacts without room are an overflow: all
worlds of that step diverge, their step is counted in the metric `OVERFLOW`, and who drives the worlds raises
`refuse_overflow`.
"""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from bayessim_mjx.compat import mjx
from bayessim_mjx.effects.effect import Effect, overrides
from bayessim_mjx.errors import UserError

INSIDE = ("on_actuator", "on_force")  # hooks within a timestep
LEAST_WORLDS = 256
OVERFLOW = "contact_overflow"  # metric of a control step: 1 where contacts had no room
LEAST_ITERATIONS = 20  # of the solver and its line search; Warp's stop by themselves where they have converged


class Warp:
    """A model that Warp steps.

    Args:
        mj_model: the nominal MuJoCo model.
        template: the JAX implementation's data, whose numbers of contacts and constraints are the bounds of Warp's.
        effects: those of the physics.

    Raises:
        UserError: where warp-lang is missing, or an effect acts inside the timestep.
    """

    def __init__(self, mj_model: mujoco.MjModel, template: mjx.Data, effects: Sequence[Effect]) -> None:
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
        self._mj_model, self._made = mj_model, {}  # type: tuple[mujoco.MjModel, dict[int, mjx.Data]]
        self._contacts = max(1, template._impl.contact.dist.shape[0])
        self._rows = max(1, template._impl.efc_J.shape[0])
        self._bare = self._data(1)  # its shared arrays have another shape than those of any scratch

    def room(self, worlds: int) -> int:
        """Contacts that so many worlds have room for together."""
        return self._contacts * max(LEAST_WORLDS, worlds)

    def _data(self, room: int) -> mjx.Data:
        """`mjx.Data` with room for so many contacts, made once."""
        if room not in self._made:
            with jax.ensure_compile_time_eval():  # arrays, also while a program is traced
                sizes = {"naconmax": room, "naccdmax": room, "njmax": self._rows}
                self._made[room] = mjx.make_data(self._mj_model, impl="warp", **sizes)
        return self._made[room]

    def together(self, timesteps: Callable[..., mjx.Data], *args: Any) -> mjx.Data:
        """`timesteps(scratch, *args)` of one world; scratch has room for all worlds that `vmap` makes of it.

        Of what comes back the arrays that all worlds share, the contacts, are empty.
        """
        return self._over(timesteps, ())(*args)

    def _over(self, timesteps: Callable[..., mjx.Data], shape: tuple[int, ...]) -> Callable[..., mjx.Data]:
        """Return the same of worlds `[*shape]`, which `vmap` makes `[n, *shape]`."""
        worlds = math.prod(shape)
        scratch = self._data(self.room(worlds))

        def one(*args: Any) -> mjx.Data:
            return self._apart(timesteps(scratch, *args))

        def run(*args: Any) -> mjx.Data:
            if not shape:
                return one(*args)
            flat = jax.tree.map(lambda x: x.reshape(worlds, *x.shape[len(shape) :]), args)
            found = jax.vmap(one)(*flat)
            grid = lambda own, x: x.reshape(*shape, *x.shape[1:]) if own else x  # noqa: E731
            return jax.tree.map(grid, self._worlds_own(found), found)

        counted = jax.custom_batching.custom_vmap(run)

        @counted.def_vmap
        def _(size: int, batched: Any, *args: Any) -> tuple[mjx.Data, Any]:
            full = jax.tree.map(
                lambda x, has: x if has else jnp.broadcast_to(x, (size, *jnp.shape(x))), args, tuple(batched)
            )
            found = self._over(timesteps, (size, *shape))(*full)
            return found, self._worlds_own(found)

        return counted

    def _apart(self, data: mjx.Data) -> mjx.Data:
        """Return `data` without contacts, so that it is of one kind whatever room there was."""
        bare, structure = jax.tree.flatten(self._bare)
        pairs = zip(jax.tree.leaves(data), bare, strict=True)
        return jax.tree.unflatten(structure, [x if jnp.shape(x) == none.shape else none for x, none in pairs])

    def _worlds_own(self, data: mjx.Data) -> mjx.Data:
        """Which arrays of the data of a batch have an axis of worlds: MJX gives it none to those that all share."""
        return jax.tree.map(lambda x, one: x.ndim > one.ndim, data, self._bare)

    def model_of(self, fields: Mapping[str, jax.Array]) -> mjx.Model:
        """Return the model with these arrays of JAX's, by dotted name, in place of the nominal ones."""
        return self.model.tree_replace({name: x.reshape(self._shape(name)) for name, x in fields.items()})

    def _shape(self, name: str) -> tuple[int, ...]:
        if name not in self._shapes:
            raise UserError(f"env.impl = 'warp': a parameter changes {name}, which Warp's models do not have")
        return self._shapes[name]

    def step(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        """One timestep; where contacts had no room, the state and its time are not numbers (`overflowed`)."""
        after = mjx.step(model, data)
        room = data._impl.contact__dist.shape[0]
        found = jnp.maximum(after._impl.nacon, after._impl.ncollision)  # contacts, and pairs that might be in contact
        fits = jnp.all(found <= room)
        return after.replace(qpos=jnp.where(fits, after.qpos, jnp.nan), time=jnp.where(fits, after.time, jnp.nan))


def overflowed(data: mjx.Data) -> jax.Array:
    """1 where contacts had no room in a timestep that led to `data`, else 0; MuJoCo's time never diverges by itself."""
    return jnp.isnan(data.time).astype(jnp.float32)


def refuse_overflow(share: Any, of: str) -> None:
    """UserError where contacts had no room.

    Args:
        share: the metric `OVERFLOW`, or any mean of it; 0: all had room.
        of: what it is a share of, for the message.
    """
    if (share := float(share)) > 0:
        raise UserError(
            f"env.impl = 'warp': contacts had no room in {share:.2g} of {of}, and all worlds diverged there: the model "
            "makes more contacts than MJX counts for it; set env.impl to jax, or raise the model's custom number "
            "max_contact_points where it has one"
        )


def without_warp(error: RuntimeError) -> Exception:
    """Return the error where MJX could not make a model for Warp: how to get Warp if it is missing, else the same."""
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
