"""What MuJoCo has and MJX leaves out, or is slow at: it is added, moved to joints or refused."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.friction import Soft, dry
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

_AXIAL = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_LEAST = 1e-9  # 1/s, keeps a quotient finite
_ON_JOINT = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
# field of the model: (what it is, what to write in its place)
_ABSENT = {
    "actuator_delay": (
        "an actuator's delay",
        "take delay= out of the model: the effect actuator_delay has it, and a diagnosis searches for it",
    ),
    "actuator_damping": ("an actuator's damping", "write damping times gear squared at its joint or tendon"),
    "actuator_armature": ("an actuator's armature", "write armature times gear squared at its joint or tendon"),
    "jnt_springyield": ("a joint's springyield", "take springyield= out of the model"),
    "tendon_springyield": ("a tendon's springyield", "take springyield= out of the model"),
    "tendon_dampingpoly": ("a tendon's polynomial damping", "write one number as its damping"),
    "tendon_stiffnesspoly": ("a tendon's polynomial stiffness", "write one number as its stiffness"),
    "actuator_dampingpoly": ("an actuator's polynomial damping", "write it at its joint"),
}
# (field of the model, name in mujoco of its value): (what it is, what to write in its place)
_DRIVES = {
    ("actuator_gaintype", "mjtGain.mjGAIN_DCMOTOR"): (
        "dcmotor",
        'write <general gainprm="K/R" biastype="affine" biasprm="0 0 -K*K/R"/>, K its motorconst and R its resistance; '
        "a diagnosis searches for lag and cogging",
    ),
    ("actuator_gaintype", "mjtGain.mjGAIN_PID"): (
        "pid",
        "write <position kp= kv=/>; an integral term and a target of the speed have no place there",
    ),
    ("actuator_gaintype", "mjtGain.mjGAIN_SO3"): ("a servo of orientations", "write a <motor> about each axis"),
    ("actuator_gaintype", "mjtGain.mjGAIN_USER"): ("gaintype user", "write fixed or affine"),
    ("actuator_biastype", "mjtBias.mjBIAS_USER"): ("biastype user", "write none or affine"),
    ("actuator_dyntype", "mjtDyn.mjDYN_USER"): ("dyntype user", "write none, integrator, filter or filterexact"),
    ("actuator_trntype", "mjtTrn.mjTRN_SLIDERCRANK"): (
        "a crank and slider",
        "write the crank as a body, closed by <connect>",
    ),
    ("actuator_trntype", "mjtTrn.mjTRN_BODY"): ("adhesion", "take it out"),
}


@dataclasses.dataclass(frozen=True)
class PolynomialForces(Effect):
    """F = -(d1 |v| + d2 v^2) v - (k1 x + k2 x^2) x of joints, x from the spring's rest; MuJoCo's own formula.

    It has no parameters and is no candidate.
    """

    where: str | tuple[str, ...] = "all"
    name: ClassVar[str] = "polynomial_forces"
    kind: ClassVar[str] = "joint"
    quantities: ClassVar[tuple[Quantity, ...]] = ()

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        model = at.mj_model
        damping, spring = (jnp.asarray(p) for p in (model.dof_dampingpoly[at.dadr], model.jnt_stiffnesspoly[at.ids]))
        v, x = step.qvel[at.dadr], step.qpos[at.qadr] - jnp.asarray(model.qpos_spring[at.qadr])
        drag = (damping[:, 0] * jnp.abs(v) + damping[:, 1] * v**2) * v
        pull = (spring[:, 0] * x + spring[:, 1] * x**2) * x
        return memory, at.scatter(-drag - pull)


@dataclasses.dataclass(frozen=True)
class FrictionLoss(Effect):
    """The model's own frictionloss at hinges and slides, where no solver is to iterate for it; see `friction.Soft`.

    It has no parameters and is no candidate.
    """

    name: ClassVar[str] = "friction_loss"
    kind: ClassVar[str] = "joint"
    quantities: ClassVar[tuple[Quantity, ...]] = ()

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        model = at.mj_model
        dmin, dmax = model.dof_solimp[at.dadr, :2].T
        direct, (constant, damping) = model.dof_solref[at.dadr, 0] <= 0, model.dof_solref[at.dadr].T
        constant = np.where(direct, 2 / np.maximum(-damping, _LEAST), np.maximum(constant, 2 * model.opt.timestep))
        soft = Soft(at, step, jnp.asarray(constant, jnp.float32), dmin, dmax)
        return memory, dry(at, step, step.model.dof_frictionloss[at.dadr], soft)


def rubbing(model: mujoco.MjModel) -> tuple[str, ...]:
    """Names of the joints whose frictionloss `FrictionLoss` may be; () where others have one, or it is switched off."""
    off = int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS)
    joints = np.unique(model.dof_jntid[model.dof_frictionloss > 0])
    if off or model.tendon_frictionloss.any() or not np.isin(model.jnt_type[joints], _AXIAL).all():
        return ()
    return tuple(model.joint(int(j)).name or f"joint{j}" for j in joints)


def own_forces(model: mujoco.MjModel) -> tuple[Effect, ...]:
    """Return the forces of a model's joints that MJX leaves out, as an effect that is always on; mostly none."""
    return (PolynomialForces(),) if _polynomial(model).any() else ()


