"""Where an effect sits in a model; static."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters.attributes import suggest

_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_FREE = int(mujoco.mjtJoint.mjJNT_FREE)
_ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))


def staggered(model: mujoco.MjModel) -> bool:
    """Whether the integrator is read best as a leapfrog: velocities, and what acts, half a timestep before positions.

    So it is where positions move with the new velocities (Euler, implicitfast); RK4 has all of them at one time.
    """
    return int(model.opt.integrator) != int(mujoco.mjtIntegrator.mjINT_RK4)


def early(model: mujoco.MjModel) -> float:
    """s, by which the integrator's velocities lie before its positions, read as a leapfrog."""
    return 0.5 * float(model.opt.timestep) if staggered(model) else 0.0


class Carried(Protocol):
    """What an effect, or its class, says of the elements that can carry it."""

    @property
    def kind(self) -> str: ...
    def carries(self, model: mujoco.MjModel, i: int) -> bool: ...


class Placed(Carried, Protocol):
    """What an effect says of its places."""

    @property
    def name(self) -> str: ...
    @property
    def where(self) -> str | tuple[str, ...]: ...
    @property
    def quantities(self) -> Sequence[Any]: ...
    def places(self) -> tuple[str, ...]: ...


@dataclasses.dataclass(frozen=True, eq=False)
class Site:
    """An effect's places in a model.

    Attributes:
        names: of the elements, `[n]`; ids: their MuJoCo ids, `[n]`.
        tied: all elements share one set of parameters ("all"); else each has its own.
        quantities: number of parameters of one place.
        qadr, dadr: `[n]`, columns in qpos and qvel of the joint (of the joint an actuator drives; -1: no such joint).
        slide: `[n]` bool, the joint is a slide.
        timestep: s, between rows of commands: a sub-step, by RK4 a fourth of one; substeps: rows in a control step;
            nq, nv, nu: sizes.
        mj_model: the nominal model.
    """

    names: tuple[str, ...]
    ids: np.ndarray
    tied: bool
    quantities: int
    qadr: np.ndarray
    dadr: np.ndarray
    slide: np.ndarray
    timestep: float
    substeps: int
    mj_model: mujoco.MjModel

    @property
    def nq(self) -> int:
        return int(self.mj_model.nq)

    @property
    def nv(self) -> int:
        return int(self.mj_model.nv)

    @property
    def nu(self) -> int:
        return int(self.mj_model.nu)

    @property
    def dt(self) -> float:
        """Control step, s."""
        return self.timestep * self.substeps

    @property
    def early(self) -> float:
        """s, by which the integrator's velocities lie before its positions (`early`)."""
        return early(self.mj_model)

    def __len__(self) -> int:
        return len(self.names)

    def values(self, theta: jax.Array) -> jax.Array:
        """Slice the effect's part of theta `[n, quantities]`, one row per element (the same row for all where tied)."""
        rows = theta.reshape(-1, self.quantities)
        return jnp.broadcast_to(rows, (len(self), self.quantities))

    def scatter(self, values: jax.Array) -> jax.Array:
        """One number per element `[n]` -> generalised force `[nv]`, added up where elements share a joint."""
        return jnp.zeros(self.nv, values.dtype).at[self.dadr].add(values)


def find(effect: Placed, model: mujoco.MjModel, timestep: float, substeps: int) -> Site:
    """Find the site of `effect`; UserError where a place is not in the model or cannot carry it."""
    kind = effect.kind
    names = element_names(model, kind)
    usable = _carriers(effect, model)
    if effect.where == "all":
        ids = np.asarray(usable, int)
        if not len(ids):
            raise UserError(f"{effect.name}: the model has no {kind} that could take it")
    else:
        ids = np.asarray([_id(effect, place, names, usable) for place in effect.places()], int)
    joints = _joints(model, kind, ids)
    clean = np.maximum(joints, 0)
    adr = [np.where(joints >= 0, a[clean] if model.njnt else -1, -1) for a in (model.jnt_qposadr, model.jnt_dofadr)]
    slide = (joints >= 0) & (model.jnt_type[clean] == _SLIDE) if model.njnt else np.zeros(len(ids), bool)
    return Site(
        names=tuple(names[i] for i in ids),
        ids=ids,
        tied=effect.where == "all",
        quantities=len(effect.quantities),
        qadr=np.asarray(adr[0], int),
        dadr=np.asarray(adr[1], int),
        slide=np.asarray(slide),
        timestep=timestep,
        substeps=substeps,
        mj_model=model,
    )


