"""Known parameters and effects as terms of the effort: those of the library that are (nearly) linear in it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx import effects as library
from bayessim_mjx.diagnosis.data_sheet import ACCURACY
from bayessim_mjx.diagnosis.equation_error.fit import Term
from bayessim_mjx.diagnosis.equation_error.sums import Layout
from bayessim_mjx.diagnosis.logcheck import drives, rigid_body
from bayessim_mjx.diagnosis.logcheck.drives import dof_of
from bayessim_mjx.diagnosis.logcheck.regressor import TILT
from bayessim_mjx.effects.support.site import element_names

Array = NDArray[np.float64]
Reader = Callable[[Array], Mapping[str, float]]  # coefficients -> parameters of the effect


@dataclass(frozen=True)
class Ranges:
    """What is taken for possible, and how well drives and mountings are known before anything is logged.

    Torque constants and current loops to a fifth, zeros of joints and the upright of a base to three degrees (rules
    of thumb): a gain of .4 or a zero that is 7 degrees off has to show more than rotor inertia that a model leaves out.
    """

    gain: tuple[float, float] = (0.2, 3.0)
    sure: float = 0.2  # standard deviation of a gain's inverse
    zero: float = 0.05  # rad, standard deviation of a joint's zero and of a base's tilt
    share: float = 1.0  # of the load that dry friction may be
    late: float = 3.0  # periods: standard deviation of how late efforts are


RANGES = Ranges()


def known(
    model: mujoco.MjModel, layout: Layout, accuracy: Mapping[tuple[str, str], float], period: float
) -> list[Term]:
    """Masses, rotor inertias, damping and friction as accurate as they are known; and how late efforts are.

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
            out.append(_fixed("mass", name, np.tile(column, (layout.nv, 1)), sd=sd))
    for effect, own, size in (
        ("armature", "acceleration", model.dof_armature),
        ("damping", "speed", model.dof_damping),
        ("friction", "dry", model.dof_frictionloss),
    ):
        for v in map(int, np.flatnonzero(size > 0)):
            one = _one(layout, v, layout.own(own), float(size[v]))
            sd = accuracy.get((effect, joint_of(model, v)), ACCURACY)
            out.append(_fixed(effect, joint_of(model, v), one, sd=sd))
    late = np.zeros((layout.nv, layout.size))
    late[:, layout.late] = 1.0
    return [*out, _fixed("lateness", "all", late, sd=RANGES.late * period)]


def effects(model: mujoco.MjModel, layout: Layout, source: Sequence[str], carried: Array) -> list[Term]:
    """Effects of the library that may add to, or scale, what the known parameters say; those over all joints too.

    Args:
        source: `[nv]`, where efforts come from; carried: `[nbody]`, kg that may be on each body.
    """
    joints = [v for v in range(model.nv) if model.jnt_type[model.dof_jntid[v]] >= int(mujoco.mjtJoint.mjJNT_SLIDE)]
    driven = [
        (i, v) for i in range(model.nu) if (v := dof_of(model, i)) is not None and source[v] in ("ctrl", "effort")
    ]
    out: list[Term] = []
    for effect in map(library.load, library.names()):
        if not effect.effort:
            continue
        each, read = [_one(layout, v, layout.own(effect.effort)) for v in joints], _reader(effect.quantities[0].name)
        out += [_fixed(effect.name, joint_of(model, v), m, low=0, read=read) for v, m in zip(joints, each, strict=True)]
        out += [_fixed(effect.name, "all", np.sum(each, 0), low=0, read=read)] if len(joints) > 1 else []
    for v in joints:
        load = np.stack([_one(layout, v, layout.own(n)) for n in ("effort_load", "load")], -1)
        out.append(_wide("load_friction", joint_of(model, v), load, 0.0, RANGES.share, _reader("motor", "external")))
        spring = np.stack([_one(layout, v, layout.own(n)) for n in ("position", "one")], -1)
        bounds = np.array([0.0, -np.inf]), np.inf
        out.append(_wide("joint_spring", joint_of(model, v), spring, *bounds, _spring))
        if np.any(model.jnt_type == 3):
            zero = _everywhere(layout, layout.zero(v))
            read = _reader("offset", sign=-1.0)
            out.append(_fixed("joint_offset", joint_of(model, v), zero, sd=RANGES.zero, read=read))
    out += _on_actuators(model, layout, driven)
    tilt = np.stack([_everywhere(layout, c) for c in range(layout.tilt.start, layout.tilt.stop)], -1)
    if np.any(model.opt.gravity):
        ends = -TILT, TILT
        out.append(_wide("gravity_tilt", "world", tilt, *ends, _reader("roll", "pitch"), sd=RANGES.zero))
    return [*out, *payloads(model, layout, carried), *links(model, layout)]


