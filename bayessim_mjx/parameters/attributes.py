"""What each attribute stands for in MuJoCo: field, column and unit; and how elements are found by name."""

import dataclasses
import difflib
from typing import Any

import mujoco
import numpy as np

from bayessim_mjx.errors import UserError

Obj = mujoco.mjtObj
OBJECTS = {
    "body": Obj.mjOBJ_BODY,
    "geom": Obj.mjOBJ_GEOM,
    "joint": Obj.mjOBJ_JOINT,
    "actuator": Obj.mjOBJ_ACTUATOR,
    "tendon": Obj.mjOBJ_TENDON,
}


@dataclasses.dataclass(frozen=True)
class Field:
    """A field of the model that an attribute writes on its own.

    Attributes:
        name: dotted name of the leaf in `mjx.Model`.
        column: column of the leaf, None if it has one number per element.
        unit: of the number.
        per_dof: the leaf is indexed by degree of freedom, not by joint.
        sign: sign with which the number stands in the leaf.
        spec: name of the attribute in `MjSpec`.
    """

    name: str
    column: int | None = None
    unit: str = ""
    per_dof: bool = False
    sign: float = 1.0
    spec: str = ""


# attributes that write one number; the composite ones (mass, inertia, length, scale, restitution, gain, kp, gravity)
# are spelled out in writing.py and editing.py
FIELDS: dict[tuple[str, str], Field] = {
    ("geom", "friction"): Field("geom_friction", 0, spec="friction"),
    ("joint", "stiffness"): Field("jnt_stiffness", unit="N m/rad", spec="stiffness"),
    ("joint", "damping"): Field("dof_damping", unit="N m s/rad", per_dof=True, spec="damping"),
    ("joint", "armature"): Field("dof_armature", unit="kg m^2", per_dof=True, spec="armature"),
    ("joint", "friction"): Field("dof_frictionloss", unit="N m", per_dof=True, spec="frictionloss"),
    ("tendon", "stiffness"): Field("tendon_stiffness", unit="N/m", spec="stiffness"),
    ("tendon", "damping"): Field("tendon_damping", unit="N s/m", spec="damping"),
    ("tendon", "friction"): Field("tendon_frictionloss", unit="N", spec="frictionloss"),
    ("actuator", "bias"): Field("actuator_biasprm", 0, spec="biasprm"),
    ("actuator", "kv"): Field("actuator_biasprm", 2, sign=-1.0, spec="biasprm"),
    ("body", "com_x"): Field("body_ipos", 0, unit="m", spec="ipos"),
    ("body", "com_y"): Field("body_ipos", 1, unit="m", spec="ipos"),
    ("body", "com_z"): Field("body_ipos", 2, unit="m", spec="ipos"),
}
COMPOSITE: dict[tuple[str, str], str] = {
    ("geom", "restitution"): "",
    ("actuator", "gain"): "",
    ("actuator", "kp"): "",
    ("body", "mass"): "kg",
    ("body", "inertia"): "kg m^2",
    ("body", "length"): "m",
    ("option", "gravity"): "m/s^2",
    ("actor", "scale"): "",
}
# numbers first, then what moves or multiplies whole bodies: write and edit apply parameters in this order
ORDER = {"mass": 1, "inertia": 2, "length": 4, "scale": 5}


def order(attribute: str) -> int:
    """Rank in which an attribute is applied; equal ranks keep the order of the space."""
    return ORDER.get(attribute, 3 if attribute.startswith("com_") else 0)


def names(model: Any, kind: str) -> list[str]:
    """Names of all elements of a kind in an `MjModel` or `mjx.Model`, in id order; "#<id>" for unnamed ones."""
    prefix = {"joint": "jnt"}.get(kind, kind)
    text, addresses = bytes(model.names), np.asarray(getattr(model, f"name_{prefix}adr"))
    plain = [text[a : text.index(b"\0", a)].decode() for a in addresses]
    return [name or f"#{i}" for i, name in enumerate(plain)]


def element(model: Any, kind: str, target: str) -> int:
    """Id of the element called `target` ("#<id>" also for named ones); UserError naming what exists."""
    have = names(model, kind)
    if target in have:
        return have.index(target)
    if target.startswith("#") and target[1:].isdecimal() and int(target[1:]) < len(have):
        return int(target[1:])
    raise UserError(f"no {kind} {target!r} in the model; {suggest(target, have)}")


def suggest(word: str, have: Any) -> str:
    """Suggest what the user may have meant."""
    have = list(have)
    close = difflib.get_close_matches(str(word), have, 3)
    return f"did you mean {', '.join(close)}?" if close else f"there are: {', '.join(have) or 'none'}"


def rows(model: Any, field: Field, target: int) -> list[int]:
    """Rows of the leaf that belong to the element: itself, or all degrees of freedom of the joint."""
    if not field.per_dof:
        return [target]
    start = int(model.jnt_dofadr[target])
    return list(range(start, start + {0: 6, 1: 3}.get(int(model.jnt_type[target]), 1)))


def subtree(model: Any, root: int) -> list[int]:
    """Ids of the bodies from `root` downwards, in id order; root 0 means all bodies but the world."""
    inside = {root}
    for i in range(1, len(model.body_parentid)):
        if int(model.body_parentid[i]) in inside:
            inside.add(i)
    return sorted(inside - {0})


def actor_root(model: Any, target: str) -> int:
    """Body at the root of an actor: the body of that name, else the world (the whole model)."""
    have = names(model, "body")
    return have.index(target) if target in have else 0


def refuse_simple(model: Any, body: int, label: str) -> None:
    """UserError for a body whose mass matrix MuJoCo compiled as diagonal: its centre of mass must stay at its frame."""
    if int(model.body_simple[body]):
        raise UserError(
            f"{label}: body {names(model, 'body')[body]} is compiled as 'simple' (diagonal inertia), so its centre of "
            f"mass cannot move; exclude it, or give the body a child or an offset inertial"
        )


def has_affine_bias(model: Any, actuator: int) -> bool:
    """Whether the actuator is a servo (bias linear in length and velocity)."""
    return int(model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
