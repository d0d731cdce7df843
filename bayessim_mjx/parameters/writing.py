"""theta -> `mjx.Model`: a pure JAX function; changes only the fields concerned, relative to the model it is given."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import attributes, constants, geometry
from bayessim_mjx.parameters.attributes import FIELDS, Field
from bayessim_mjx.parameters.draft import Draft, follow_geoms
from bayessim_mjx.parameters.parameter import Parameter

if TYPE_CHECKING:
    from mujoco import mjx

MIN_RATIO = 0.05  # damping ratio of contacts at restitution 1: undamped contacts never settle


def write(parameters: Sequence[Parameter], model: "mjx.Model", theta: Any, derived: bool = True) -> "mjx.Model":
    """See `ParameterSpace.write`."""
    theta = jnp.asarray(theta, jnp.float32)
    if theta.shape != (len(parameters),):
        raise UserError(f"theta has shape {theta.shape}, the space {len(parameters)} parameters; write many under vmap")
    physical = tuple((i, _with_axis(p, model)) for i, p in enumerate(parameters) if p.kind != "effect")
    return model.tree_replace(_changes(physical, derived, model, theta)) if physical else model


@functools.partial(jax.jit, static_argnums=(0, 1))  # compiled once also when called op by op
def _changes(
    physical: tuple[tuple[int, Parameter], ...], derived: bool, model: "mjx.Model", theta: jax.Array
) -> dict[str, jax.Array]:
    """Compute the leaves that differ from `model`'s, by dotted name."""
    draft = Draft(model)
    for (kind, attribute), members in _groups(physical).items():
        parameters = [p for _, p in members]
        values = theta[np.asarray([i for i, _ in members])]
        field = FIELDS.get((kind, attribute))
        if field is not None:
            _write_field(draft, field, parameters, values)
        else:
            _COMPOSITE[kind, attribute](draft, parameters, values)
    follow_geoms(draft)
    if draft.resized:
        draft.leaves.update(constants.bounds(model, draft["geom_size"], draft.resized))
    if not derived:
        return draft.leaves
    changed = model.tree_replace(draft.leaves)
    return draft.leaves | constants.derived(changed, set(draft.leaves), reference=model)


def _with_axis(p: Parameter, model: "mjx.Model") -> Parameter:
    if (p.kind, p.attribute) != ("body", "length") or p.axis is not None:
        return p
    body = attributes.element(model, "body", p.target)
    return dataclasses.replace(p, axis=geometry.long_axis(model, body, p.name))


def _groups(physical: Sequence[tuple[int, Parameter]]) -> dict[tuple[str, str], list[tuple[int, Parameter]]]:
    """Parameters with their positions in theta by (kind, attribute), in the order in which they are applied."""
    groups: dict[tuple[str, str], list[tuple[int, Parameter]]] = {}
    for i, p in sorted(physical, key=lambda ip: (attributes.order(ip[1].attribute), ip[0])):
        if (p.kind, p.attribute) not in FIELDS and (p.kind, p.attribute) not in _COMPOSITE:
            known = sorted(f"{k} {a}" for k, a in [*FIELDS, *_COMPOSITE])
            raise UserError(
                f"parameter {p.name!r}: no {p.kind} {p.attribute!r} to write; there are: {', '.join(known)}"
            )
        groups.setdefault((p.kind, p.attribute), []).append((i, p))
    return groups


def _applied(parameter: Parameter, old: jax.Array, value: jax.Array, sign: float = 1.0) -> jax.Array:
    """Compute the number in the model under an operation: scaling, additive, absolute."""
    if parameter.operation == "scaling":
        return old * value
    step = sign * parameter.factor * value
    return old + step if parameter.operation == "additive" else jnp.broadcast_to(step, jnp.shape(old))


def _write_field(draft: Draft, field: Field, parameters: Sequence[Parameter], values: jax.Array) -> None:
    """One scatter per operation for all parameters of a field."""
    for operation in ("scaling", "additive", "absolute"):
        rows, picks, steps = [], [], []
        for j, p in enumerate(parameters):
            if p.operation != operation:
                continue
            element = attributes.element(draft.model, p.kind, p.target)
            if field.name == "body_ipos":
                attributes.refuse_simple(draft.model, element, p.name)
            for row in attributes.rows(draft.model, field, element):
                rows.append(row)
                picks.append(j)
                steps.append(1.0 if operation == "scaling" else field.sign * p.factor)
        if not rows:
            continue
        column = () if field.column is None else (field.column,)
        at: Any = draft[field.name].at[(np.asarray(rows), *column)]
        number = values[np.asarray(picks)] * np.asarray(steps, np.float32)
        draft[field.name] = getattr(at, {"scaling": "multiply", "additive": "add", "absolute": "set"}[operation])(
            number
        )