def _on_actuators(model: mujoco.MjModel, layout: Layout, driven: Sequence[tuple[int, int]]) -> list[Term]:
    out, title = [], element_names(model, "actuator")
    for i, v in driven:
        beside = [_one(layout, v, layout.drive(j)) for j, w in driven if w == v and j != i]
        rest = np.sum(beside, axis=0) if beside else None
        out.append(scale("actuator_gain", title[i], np.arange(layout.nv) == v, RANGES.sure, rest))
        gear = float(model.actuator_gear[i, 0]) or 1.0
        bias = _one(layout, v, layout.own("one"))
        out.append(_fixed("actuator_bias", title[i], bias, read=_reader("bias", sign=-1.0 / gear)))
    if len(driven) > 1:
        on = np.isin(np.arange(layout.nv), [v for _, v in driven])
        out.append(scale("actuator_gain", "all", on, RANGES.sure))
    return out


def scale(effect: str, where: str, on: NDArray[np.bool_], sd: float = np.inf, rest: Array | None = None) -> Term:
    """The effort that was logged times `gain` is what acts, so the logged one is the needed one over `gain`.

    Args:
        sd: of 1 / gain about 1, as far as that is known beforehand.
        rest: `[nv, P]`, the effort of other drives at the same joint, which acts as it was logged; None: there is none.
    """
    low, high = 1.0 / RANGES.gain[1], 1.0 / RANGES.gain[0]
    read: Callable[[Array], Mapping[str, float]] = lambda c: {"gain": 1.0 / float(c[0])}  # noqa: E731
    believed, lowest, highest = np.array([sd]), np.array([low]), np.array([high])
    return Term(effect, where, None, scaled=on, sd=lambda c: believed, low=lowest, high=highest, read=read, rest=rest)


def payloads(model: mujoco.MjModel, layout: Layout, carried: Array) -> list[Term]:
    """A point mass on each body: its mass, and its mass times where it sits from the body's own centre of mass."""
    out = []
    for body, base, centre, turn, _ in _placed(model):
        bare = model.body_weldid[body] != body and model.body_mass[body] <= 0
        if carried[body] <= 0 or bare:
            continue
        reach = drives.reach(model, body)
        most = float(carried[body])
        shape = _load(layout, base, centre, turn)
        low, high = np.array([0.0, *(3 * [-np.inf])]), np.array([most, *(3 * [np.inf])])
        name = element_names(model, "body")[body]
        sd, within = _spread(most, reach), _within(reach)
        out.append(Term("payload", name, shape, 4, sd=sd, low=low, high=high, within=within, read=_payload))
    return out


def links(model: mujoco.MjModel, layout: Layout) -> list[Term]:
    """The centre of mass of each body, and the inertia about it, as accurate as data sheets are (effects)."""
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
        sd = np.array([*(q.deviation * drives.size(model, body) for q in places), inertia.deviation])
        name = element_names(model, "body")[body]
        out.append(_wide("inertial_parameters", name, shape, -np.inf, np.inf, _link, sd=sd))
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
    """Maps `[nv, P, 4]` of (mass m, mass times place s in the body's own axes), linear near the last round's place.

    Inertial parameters of a point mass grow with (m, s) as a whole, so they are their own first order (Euler).
    """
    steps = np.eye(3)

    def point(place: Array) -> Array:
        return rigid_body.inertial(1.0, centre + turn @ place, np.zeros((3, 3)))

    def shape(last: Array) -> Array:
        place = _place(last)
        slopes = np.stack([(point(place + d) - point(place - d)) / 2 for d in steps], -1)  # exact: it is quadratic
        out = np.zeros((layout.nv, layout.size, 4))
        out[:, layout.body(body), 0] = point(place) - slopes @ place
        out[:, layout.body(body), 1:] = slopes
        return out

    return shape


def _place(c: Array) -> Array:
    """m, `[3]` from the body's centre of mass."""
    return c[1:] / c[0] if np.isfinite(c).all() and c[0] > 0 else np.zeros(3)


def _spread(most: float, reach: float) -> Callable[[Array], Array]:
    """What the logs do not tell of a load's place stays near the body's own centre."""

    def sd(last: Array) -> Array:
        mass = last[0] if np.isfinite(last[0]) and last[0] > 0 else most
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


def _one(layout: Layout, dof: int, column: int, size: float = 1.0) -> Array:
    """`[nv, P]`, one column at one dof."""
    out = np.zeros((layout.nv, layout.size))
    out[dof, column] = size
    return out


def _everywhere(layout: Layout, column: int) -> Array:
    out = np.zeros((layout.nv, layout.size))
    out[:, column] = 1.0
    return out


def _fixed(
    effect: str, where: str, column: Array, low: float = -np.inf, sd: float = np.inf, read: Reader = lambda c: {}
) -> Term:
    """A term of one coefficient and one map `[nv, P]`."""
    return _wide(effect, where, column[:, :, None], low, np.inf, read, sd)


def _wide(
    effect: str,
    where: str,
    maps: Array,
    low: float | Array,
    high: float | Array,
    read: Reader,
    sd: float | Array = np.inf,
) -> Term:
    """A term of several coefficients and maps `[nv, P, k]`."""
    k = maps.shape[-1]
    least, most, believed = (np.broadcast_to(x, (k,)).astype(float) for x in (low, high, sd))
    return Term(effect, where, lambda c: maps, k, sd=lambda c: believed, low=least, high=most, read=read)