def _polynomial(model: mujoco.MjModel) -> np.ndarray:
    """`[njnt]` bool, joints with polynomial damping or stiffness."""
    damping, stiffness = getattr(model, "dof_dampingpoly", None), getattr(model, "jnt_stiffnesspoly", None)
    out = np.zeros(model.njnt, bool)
    if damping is not None:
        out[model.dof_jntid[np.any(damping, axis=1)]] = True
    return out if stiffness is None else out | np.any(stiffness, axis=1)


def absent(model: mujoco.MjModel) -> str:
    """Why MJX would move a model otherwise than MuJoCo, with what to write in its place; "" if it would not."""
    found = [f"{what} ({way})" for field, (what, way) in _ABSENT.items() if np.any(getattr(model, field, 0.0))]
    other = _polynomial(model) & ~np.isin(model.jnt_type, _AXIAL)
    if other.any():
        found.append(
            f"polynomial damping or stiffness of {_named(model, 'joint', other)} (allowed: at hinges and slides)"
        )
    return "; ".join([*found, *_absent_drives(model)])


def _absent_drives(model: mujoco.MjModel) -> list[str]:
    """Actuators that MJX refuses or takes for others, by name, with what to write in their place."""
    found, known = [], np.ones(len(model.actuator_group), bool)
    for (field, value), (what, way) in _DRIVES.items():
        kind, name = value.split(".")
        own = getattr(model, field) == int(getattr(getattr(mujoco, kind), name, -1))
        if own.any():
            found.append(f"{what} at {_named(model, 'actuator', own)} ({way})")
        known &= ~own
    early = known & (model.actuator_actadr >= 0) & (getattr(model, "actuator_actearly", 0) > 0)
    if early.any():
        way = "take actearly out: forces then follow a timestep later"
        found.append(f"actearly at {_named(model, 'actuator', early)} ({way})")
    off = (model.opt.disableactuator >> np.clip(model.actuator_group, 0, 30)) & 1 == 1
    if off.any():
        way = "take it out of <option>, and these actuators, which do nothing, out of <actuator>"
        found.append(f"actuatorgroupdisable of {_named(model, 'actuator', off)} ({way})")
    return found


def _named(model: mujoco.MjModel, kind: str, some: np.ndarray) -> str:
    """Names of some joints or actuators (`[n]` bool), by number where they have none."""
    return ", ".join(getattr(model, kind)(int(i)).name or f"{kind}{i}" for i in np.flatnonzero(some))


def moved_to_joints(spec: mujoco.MjSpec) -> None:
    """Move actuators' damping and armature to the joint or tendon that they drive, in place: the same equations.

    Reflected through the gear they grow by its square. What has another transmission stays, and `absent` names it.
    """
    for actuator in spec.actuators:
        driven = spec.tendon(actuator.target) if actuator.trntype == mujoco.mjtTrn.mjTRN_TENDON else None
        driven = spec.joint(actuator.target) if actuator.trntype in _ON_JOINT else driven
        if driven is None:
            continue
        for name in ("damping", "armature"):
            own, there = (np.asarray(getattr(x, name), float) for x in (actuator, driven))
            if own.size and own.flat[0]:
                more = own.flat[0] * float(actuator.gear[0]) ** 2
                setattr(driven, name, there + more if there.ndim == 0 else there + np.eye(1, there.size)[0] * more)
                setattr(actuator, name, own * 0.0 if own.ndim == 0 else own * np.append(0.0, np.ones(own.size - 1)))
