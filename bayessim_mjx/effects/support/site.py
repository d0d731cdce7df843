"""Where an effect sits in a model (static), and what it sees of a sub-step (traced)."""

import copy
import dataclasses
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from bayessim_mjx.errors import UserError
from bayessim_mjx.linalg import inverse_lower, product
from bayessim_mjx.parameters.attributes import suggest

if TYPE_CHECKING:
    from collections.abc import Callable

    from mujoco import mjx

    from bayessim_mjx.effects.effect import Effect

AROUND = 0.1  # s of recorded motion before and after a start that effects with memory may look at, at least
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_KINDS = ("actuator", "joint", "body", "geom")
_ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_CONSTANT = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtGain.mjGAIN_FIXED))
_AFFINE = (int(mujoco.mjtBias.mjBIAS_AFFINE), int(mujoco.mjtGain.mjGAIN_AFFINE))


@dataclasses.dataclass(frozen=True, eq=False)
class Site:
    """An effect's places in a model.

    Attributes:
        names: of the elements, `[n]`; ids: their MuJoCo ids, `[n]`.
        tied: all elements share one set of parameters ("all"); else each has its own.
        quantities: number of parameters of one place.
        qadr, dadr: `[n]`, columns in qpos and qvel of the joint (of the joint an actuator drives; -1: no such joint).
        slide: `[n]` bool, the joint is a slide.
        timestep: s, of a sub-step; substeps: per control step; nq, nv, nu: sizes.
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

    def __len__(self) -> int:
        return len(self.names)

    def values(self, theta: jax.Array) -> jax.Array:
        """The effect's slice of theta as `[n, quantities]`, one row per element (the same row for all where tied)."""
        rows = theta.reshape(-1, self.quantities)
        return jnp.broadcast_to(rows, (len(self), self.quantities))

    def scatter(self, values: jax.Array) -> jax.Array:
        """One number per element `[n]` -> generalised force `[nv]`, added up where elements share a joint."""
        return jnp.zeros(self.nv, values.dtype).at[self.dadr].add(values)


def find(effect: "Effect", model: mujoco.MjModel, timestep: float, substeps: int) -> Site:
    """The site of `effect`; UserError where a place is not in the model or cannot carry it."""
    kind = effect.kind
    names = element_names(model, kind)
    usable = [i for i in range(len(names)) if _usable(model, kind, i)]
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


def places(effect_kind: str, model: mujoco.MjModel) -> tuple[str, ...]:
    """Names of all elements of the model that can carry an effect of this kind."""
    names = element_names(model, effect_kind)
    return tuple(n for i, n in enumerate(names) if _usable(model, effect_kind, i))


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


def _id(effect: "Effect", place: str, names: list[str], usable: list[int]) -> int:
    if place not in names:
        kind = effect.kind
        raise UserError(f"{effect.name}: no {kind} {place!r} in the model; {suggest(place, [*names, 'all'])}")
    index = names.index(place)
    if index not in usable:
        why = "is neither hinge nor slide" if effect.kind == "joint" else "has no mass or cannot move"
        allowed = ", ".join(names[i] for i in usable) or "none"
        raise UserError(f"{effect.name}: {effect.kind} {place!r} {why}; allowed: {allowed}")
    return index


def _joints(model: mujoco.MjModel, kind: str, ids: np.ndarray) -> np.ndarray:
    """The joint of each element, -1 where there is none (bodies, geoms, actuators on tendons ...)."""
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


