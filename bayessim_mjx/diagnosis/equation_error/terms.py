"""Known parameters and effects as terms of the effort: those of the library that are (nearly) linear in it."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx import effects as library
from bayessim_mjx.diagnosis.data_sheet import ACCURACY
from bayessim_mjx.diagnosis.equation_error.fit import LEAST, Term
from bayessim_mjx.diagnosis.equation_error.sums import GAINS, Layout
from bayessim_mjx.diagnosis.logcheck import rigid_body
from bayessim_mjx.diagnosis.logcheck.drives import dof_of
from bayessim_mjx.diagnosis.logcheck.rigid_body import SHIFT
from bayessim_mjx.effects.support.actuators import OfGains
from bayessim_mjx.effects.support.site import element_names
from bayessim_mjx.parameters import geometry
from bayessim_mjx.physics import controllers

Array = NDArray[np.float64]
Reader = Callable[[Array], Mapping[str, float]]  # coefficients -> parameters of the effect


# Standard deviation of a gain's inverse: torque constants and current loops are known to a fifth, so that a gain of .4
# has to show more than rotor inertia that a model leaves out. A rule of thumb, not counted.
SURE = 0.2


def known(
    model: mujoco.MjModel, layout: Layout, accuracy: Mapping[tuple[str, str], float], period: float
) -> list[Term]:
    """Masses, rotor inertias, damping and friction as accurate as they are known; and how late efforts are, to a row.

    Args:
        accuracy: {(mass, armature, damping or friction; element): standard deviation as a share}; of others, a
            data sheet's.
        period: s between the logs' rows.
    """
    nominal = rigid_body.nominal(model)
    out = []
    for i, body in enumerate(rigid_body.moving_bodies(model)):
        column = np.zeros(layout.size)
        column[layout.body(i)] = nominal[i]
        if nominal[i, 0] > 0:
            name = element_names(model, "body")[body]
            sd = accuracy.get(("mass", name), ACCURACY)
            out.append(_term("mass", name, np.tile(column, (layout.nv, 1)), sd=sd))
    for effect, own, size in (
        ("armature", "acceleration", model.dof_armature),
        ("damping", "speed", model.dof_damping),
        ("friction", "dry", model.dof_frictionloss),
    ):
        for v in map(int, np.flatnonzero(size > 0)):
            sd = accuracy.get((effect, joint_of(model, v)), ACCURACY)
            out.append(_term(effect, joint_of(model, v), _map(layout, layout.at(own), v, float(size[v])), sd=sd))
    return [*out, _term("lateness", "all", _map(layout, layout.at("late")), sd=period)]


def effects(
    model: mujoco.MjModel,
    layout: Layout,
    source: Sequence[str],
    carried: Array,
    law: controllers.Law | None = None,
) -> list[Term]:
    """Effects of the library that may add to, or scale, what the known parameters say; those over all joints too.

    Args:
        source: `[nv]`, where efforts come from; carried: `[nbody]`, kg that may be on each body.
        law: controllers that the logs declare.
    """
    joints = [v for v in range(model.nv) if model.jnt_type[model.dof_jntid[v]] >= int(mujoco.mjtJoint.mjJNT_SLIDE)]
    driven = [
        (i, v) for i in range(model.nu) if (v := dof_of(model, i)) is not None and source[v] in ("ctrl", "effort")
    ]
    out: list[Term] = []
    for effect in map(library.load, library.names()):
        if not effect.effort:
            continue
        each, read = [_map(layout, layout.at(effect.effort), v) for v in joints], _reader(effect.quantities[0].name)
        out += [_term(effect.name, joint_of(model, v), m, read, low=0) for v, m in zip(joints, each, strict=True)]
        out += [_term(effect.name, "all", np.sum(each, 0), read, low=0)] if len(joints) > 1 else []
    for v in joints:
        name = joint_of(model, v)
        load = np.stack([_map(layout, layout.at(n), v) for n in ("effort_load", "load")], -1)
        out.append(_term("load_friction", name, load, _reader("motor", "external"), low=0.0, high=1.0))
        spring = np.stack([_map(layout, layout.at(n), v) for n in ("position", "one")], -1)
        out.append(_term("joint_spring", name, spring, _spring, low=np.array([0.0, -np.inf])))
        if np.any(model.jnt_type == 3):
            zero, read = _map(layout, layout.at("zero") + v), _reader("offset", sign=-1.0)
            out.append(_term("joint_offset", name, zero, read, sd=_askew("joint_offset")))
    out += _on_actuators(model, layout, driven, source, law)
    tilt = np.stack([_map(layout, c) for c in (layout.at("tilt"), layout.at("tilt") + 1)], -1)
    if np.any(model.opt.gravity):
        out.append(_term("gravity_tilt", "world", tilt, _reader("roll", "pitch"), sd=_askew("gravity_tilt")))
    return [*out, *payloads(model, layout, carried), *links(model, layout)]


def _on_actuators(
    model: mujoco.MjModel,
    layout: Layout,
    driven: Sequence[tuple[int, int]],
    source: Sequence[str],
    law: controllers.Law | None,
) -> list[Term]:
    out, title = [], element_names(model, "actuator")
    for i, v in driven:
        beside = [_map(layout, layout.drive(j), v) for j, w in driven if w == v and j != i]
        rest = np.sum(beside, axis=0) if beside else None
        out.append(scale("actuator_gain", title[i], np.arange(layout.nv) == v, SURE, rest))
        gear = float(model.actuator_gear[i, 0]) or 1.0
        out.append(_term("actuator_bias", title[i], _map(layout, layout.at("one"), v), _reader("bias", sign=-1 / gear)))
    dof = {i: v for i, v in driven if source[v] == "ctrl"}
    for name, i in layout.gains:
        if i in dof:
            own: Any = library.load(name)
            known = own.modelled(model, [i]) if issubclass(own, OfGains) else own.declared(law, [i])
            out.append(_gain(name, title[i], layout, layout.gain(name, i), dof[i], known))
    if len(driven) > 1:
        on = np.isin(np.arange(layout.nv), [v for _, v in driven])
        out.append(scale("actuator_gain", "all", on, SURE))
    return out


def _gain(effect: str, where: str, layout: Layout, first: int, dof: int, modelled: Mapping[str, float]) -> Term:
    """Return a servo with another gain: what it gives less than the model is what the mechanism needs more.

    Its coefficient is the gain's multiple less 1. A force limit bends the effort, which is the coefficient times the
    secant from the model's gain, interpolated between GAINS.
    """
    logs, low = np.log(GAINS), library.load(effect).quantities[0].low - 1.0

    def bent(c: Array) -> Array:
        at = float(np.interp(math.log(max(1.0 + float(c[0]), GAINS[0])), logs, np.arange(len(logs))))
        out = np.zeros((layout.nv, layout.size))
        out[dof, first : first + len(logs)] = -c[0] * np.maximum(0.0, 1.0 - np.abs(at - np.arange(len(logs))))
        return out

    def shape(c: Array) -> Array:
        return np.asarray((bent(c + SHIFT) - bent(c - SHIFT))[:, :, None] / (2 * SHIFT))

    read: Reader = lambda c: {"factor": 1.0 + float(c[0])}  # noqa: E731
    return Term(effect, where, shape, low=np.array([low]), read=read, bent=bent, modelled=modelled)


def scale(effect: str, where: str, on: NDArray[np.bool_], sd: float = np.inf, rest: Array | None = None) -> Term:
    """Scale the effort that was logged by `gain`, so the logged one is the needed one over `gain`.

    Args:
        sd: of 1 / gain about 1, as far as that is known beforehand.
        rest: `[nv, P]`, the effort of other drives at the same joint, which acts as it was logged; None: there is none.
    """
    read: Callable[[Array], Mapping[str, float]] = lambda c: {"gain": 1.0 / float(c[0])}  # noqa: E731
    believed, least = np.array([sd]), np.array([LEAST])
    return Term(effect, where, None, scaled=on, sd=lambda c: believed, low=least, read=read, rest=rest)


def _askew(effect: str) -> float:
    """Return standard deviation of an angle [rad] whose usual range is two of them either way."""
    return library.load(effect).quantities[0].high / 2


def payloads(model: mujoco.MjModel, layout: Layout, carried: Array) -> list[Term]:
    """Return a point mass on each body: its mass, and that times its place from the body's own centre of mass."""
    out = []
    for body, base, centre, turn, _ in _placed(model):
        bare = model.body_weldid[body] != body and model.body_mass[body] <= 0
        if carried[body] <= 0 or bare:
            continue
        reach = geometry.reach(model, body)
        most = float(carried[body])
        shape = _load(layout, base, centre, turn)
        low, high = np.array([0.0, *(3 * [-np.inf])]), np.array([most, *(3 * [np.inf])])
        name = element_names(model, "body")[body]
        sd, within = _spread(most, reach), _within(reach)
        out.append(Term("payload", name, shape, 4, sd=sd, low=low, high=high, within=within, read=_payload))
    return out