def _ratios(draft: Draft, field: str, ids: np.ndarray, parameters: Sequence[Parameter], values: jax.Array) -> jax.Array:
    """Compute new / old of a field for each parameter, `[n]`."""
    ratios = []
    for j, (i, p) in enumerate(zip(ids, parameters, strict=True)):
        old = draft[field][i]
        old = old[0] if old.ndim else old
        ratios.append(values[j] if p.operation == "scaling" else _applied(p, old, values[j]) / old)
    return jnp.stack(ratios)


def _elements(draft: Draft, parameters: Sequence[Parameter]) -> np.ndarray:
    return np.asarray([attributes.element(draft.model, p.kind, p.target) for p in parameters])


def _mass(draft: Draft, parameters: Sequence[Parameter], values: jax.Array) -> None:
    """Mass, and the inertia in proportion."""
    ids = _elements(draft, parameters)
    ratios = _ratios(draft, "body_mass", ids, parameters, values)
    draft["body_mass"] = draft["body_mass"].at[ids].multiply(ratios)
    draft["body_inertia"] = draft["body_inertia"].at[ids].multiply(ratios[:, None])


def _inertia(draft: Draft, parameters: Sequence[Parameter], values: jax.Array) -> None:
    draft["body_inertia"] = draft["body_inertia"].at[_elements(draft, parameters)].multiply(values[:, None])


def _gain(draft: Draft, parameters: Sequence[Parameter], values: jax.Array, columns: tuple[int, ...] = (1, 2)) -> None:
    """Gain, and for servos the feedback terms alike (position kp and kv; `kp` leaves kv alone)."""
    ids = _elements(draft, parameters)
    ratios = _ratios(draft, "actuator_gainprm", ids, parameters, values)
    draft["actuator_gainprm"] = draft["actuator_gainprm"].at[ids, 0].multiply(ratios)
    servo = np.asarray([attributes.has_affine_bias(draft.model, i) for i in ids])
    for column in columns if servo.any() else ():
        draft["actuator_biasprm"] = draft["actuator_biasprm"].at[ids[servo], column].multiply(ratios[servo])


def _kp(draft: Draft, parameters: Sequence[Parameter], values: jax.Array) -> None:
    _gain(draft, parameters, values, columns=(1,))


def _gravity(draft: Draft, parameters: Sequence[Parameter], values: jax.Array) -> None:
    """Scaling multiplies the vector; additive adds to, absolute sets its z component."""
    for p, value in zip(parameters, values, strict=True):
        g = draft["opt.gravity"]
        draft["opt.gravity"] = g * value if p.operation == "scaling" else g.at[2].set(_applied(p, g[2], value))


def _restitution(draft: Draft, parameters: Sequence[Parameter], values: jax.Array) -> None:
    """Damping ratio of the geom's contacts from the restitution e; e = 0 keeps the nominal contact.

    zeta = -ln e / sqrt(pi^2 + ln^2 e), the free oscillation that keeps the fraction e of its speed per half period.
    """
    ids = _elements(draft, parameters)
    solref = draft["geom_solref"][ids]
    e = values * np.asarray([p.factor for p in parameters], np.float32)
    log = jnp.log(jnp.clip(e, 1e-6, 1.0))
    zeta = jnp.maximum(-log / jnp.sqrt(np.pi**2 + log**2), MIN_RATIO)
    # direct format: solref = (-k, -b) with b = 2 zeta sqrt(k)
    direct = -2 * zeta * jnp.sqrt(jnp.maximum(-solref[:, 0], 0.0))
    new = jnp.where(e > 0, jnp.where(solref[:, 0] < 0, direct, zeta), solref[:, 1])
    draft["geom_solref"] = draft["geom_solref"].at[ids, 1].set(new)


def _length(draft: Draft, parameters: Sequence[Parameter], values: jax.Array) -> None:
    for p, s in zip(parameters, values, strict=True):
        body = attributes.element(draft.model, "body", p.target)
        _stretch(draft, body, np.asarray(p.axis, np.float32), s)


def _stretch(draft: Draft, body: int, axis: np.ndarray, s: jax.Array) -> None:
    """Stretch a body by s along a unit vector of its frame: its parts move, aligned geoms lengthen, mass stays."""
    model = draft.model
    geoms = np.flatnonzero(model.geom_bodyid == body)
    children = np.asarray([c for c in np.flatnonzero(model.body_parentid == body) if c != 0], int)
    moved = {
        "body_ipos": np.asarray([body]),
        "body_pos": children,
        "geom_pos": geoms,
        "jnt_pos": np.flatnonzero(model.jnt_bodyid == body),
        "site_pos": np.flatnonzero(model.site_bodyid == body),
    }
    for name, ids in moved.items():
        if len(ids):  # x + (s - 1) a (a . x)
            x = draft[name][ids]
            along = jnp.sum(x * axis, axis=-1, keepdims=True)
            draft[name] = draft[name].at[ids].set(x + (s - 1) * along * axis)
    _stretch_anchors(draft, [body], lambda x: x + (s - 1) * jnp.sum(x * axis, axis=-1, keepdims=True) * axis)
    for g in geoms:
        _lengthen(draft, int(g), axis, s)
    _stretch_inertia(draft, body, axis, s)


