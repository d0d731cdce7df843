"""Whether MJX can simulate a model that somebody brings, what to change where it cannot, and what may be left out."""

import math
import warnings
from collections.abc import Sequence

import mujoco
import numpy as np

from bayessim_mjx import urdf
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Log
from bayessim_mjx.physics import Physics, mjx
from bayessim_mjx.physics.native import absent

AXIAL = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))

# Of a joint's travel in the logs and of its range, the larger: as near as the motion has to come
# (docs/decisions/unreached_limits.md).
NEAR_TRAVEL, NEAR_RANGE = 0.25, 0.05


def one_line(error: Exception) -> str:
    return "; ".join(line.strip() for line in str(error).splitlines() if line.strip())


def check(model: mujoco.MjModel, source: str, lean: mujoco.MjModel | None = None) -> None:
    """Refuse a model without motion or commands, and what MJX cannot simulate; lean: what it is simulated as."""
    urdf.check_names(model, source)
    step = float(model.opt.timestep)
    if not (math.isfinite(step) and step > 0):
        raise UserError(f"{source}: <option timestep> = {step:g}; allowed: seconds > 0")
    if broken := _not_finite(model):
        raise UserError(f"{source}: numbers that are not finite in {', '.join(broken)}; allowed: finite numbers")
    idle = [label(model, "actuator", i) for i in range(model.nu) if not np.any(model.actuator_gear[i])]
    if len(idle) == model.nu:
        raise UserError(f"{source}: gear = 0 of every actuator ({', '.join(idle)}): the logged commands cannot act")
    if idle:
        warnings.warn(f"{source}: gear = 0 of {', '.join(idle)}: these commands do nothing", stacklevel=3)
    if model.nplugin:
        raise UserError(f"{source}: MJX cannot simulate this model: it has plugins")
    if why := absent(model):
        raise UserError(f"{source}: MJX does not simulate {why}")
    try:
        mjx.make_data(mjx.put_model(model if lean is None else lean, impl="jax"))
    except (NotImplementedError, ValueError, TypeError) as error:
        raise UserError(f"{source}: MJX cannot simulate this model: {one_line(error)}{_remedy(str(error))}") from None


def _not_finite(model: mujoco.MjModel) -> list[str]:
    """MuJoCo's arrays with a NaN or an infinity in them, by name: a gain, a mass, and what follows from them."""
    fields = ((name, getattr(model, name, None)) for name in dir(model) if not name.startswith("_"))
    floats = ((name, x) for name, x in fields if isinstance(x, np.ndarray) and x.dtype.kind == "f")
    return [name for name, x in floats if not np.isfinite(x).all()]


def _remedy(message: str) -> str:
    """Say what to change in the MJCF."""
    return next((f" ({remedy})" for word, remedy in _REMEDIES.items() if word in message), "")


_REMEDIES = {
    "mjtIntegrator": "use Euler, implicitfast or RK4 in <option integrator=...>",
    "mjtSolver": "use CG or Newton in <option solver=...>",
    "collisions": "switch the contacts of these geoms off by contype and conaffinity, or use other shapes",
    "margin/gap": "take margin and gap off these geoms",
    "Flex": "take the flexible bodies out",
    "mjtEnableBit": "take it out of <option><flag>",
    "mjGEOM": "use other shapes for these geoms",
    "fluid": "use the integrator Euler, or density and viscosity 0",
    "mjtSensor": "take these sensors out: a diagnosis reads joints",
    "not supported": "MJX has motor, position, velocity and general actuators on joints, tendons and sites",
}


def label(model: mujoco.MjModel, kind: str, i: int) -> str:
    return getattr(model, kind)(i).name or f"{kind}{i}"


def contacts(physics: Physics) -> bool:
    """Whether anything can touch."""
    return bool(physics.template._impl.contact.dist.shape[0])


def unreached(model: mujoco.MjModel, logs: Sequence[Log]) -> tuple[int, ...]:
    """Joints with limits whose motion in the logs stays away from them; none that is not measured in all logs."""
    return tuple(j for j in range(model.njnt) if model.jnt_limited[j] and _away(model, j, logs))


def _away(model: mujoco.MjModel, j: int, logs: Sequence[Log]) -> bool:
    if model.jnt_type[j] not in AXIAL or not all(log.seen_dofs[model.jnt_dofadr[j]] for log in logs):
        return False
    q = np.concatenate([log.qpos[:, model.jnt_qposadr[j]] for log in logs])
    low, high = model.jnt_range[j]
    room = max(NEAR_TRAVEL * np.ptp(q), NEAR_RANGE * (high - low))
    return bool(low + room < q.min() and q.max() < high - room)