class SubStep:
    """What is known of one sub-step before its acceleration. Made while tracing; derived values are computed once.

    Attributes:
        model, data: data holds this sub-step's poses, mass matrix, qfrc_bias, qfrc_passive, actuator_force and moments.
        force: `[nv]`, passive - bias + actuators + all other effects; no constraint forces (they are not known yet).
        actuator_force: `[nu]`, after the effects on actuators.
        ctrl: `[nu]`, the command as it reached the actuators.
        dt: s, the sub-step.
        last: `[nv]`, this effect's own force in the last sub-step.
        measurement: what the sensors showed after the last control step.
    """

    def __init__(
        self,
        model: "mjx.Model",
        data: "mjx.Data",
        measurement: dict[str, jax.Array],
        dt: float,
        asked: jax.Array | None = None,
        response: "Callable[[], jax.Array | None] | None" = None,
    ) -> None:
        self.model, self.data, self.measurement, self.dt = model, data, measurement, dt
        self.force = self.last = data.qfrc_applied
        self.actuator_force = data.actuator_force
        self._responding = response
        self._cache: dict[str, Any] = {} if asked is None else {"asked": asked}

    def seen_by(self, force: jax.Array, last: jax.Array) -> "SubStep":
        """The same sub-step with the forces that one effect sees."""
        other = copy.copy(self)
        other.force, other.last = force, last
        return other

    def _once(self, name: str, compute: "Callable[[], Any]") -> Any:
        if name not in self._cache:
            self._cache[name] = compute()
        return self._cache[name]

    @property
    def ctrl(self) -> jax.Array:
        return self.data.ctrl

    @property
    def qpos(self) -> jax.Array:
        return self.data.qpos

    @property
    def qvel(self) -> jax.Array:
        return self.data.qvel

    @property
    def signal(self) -> jax.Array:
        """`[nu]`, what the actuators act on: the command within its range, or the activation where there is one."""
        model, data = self.model, self.data
        signal = jnp.clip(data.ctrl, *ranges(model.actuator_ctrllimited, model.actuator_ctrlrange))
        if not model.na:
            return signal
        last = np.clip(model.actuator_actadr + model.actuator_actnum - 1, 0, model.na - 1)
        return jnp.where(model.actuator_actadr < 0, signal, data.act[last])

    @property
    def asked(self) -> jax.Array:
        """`[nu]`, force before any limit: (k0 + k1 l + k2 l') u + b0 + b1 l + b2 l'; of muscles, as it is."""
        return self._once("asked", self._asked)

    def _asked(self) -> jax.Array:
        model, data = self.model, self.data
        terms = jnp.stack([jnp.ones(model.nu), data.actuator_length, data._impl.actuator_velocity])
        gain, bias = (jnp.sum(prm[:, :3].T * terms, 0) for prm in (model.actuator_gainprm, model.actuator_biasprm))
        fixed, none = model.actuator_gaintype == _CONSTANT[1], model.actuator_biastype == _CONSTANT[0]
        linear = (fixed | (model.actuator_gaintype == _AFFINE[1])) & (none | (model.actuator_biastype == _AFFINE[0]))
        gain, bias = jnp.where(fixed, model.actuator_gainprm[:, 0], gain), jnp.where(none, 0.0, bias)
        return jnp.where(linear, gain * self.signal + bias, data.actuator_force)

    @property
    def response(self) -> jax.Array:
        """`[nu]`, how much of a change of its damping force an actuator passes on: 1; 0 at a limit or switched off."""
        found = self._response
        return jnp.ones(self.model.nu) if found is None else found

    @property
    def _response(self) -> jax.Array | None:
        return self._once("response", self._responding or (lambda: None))

    @property
    def solved(self) -> "mjx.Model":
        """The model that an implicit integrator differentiates: actuators damp as far as they respond."""
        model = self.model
        shifted, affine = model.actuator_biastype == _AFFINE[0], model.actuator_gaintype == _AFFINE[1]
        if not np.any(shifted | affine) or self._response is None:
            return model
        gain, bias = (
            p.at[:, 2].set(p[:, 2] * self._response) for p in (model.actuator_gainprm, model.actuator_biasprm)
        )
        return model.replace(actuator_gainprm=gain, actuator_biasprm=bias)

    @property
    def inverse(self) -> jax.Array:
        """`[nv, nv]`, inverse of the matrix that the integrator solves: M plus the implicit damping."""

        def compute() -> jax.Array:
            factor = inverse_lower(jnp.linalg.cholesky(self._inertia()))
            return product(factor.T, factor)

        return self._once("inverse", compute)

    def _inertia(self) -> jax.Array:
        from mujoco import mjx

        model = self.model
        inertia = mjx.full_m(model, self.data)
        integrator = int(model.opt.integrator)
        euler = integrator == int(mujoco.mjtIntegrator.mjINT_EULER)
        if euler and not int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP):
            return inertia + model.opt.timestep * jnp.diag(model.dof_damping)
        implicit = integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
        derivative = mjx.deriv_smooth_vel(self.solved, self.data) if implicit else None
        return inertia if derivative is None else inertia - model.opt.timestep * derivative

    @property
    def next_qvel(self) -> jax.Array:
        """`[nv]`, the velocities at the end of the sub-step under the forces known so far."""
        return self.qvel + self.dt * product(self.inverse, self.force[:, None])[:, 0]


class Motion(struct.PyTreeNode):
    """Recorded motion around a start, one row per control step; row `start` is the start itself.

    Attributes:
        qpos: `[rows, nq]`, qvel: `[rows, nv]`.
        command: `[rows, substeps, nu]`; row k acts from row k to row k + 1.
        start: static int.
    """

    qpos: jax.Array
    qvel: jax.Array
    command: jax.Array
    start: int = struct.field(pytree_node=False)

    def shifted(self, at: Site, steps: jax.Array) -> jax.Array:
        """Position and velocity of each joint of `at` read its own number of control steps later, `[rows, n, 2]`.

        Args: steps: `[n]`, in control steps, of any sign, with fractions; the recording's ends are held.
        """
        last = self.qpos.shape[0] - 1
        when = jnp.clip(jnp.arange(last + 1)[:, None] + steps, 0, last)
        low = jnp.clip(jnp.floor(when).astype(jnp.int32), 0, max(last - 1, 0))
        part = when - low

        def row(x: jax.Array, ahead: int) -> jax.Array:
            return jnp.take_along_axis(x, jnp.clip(low + ahead, 0, last), axis=0)

        qpos, qvel = self.qpos[:, at.qadr], self.qvel[:, at.dadr]
        before, here, there, after = (row(qvel, k) for k in (-1, 0, 1, 2))
        # cubic through four velocities: the derivative of a Hermite spline would divide the encoders' noise by dt
        inner, outer = (1 + part) * (2 - part) / 2, -part * (1 - part) / 6
        velocity = inner * ((1 - part) * here + part * there) + outer * ((2 - part) * before + (1 + part) * after)
        return jnp.stack([between(row(qpos, 0), row(qpos, 1), there - here, part, at.dt), velocity], axis=-1)


def between(one: jax.Array, two: jax.Array, gained: jax.Array, part: jax.Array, dt: float) -> jax.Array:
    """Position a `part` of the way from `one` to `two`, dt apart, at constant acceleration gained / dt.

    Only the *difference* of the velocities bends the path: where an end is held it is a line, and the half sub-step by
    which semi-implicit Euler's velocities lag, the same at both ends, cancels (not so in a Hermite spline).
    """
    return (1 - part) * one + part * two - 0.5 * jnp.float32(dt) * part * (1 - part) * gained