def _lengthen(draft: Draft, geom: int, axis: np.ndarray, s: jax.Array) -> None:
    """Lengthen the half extents of a geom whose axis lies along the stretch; a radius stays."""
    kind = int(draft.model.geom_type[geom])
    columns = {geometry.CAPSULE: {2: 1}, geometry.CYLINDER: {2: 1}}.get(kind, {0: 0, 1: 1, 2: 2})
    if kind in (geometry.SPHERE, int(mujoco.mjtGeom.mjGEOM_MESH)):
        return
    size = draft["geom_size"]
    frame = geometry.rotation(draft["geom_quat"][geom])
    for local, column in columns.items():
        aligned = jnp.abs(jnp.sum(frame[:, local] * axis)) > 0.999
        size = size.at[geom, column].multiply(jnp.where(aligned, s, 1.0))
    draft["geom_size"] = size
    draft.resized.add(geom)


def _stretch_inertia(draft: Draft, body: int, axis: np.ndarray, s: jax.Array) -> None:
    """Second moments P = tr(I)/2 1 - I grow by s^2 along the axis, which is a principal one (checked when read)."""
    inertia = draft["body_inertia"][body]
    along = jnp.argmax(jnp.abs(jnp.sum(geometry.rotation(draft["body_iquat"][body]) * axis[:, None], axis=0)))
    across = (along + np.array([1, 2])) % 3
    a, b, c = inertia[along], inertia[across[0]], inertia[across[1]]
    # I_b = P_c + P_a, P_a = (b + c - a) / 2, P_c = (a + (b - c)) / 2: no small differences of large numbers
    moment = s**2 * (b + c - a) / 2
    new = inertia.at[across].set(jnp.stack([(a + (b - c)) / 2 + moment, (a + (c - b)) / 2 + moment]))
    draft["body_inertia"] = draft["body_inertia"].at[body].set(jnp.where(s == 1, inertia, new))


def _scale(draft: Draft, parameters: Sequence[Parameter], values: jax.Array) -> None:
    """Lengths x s, masses x s^3, inertias x s^5 (constant density) of a whole actor; its own place in the world stays.

    Joint ranges, stiffness, damping, armature, gains and site sizes stay.
    """
    model = draft.model
    for p, s in zip(parameters, values, strict=True):
        root = attributes.actor_root(model, p.target)
        bodies = np.asarray(attributes.subtree(model, root))
        tops = {root} if root else {int(b) for b in bodies if model.body_parentid[b] == 0}
        geoms = np.flatnonzero(np.isin(model.geom_bodyid, bodies))
        scaled = {
            "body_pos": np.asarray([b for b in bodies if int(b) not in tops], int),
            "body_ipos": bodies,
            "geom_pos": geoms,
            "geom_size": geoms,
            "jnt_pos": np.flatnonzero(np.isin(model.jnt_bodyid, bodies)),
            "site_pos": np.flatnonzero(np.isin(model.site_bodyid, bodies)),
        }
        for name, ids in scaled.items():
            if len(ids):
                draft[name] = draft[name].at[ids].multiply(s)
        draft["body_mass"] = draft["body_mass"].at[bodies].multiply(s**3)
        draft["body_inertia"] = draft["body_inertia"].at[bodies].multiply(s**5)
        draft.resized.update(int(g) for g in geoms)
        _stretch_anchors(draft, bodies.tolist(), functools.partial(jnp.multiply, s))


def _stretch_anchors(draft: Draft, bodies: Sequence[int], move: Callable[[jax.Array], jax.Array]) -> None:
    """Anchors of connect constraints move with their first body; the compiler derives the second one."""
    model = draft.model
    connect = (model.eq_type == int(mujoco.mjtEq.mjEQ_CONNECT)) & (model.eq_objtype == int(mujoco.mjtObj.mjOBJ_BODY))
    (ids,) = np.nonzero(connect & np.isin(model.eq_obj1id, bodies))
    if len(ids):
        draft["eq_data"] = draft["eq_data"].at[ids, :3].set(move(draft["eq_data"][ids, :3]))


_COMPOSITE: dict[tuple[str, str], Callable[[Draft, Sequence[Parameter], jax.Array], None]] = {
    ("geom", "restitution"): _restitution,
    ("actuator", "gain"): _gain,
    ("actuator", "kp"): _kp,
    ("body", "mass"): _mass,
    ("body", "inertia"): _inertia,
    ("body", "length"): _length,
    ("option", "gravity"): _gravity,
    ("actor", "scale"): _scale,
}