def links(model: mujoco.MjModel, layout: Layout) -> list[Term]:
    """Return the centre of mass of each body, and the inertia about it, as accurate as data sheets are (effects)."""
    out, none = [], np.zeros((3, 3))
    *places, inertia = library.load("inertial_parameters").quantities
    for body, base, centre, turn, axes in _placed(model):
        mass = float(model.body_mass[body])
        if mass <= 0:
            continue
        shape, own = np.zeros((layout.nv, layout.size, 4)), layout.body(base)
        for k, axis in enumerate(turn.T):
            ends = [rigid_body.inertial(mass, centre + sign * axis, none) for sign in (1, -1)]
            shape[:, own, k] = (ends[0] - ends[1]) / 2  # exact: it is quadratic
        shape[:, own, 3] = rigid_body.inertial(0.0, centre, axes @ np.diag(model.body_inertia[body]) @ axes.T)
        sd = np.array([*(q.deviation * geometry.body_size(model, body) for q in places), inertia.deviation])
        name = element_names(model, "body")[body]
        out.append(_term("inertial_parameters", name, shape, _link, sd=sd))
    return out


def _placed(model: mujoco.MjModel) -> Iterator[tuple[int, int, Array, Array, Array]]:
    """All bodies that move: (body, number of the moving body it is or is welded to, centre, axes, axes of inertia).

    Its centre of mass `[3]` and both axes `[3, 3]` are in the axes of that moving body, from its origin.
    """
    bodies, data = rigid_body.moving_bodies(model), mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    for body in range(1, model.nbody):
        base = int(model.body_weldid[body])
        if base:
            frame = data.xmat[base].reshape(3, 3).T
            turn, axes = (frame @ x[body].reshape(3, 3) for x in (data.xmat, data.ximat))
            yield body, bodies.index(base), frame @ (data.xipos[body] - data.xpos[base]), turn, axes


