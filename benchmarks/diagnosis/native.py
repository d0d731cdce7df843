"""Parameters of mujoco.sysid: those that the simulator already has, and the effects that MuJoCo has as attributes.

Written in place into a spec, as absolute values or after the base, so that nothing accumulates from call to call.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import mujoco
import numpy as np
from mujoco import sysid

SPREAD = 0.2
# quantities of the library's effects that have an attribute; a spring's cubic part stays 0, as in the library's MJCF
NATIVE = {
    "actuator_bias": ("bias",),
    "actuator_gain": ("gain",),
    "actuator_saturation": ("inverse_limit",),
    "armature": ("inertia",),
    "coulomb_friction": ("level",),
    "gravity_tilt": ("roll", "pitch"),
    "joint_spring": ("stiffness", "rest"),
    "payload": ("mass", "com_x", "com_y", "com_z"),
    "quadratic_drag": ("coefficient",),
    "viscous_friction": ("damping",),
}


def moving(model: mujoco.MjModel) -> list[str]:
    return [model.body(i).name for i in range(model.nbody) if model.body_weldid[i] != 0]


def specification(path: str, loads: bool = False) -> mujoco.MjSpec:
    """The model with encoders; `loads`: and with a body of no mass at every moving one, for `payload`."""
    spec = mujoco.MjSpec.from_file(path)
    for joint in spec.joints:  # mujoco.sysid wants as many sensors as there are columns
        sensor = spec.add_sensor(name=f"{joint.name}_pos", type=mujoco.mjtSensor.mjSENS_JOINTPOS, objname=joint.name)
        sensor.objtype = mujoco.mjtObj.mjOBJ_JOINT
    for name in moving(spec.copy().compile()) if loads else []:
        load = spec.body(name).add_body(name=f"{name}.payload")
        load.mass, load.ipos, load.inertia, load.explicitinertial = 1e-9, np.zeros(3), np.full(3, 1e-12), True
    return spec


def base(nominal: mujoco.MjModel) -> sysid.ParameterDict:
    """Factors of mass, damping and armature, as `truth.json` names them."""
    joints = [nominal.joint(i).name for i in range(nominal.njnt)]
    bodies = [b for b in moving(nominal) if not b.endswith(".payload")]
    params = sysid.ParameterDict()
    for place, what in [(b, "mass") for b in bodies] + [(j, a) for a in ("damping", "armature") for j in joints]:
        write = partial(_write_base, nominal, place, what)
        params.add(sysid.Parameter(f"{place}.{what}", 1.0, 1 - SPREAD, 1 + SPREAD, modifier=write))
    return params


def _write_base(
    nominal: mujoco.MjModel, place: str, what: str, spec: mujoco.MjSpec, parameter: sysid.Parameter
) -> None:
    x = float(parameter.value[0])
    if what == "mass":
        (geom,) = (g for g in spec.body(place).geoms if g.mass > 0)
        geom.mass = x * nominal.body(place).mass[0]
        return
    joint, dof = spec.joint(place), nominal.joint(place)
    if what == "damping":
        joint.damping[0] = x * nominal.dof_damping[dof.dofadr[0]]
    else:
        joint.armature = x * nominal.dof_armature[dof.dofadr[0]]


def effects(nominal: mujoco.MjModel, candidates: Sequence[Any]) -> Iterator[sysid.Parameter]:
    """The library's candidates that MuJoCo has, with the same places and bounds, from its neutral values."""
    for c in candidates:
        if c.effect not in NATIVE:
            continue
        own = {k.name.rsplit(".", 1)[1]: k for k in c.coordinates}
        start, low, high = ([getattr(own[q], e) for q in NATIVE[c.effect]] for e in ("neutral", "low", "high"))
        places = _places(nominal, c.kind) if c.where == "all" else [c.where]
        write = partial(write_effect, nominal, c.effect, places)
        yield sysid.Parameter(c.label, start, low, high, modifier=write)


def _places(nominal: mujoco.MjModel, kind: str) -> list[str]:
    if kind == "body":
        return [b for b in moving(nominal) if not b.endswith(".payload")]
    count = nominal.njnt if kind == "joint" else nominal.nu
    return [getattr(nominal, kind)(i).name for i in range(count)]


def write_effect(
    nominal: mujoco.MjModel, effect: str, places: Sequence[str], spec: mujoco.MjSpec, parameter: sysid.Parameter
) -> None:
    """The effect's values after the base's; order of values as in NATIVE."""
    x = [float(v) for v in parameter.value]
    for place in places:
        if effect == "gravity_tilt":
            spec.option.gravity = _tilted(nominal.opt.gravity, *x)
        elif effect == "payload":
            load = spec.body(f"{place}.payload")
            load.mass, load.pos = x[0] + 1e-9, nominal.body(place).ipos + x[1:]
        elif effect.startswith("actuator"):
            _write_actuator(nominal.actuator(place), effect, spec.actuator(place), x[0])
        else:
            _write_joint(effect, spec.joint(place), x)


def _write_joint(effect: str, joint: mujoco.MjsJoint, x: Sequence[float]) -> None:
    if effect == "armature":
        joint.armature += x[0]  # on what the base has just written
    elif effect == "viscous_friction":
        joint.damping[0] += x[0]
    elif effect == "quadratic_drag":
        joint.damping[1] = x[0]  # F = -(d0 + d1 |w| + ...) w
    elif effect == "coulomb_friction":
        joint.frictionloss = x[0]
    else:
        joint.stiffness[0], joint.springref = x


def _write_actuator(nominal: Any, effect: str, actuator: mujoco.MjsActuator, x: float) -> None:
    if effect == "actuator_gain":
        actuator.gainprm, actuator.biasprm = x * nominal.gainprm, x * nominal.biasprm
    elif effect == "actuator_bias":
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.biasprm[0] = nominal.biasprm[0] + x
    else:
        actuator.forcelimited = x > 0
        actuator.forcerange = np.array([-1.0, 1.0]) / max(x, 1e-9)


def _tilted(gravity: np.ndarray, roll: float, pitch: float) -> np.ndarray:
    """Rx(roll)^T Ry(pitch)^T g."""
    c, s = np.cos(pitch), np.sin(pitch)
    g = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) @ gravity
    c, s = np.cos(roll), np.sin(roll)
    return np.array([[1, 0, 0], [0, c, s], [0, -s, c]]) @ g
