"""The MuJoCo elements that an actor of a BayesSimIG section consists of, and how its parameters call them."""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import attributes
from bayessim_mjx.parameters.attributes import suggest

WHOLE = "robot"  # the whole model as an actor; with _ at its end where one of the bodies is called so


class Element(NamedTuple):
    """One element of a group: its name in the parameter, and the MuJoCo element it stands for."""

    label: str
    kind: str
    target: str


def of_actor(model: mujoco.MjModel, actor: str, others: Sequence[str], where: str) -> list[int]:
    """Bodies of an actor: the subtree of the body of that name, else the model without the subtrees of `others`.

    The model goes by its name in the MJCF, or as `robot`.
    """
    have = attributes.names(model, "body")
    if actor in have:
        return attributes.subtree(model, have.index(actor))
    whole = [model.names[: model.names.index(b"\0")].decode(), WHOLE]
    if actor.rstrip("_") not in whole:
        raise UserError(f"{where}: no actor {actor!r}; {suggest(actor, list(dict.fromkeys([*whole, *have[1:]])))}")
    taken = {b for other in others if other in have for b in attributes.subtree(model, have.index(other))}
    return [b for b in attributes.subtree(model, 0) if b not in taken]


def of_bodies(model: mujoco.MjModel, bodies: Sequence[int], kind: str) -> list[Element]:
    """Elements of a kind that belong to the bodies, in MuJoCo's order, but mocap bodies: their mass does nothing."""
    if kind == "option":
        return [Element("", "option", "option")]
    have = attributes.names(model, kind)
    if kind == "body":
        return [Element(_plain(have[b], "body"), kind, have[b]) for b in bodies if model.body_mocapid[b] < 0]
    if kind == "geom":
        return _shapes(model, bodies, have)
    ids = [i for i in range(len(have)) if _owners(model, kind, i) & set(bodies)]
    if kind == "joint":  # free joints are no dofs of an actor
        ids = [i for i in ids if model.jnt_type[i] != int(mujoco.mjtJoint.mjJNT_FREE)]
    return [Element(_plain(have[i], kind), kind, have[i]) for i in ids]


def _plain(name: str, kind: str) -> str:
    return f"{kind}{name[1:]}" if name.startswith("#") else name


def _shapes(model: mujoco.MjModel, bodies: Sequence[int], have: Sequence[str]) -> list[Element]:
    """Geoms, unnamed ones called like their body (further ones `_1`, `_2`); bodies without geoms as themselves."""
    body_names, shapes = attributes.names(model, "body"), []
    used = {name for name in have if not name.startswith("#")}
    for body in bodies:
        geoms = np.flatnonzero(model.geom_bodyid == body)
        base = _plain(body_names[body], "body")
        for g in geoms.tolist():
            label = _plain(have[g], "geom") if not have[g].startswith("#") else _free(base, used)
            used.add(label)
            shapes.append(Element(label, "geom", have[g]))
        if not len(geoms):
            shapes.append(Element(base, "body", body_names[body]))
    return shapes


def _free(base: str, used: set[str]) -> str:
    label, i = base, 0
    while label in used:
        i += 1
        label = f"{base}_{i}"
    return label


def _owners(model: mujoco.MjModel, kind: str, i: int) -> set[int]:
    """Bodies that an element belongs to."""
    if kind == "joint":
        return {int(model.jnt_bodyid[i])}
    if kind == "tendon":
        return _wrapped(model, i)
    obj = int(model.actuator_trnid[i, 0])
    transmission = mujoco.mjtTrn(int(model.actuator_trntype[i])).name
    if "TENDON" in transmission:
        return _wrapped(model, obj)
    owner = {"JOINT": model.jnt_bodyid, "SITE": model.site_bodyid, "SLIDER": model.site_bodyid}
    table = next((table for key, table in owner.items() if key in transmission), None)
    return {obj} if table is None else {int(table[obj])}


def _wrapped(model: mujoco.MjModel, tendon: int) -> set[int]:
    owner = {"JOINT": model.jnt_bodyid, "SITE": model.site_bodyid}
    start = int(model.tendon_adr[tendon])
    bodies = set()
    for w in range(start, start + int(model.tendon_num[tendon])):
        kind = mujoco.mjtWrap(int(model.wrap_type[w])).name[7:]
        if kind != "PULLEY":
            bodies.add(int(owner.get(kind, model.geom_bodyid)[int(model.wrap_objid[w])]))
    return bodies


def body_of(model: mujoco.MjModel, e: Element) -> str:
    """Name of the body that a body or geom element belongs to."""
    names = attributes.names(model, "body")
    return e.target if e.kind == "body" else names[int(model.geom_bodyid[attributes.element(model, "geom", e.target)])]