def _link(c: Array) -> Mapping[str, float]:
    return {**{f"com_{a}": float(x) for a, x in zip("xyz", c[:3], strict=True)}, "inertia": 1.0 + float(c[3])}


def _load(layout: Layout, body: int, centre: Array, turn: Array) -> Callable[[Array], Array]:
    """Map (mass m, mass times place s in the body's own axes) to `[nv, P, 4]`, linear near the last round's place.

    Inertial parameters of a point mass grow with (m, s) as a whole, so they are their own first order (Euler).
    """
    steps = np.eye(3)

    def point(place: Array) -> Array:
        return rigid_body.inertial(1.0, centre + turn @ place, np.zeros((3, 3)))

    def shape(last: Array) -> Array:
        place = _place(last)
        slopes = np.stack([(point(place + d) - point(place - d)) / 2 for d in steps], -1)  # exact: it is quadratic
        out = np.zeros((layout.nv, layout.size, 4))
        out[:, layout.load(body), 0] = point(place) - slopes @ place
        out[:, layout.load(body), 1:] = slopes
        return out

    return shape


def _place(c: Array) -> Array:
    """m, `[3]` from the body's centre of mass."""
    return c[1:] / c[0] if c[0] > 0 else np.zeros(3)


def _spread(most: float, reach: float) -> Callable[[Array], Array]:
    """Keep a load's place near the body's own centre where the logs do not show it."""

    def sd(last: Array) -> Array:
        mass = last[0] if last[0] > 0 else most
        return np.array([np.inf, *(3 * [max(mass, 1e-3 * most) * reach / 2])])

    return sd


def _within(reach: float) -> Callable[[Array], bool]:
    return lambda c: bool(np.all(np.abs(_place(c)) <= reach))


def _payload(c: Array) -> Mapping[str, float]:
    return {"mass": float(c[0]), **{f"com_{a}": float(x) for a, x in zip("xyz", _place(c), strict=True)}}


def _spring(c: Array) -> Mapping[str, float]:
    k = max(float(c[0]), 1e-12)
    return {"stiffness": k, "cubic": 0.0, "rest": -float(c[1]) / k}


def _reader(*parameters: str, sign: float = 1.0) -> Reader:
    return lambda c: {n: sign * float(x) for n, x in zip(parameters, c, strict=True)}


def joint_of(model: mujoco.MjModel, dof: int) -> str:
    """Name of the joint that has this column of qvel."""
    return element_names(model, "joint")[model.dof_jntid[dof]]


def _map(layout: Layout, column: int, dof: int | slice = slice(None), size: float = 1.0) -> Array:
    """`[nv, P]`, one column, at one dof or at all."""
    out = np.zeros((layout.nv, layout.size))
    out[dof, column] = size
    return out


def _term(
    effect: str,
    where: str,
    maps: Array,
    read: Reader = lambda c: {},
    low: float | Array = -np.inf,
    high: float = np.inf,
    sd: float | Array = np.inf,
) -> Term:
    """Return a term of one map `[nv, P]` or several `[nv, P, k]`, each with a coefficient."""
    maps = maps.reshape(*maps.shape[:2], -1)
    k = maps.shape[-1]
    least, most, believed = (np.broadcast_to(x, k).astype(float) for x in (low, high, sd))
    return Term(effect, where, lambda c: maps, k, sd=lambda c: believed, low=least, high=most, read=read)