def places(effect: Carried, model: mujoco.MjModel) -> tuple[str, ...]:
    """Return the names of all elements of the model that can carry the effect."""
    names = element_names(model, effect.kind)
    return tuple(names[i] for i in _carriers(effect, model))


def _carriers(effect: Carried, model: mujoco.MjModel) -> list[int]:
    """Return the ids of the elements that can carry an effect."""
    count = len(element_names(model, effect.kind))
    return [i for i in range(count) if _usable(model, effect.kind, i) and effect.carries(model, i)]


def element_names(model: mujoco.MjModel, kind: str) -> list[str]:
    """Names of all elements of a kind, in id order; `<kind><id>` for unnamed ones."""
    if kind == "world":
        return ["world"]
    count = {"actuator": model.nu, "joint": model.njnt, "body": model.nbody, "geom": model.ngeom}[kind]
    return [getattr(model, kind)(i).name or f"{kind}{i}" for i in range(count)]


def _usable(model: mujoco.MjModel, kind: str, i: int) -> bool:
    if kind == "joint":
        return int(model.jnt_type[i]) in (_HINGE, _SLIDE)
    return model.body_mass[i] > 0 and model.body_weldid[i] != 0 if kind == "body" else True


def floating(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body has a free joint."""
    return bool(model.body_jntnum[body]) and int(model.jnt_type[model.body_jntadr[body]]) == _FREE


def _id(effect: Placed, place: str, names: list[str], usable: list[int]) -> int:
    if place not in names:
        kind = effect.kind
        raise UserError(f"{effect.name}: no {kind} {place!r} in the model; {suggest(place, [*names, 'all'])}")
    index = names.index(place)
    if index not in usable:
        whys = {"joint": "is neither hinge nor slide", "body": "has no mass or cannot move"}
        why = whys.get(effect.kind, f"has none of what {effect.name} changes")
        allowed = ", ".join(names[i] for i in usable) or "none"
        raise UserError(f"{effect.name}: {effect.kind} {place!r} {why}; allowed: {allowed}")
    return index


def _joints(model: mujoco.MjModel, kind: str, ids: np.ndarray) -> np.ndarray:
    """Find the joint of each element, -1 where there is none (bodies, geoms, actuators on tendons ...)."""
    if kind == "joint":
        return ids
    if kind != "actuator":
        return np.full(len(ids), -1)
    return np.where(np.isin(model.actuator_trntype[ids], _ON_JOINT), model.actuator_trnid[ids, 0], -1)


def joint_dofs(model: mujoco.MjModel) -> np.ndarray:
    """`[nu]`, the (first) column in qvel of the joint that each actuator drives; -1: tendons, sites ..."""
    joints = _joints(model, "actuator", np.arange(model.nu))
    return np.where(joints >= 0, model.jnt_dofadr[joints], -1)


def under_tendon_limit(model: mujoco.MjModel) -> np.ndarray:
    """`[nu]` bool: actuators of tendons whose total actuator force is limited."""
    tendon = (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)) & (model.ntendon > 0)
    limited = np.append(np.asarray(model.tendon_actfrclimited, bool), False)
    return tendon & limited[np.where(tendon, model.actuator_trnid[:, 0], -1)]


def ranges(limited: Any, bounds: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(low, high) `[n]` of bounds `[n, 2]`, infinite where not limited."""
    low, high = jnp.where(jnp.asarray(limited, bool)[:, None], bounds, jnp.array([-jnp.inf, jnp.inf])).T
    return low, high


def columns(at: Site, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """Position and velocity of the site's joints, `[..., n, 2]`, of qpos `[..., nq]` and qvel `[..., nv]`."""
    return jnp.stack([qpos[..., at.qadr], qvel[..., at.dadr]], axis=-1)


def written(at: Site, qpos: jax.Array, qvel: jax.Array, values: jax.Array) -> dict[str, jax.Array]:
    """{"qpos", "qvel"} with the site's joints showing `values`; the inverse of `columns`."""
    return {"qpos": qpos.at[..., at.qadr].set(values[..., 0]), "qvel": qvel.at[..., at.dadr].set(values[..., 1])}
