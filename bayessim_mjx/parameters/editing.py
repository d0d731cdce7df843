"""theta -> MJCF: the same change as `writing.py` makes, in a copy of an `MjSpec`, from primary quantities in float64.

Wherever the compiler can derive a number (masses of geoms, inertias, bounds, inverse weights) it does; this makes
recompiling the edited spec an independent check of `write`. What the compiler froze from nominal ratios (`dampratio`,
automatic `springlength`, masses under `settotalmass` and its like) keeps its nominal number.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import mujoco
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import attributes, geometry
from bayessim_mjx.parameters.attributes import FIELDS, Field
from bayessim_mjx.parameters.parameter import Parameter
from bayessim_mjx.parameters.writing import MIN_RATIO

_FROM_GEOM_ALWAYS = int(mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE)
_FROM_GEOM_NEVER = int(mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE)


def edit(parameters: Sequence[Parameter], spec: mujoco.MjSpec, theta: np.ndarray) -> mujoco.MjSpec:
    """See `ParameterSpace.edit`.

    Raises:
        UserError: a body to be stretched has frames.
    """
    theta = np.asarray(theta, np.float64)
    spec = frozen(spec)
    nominal = spec.compile()
    physical = [(p, v) for p, v in zip(parameters, theta, strict=True) if p.kind != "effect"]
    pairs = _Pairs(nominal)
    for parameter, value in sorted(physical, key=lambda pv: attributes.order(pv[0].attribute)):
        if (parameter.kind, parameter.attribute) in FIELDS:
            _edit_field(spec, nominal, parameter, value, FIELDS[parameter.kind, parameter.attribute])
        else:
            _COMPOSITE[parameter.kind, parameter.attribute](spec, nominal, parameter, value)
    pairs.follow(spec)
    return spec


def frozen(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Return a copy in which what the compiler derives from masses and poses is written out: it keeps these numbers."""
    spec = spec.copy()
    nominal = spec.compile()
    for actuator in spec.actuators:
        if actuator.biasprm[2] > 0 and actuator.gainprm[0] == -actuator.biasprm[1]:
            actuator.biasprm[2] = nominal.actuator_biasprm[actuator.id, 2]
    for tendon in spec.tendons:
        if tendon.springlength[0] == tendon.springlength[1] == -1:
            tendon.springlength = nominal.tendon_lengthspring[tendon.id]
    _freeze_masses(spec, nominal)
    return spec


def _freeze_masses(spec: mujoco.MjSpec, nominal: mujoco.MjModel) -> None:
    """Where the compiler rescales or bounds masses: state them as it leaves them, and take its rules out."""
    compiler = spec.compiler
    if not (compiler.settotalmass > 0 or compiler.balanceinertia or compiler.boundmass or compiler.boundinertia):
        return
    for body in spec.bodies[1:]:
        if nominal.body_mass[body.id]:
            state(body, nominal)
    compiler.settotalmass, compiler.balanceinertia, compiler.boundmass, compiler.boundinertia = -1.0, False, 0.0, 0.0
    compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO


def _by_id(elements: Iterable[Any], i: int) -> Any:
    return next(e for e in elements if e.id == i)


def _element(spec: mujoco.MjSpec, nominal: mujoco.MjModel, p: Parameter) -> Any:
    i = attributes.element(nominal, p.kind, p.target)
    return _by_id(getattr(spec, {"body": "bodies"}.get(p.kind, f"{p.kind}s")), i)


def _applied(p: Parameter, old: float, value: float, sign: float = 1.0) -> float:
    step = sign * p.factor * value
    return {"scaling": old * value, "additive": old + step, "absolute": step}[p.operation]


def _edit_field(spec: mujoco.MjSpec, nominal: mujoco.MjModel, p: Parameter, value: float, field: Field) -> None:
    element = _element(spec, nominal, p)
    if field.spec == "ipos":
        explicit(spec, element)
    old = np.array(getattr(element, field.spec), np.float64)
    if old.ndim == 0:
        setattr(element, field.spec, _applied(p, float(old), value, field.sign))
        return
    column = field.column or 0  # joints' damping and stiffness are polynomials, the linear term first
    old[column] = _applied(p, old[column], value, field.sign)
    setattr(element, field.spec, old)


def _from_geoms(spec: mujoco.MjSpec, body: Any) -> bool:
    """Whether the compiler takes the body's inertia from its geoms."""
    mode = int(spec.compiler.inertiafromgeom)
    return mode == _FROM_GEOM_ALWAYS or (mode != _FROM_GEOM_NEVER and bool(np.isnan(body.ipos[0])))


def _mass(spec: mujoco.MjSpec, nominal: mujoco.MjModel, p: Parameter, value: float) -> None:
    body = _element(spec, nominal, p)
    old = nominal.body_mass[body.id]
    _multiply_mass(spec, body, _applied(p, old, value) / old)


def _multiply_mass(spec: mujoco.MjSpec, body: Any, ratio: float) -> None:
    if not _from_geoms(spec, body):
        body.mass *= ratio
        _multiply_inertia(body, ratio)
        return
    for geom in body.geoms:
        if np.isnan(geom.mass):
            geom.density *= ratio
        else:
            geom.mass *= ratio


def _multiply_inertia(body: Any, ratio: float) -> None:
    body.inertia = np.array(body.inertia) * ratio
    body.fullinertia = np.array(body.fullinertia) * ratio  # NaN where unused


def _inertia(spec: mujoco.MjSpec, nominal: mujoco.MjModel, p: Parameter, value: float) -> None:
    body = _element(spec, nominal, p)
    explicit(spec, body)
    _multiply_inertia(body, value)


def explicit(spec: mujoco.MjSpec, body: Any) -> None:
    """Give the body the inertial that the compiler finds for it now."""
    if not _from_geoms(spec, body) and np.isnan(body.fullinertia[0]):
        return
    model = spec.compile()
    if int(spec.compiler.inertiafromgeom) == _FROM_GEOM_ALWAYS:
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
        for other in spec.bodies:
            if len(other.geoms):
                other.explicitinertial, other.ipos = False, [np.nan, 0, 0]
    state(body, model)


def state(body: Any, model: mujoco.MjModel) -> None:
    """Give the body the inertial that it has in the compiled model."""
    body.explicitinertial = True
    body.mass, body.inertia = float(model.body_mass[body.id]), model.body_inertia[body.id]
    body.ipos, body.iquat = model.body_ipos[body.id], model.body_iquat[body.id]
    body.fullinertia = [np.nan, 0, 0, 0, 0, 0]
    body.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


def _gain(
    spec: mujoco.MjSpec, nominal: mujoco.MjModel, p: Parameter, value: float, columns: tuple[int, ...] = (1, 2)
) -> None:
    actuator = _element(spec, nominal, p)
    ratio = _applied(p, actuator.gainprm[0], value) / actuator.gainprm[0]
    actuator.gainprm[0] *= ratio
    if attributes.has_affine_bias(nominal, actuator.id):
        for column in columns:
            actuator.biasprm[column] *= ratio


def _kp(spec: mujoco.MjSpec, nominal: mujoco.MjModel, p: Parameter, value: float) -> None:
    _gain(spec, nominal, p, value, columns=(1,))


def _gravity(spec: mujoco.MjSpec, nominal: mujoco.MjModel, p: Parameter, value: float) -> None:
    gravity = np.array(spec.option.gravity)
    if p.operation == "scaling":
        gravity *= value
    else:
        gravity[2] = _applied(p, gravity[2], value)
    spec.option.gravity = gravity


def _restitution(spec: mujoco.MjSpec, nominal: mujoco.MjModel, p: Parameter, value: float) -> None:
    geom, e = _element(spec, nominal, p), min(p.factor * value, 1.0)
    if e <= 0:
        return
    zeta = max(-np.log(e) / np.hypot(np.pi, np.log(e)), MIN_RATIO)
    k = geom.solref[0]
    geom.solref = [k, zeta if k > 0 else -2 * zeta * np.sqrt(-k)]


def _length(spec: mujoco.MjSpec, nominal: mujoco.MjModel, p: Parameter, value: float) -> None:
    """Stretch along the long axis a: x -> x + (s - 1) a (a.x), second moments along a times s^2."""
    body = _element(spec, nominal, p)
    axis = np.asarray(p.axis or geometry.long_axis(nominal, body.id, p.name))
    children = [b for b in spec.bodies if b.id and b.parent.id == body.id]
    parts = [*children, *body.geoms, *body.joints, *body.sites]
    if any(part.frame is not None for part in parts):
        raise UserError(f"{p.name}: body {body.name!r} has <frame>s; edit needs its parts in the body's own frame")
    explicit(spec, body)

    def move(x: np.ndarray) -> np.ndarray:
        return x + (value - 1) * axis * (axis @ x)

    for geom in body.geoms:
        _place_geom(geom, nominal, move, axis, value)
    for part in [*children, *body.joints]:
        part.pos = move(np.array(part.pos))
    for site in body.sites:
        site.pos, site.quat = move(nominal.site_pos[site.id]), nominal.site_quat[site.id]
        site.fromto = [np.nan] * 6
    body.ipos = move(np.array(body.ipos))
    # P = E[x x'] m in the inertial frame, diagonal
    principal = np.array(body.inertia)
    second = np.diag(principal.sum() / 2 - principal)
    a = geometry.rotation(np.array(body.iquat), np).T @ axis
    map_ = np.eye(3) + (value - 1) * np.outer(a, a)
    second = map_ @ second @ map_.T
    body.inertia = np.diag(np.trace(second) * np.eye(3) - second)
    _move_anchors(spec, {body.name}, move)


def _place_geom(geom: Any, nominal: mujoco.MjModel, move: Callable, axis: np.ndarray, s: float) -> None:
    size = np.array(nominal.geom_size[geom.id])
    frame = geometry.rotation(nominal.geom_quat[geom.id], np)
    aligned = abs(frame.T @ axis) > 0.999
    kind = int(nominal.geom_type[geom.id])
    if kind in (geometry.CAPSULE, geometry.CYLINDER):
        size[1] *= s if aligned[2] else 1.0
    elif kind != geometry.SPHERE:
        size[aligned] *= s
    geom.fromto = [np.nan] * 6
    geom.pos, geom.quat, geom.size = move(nominal.geom_pos[geom.id]), nominal.geom_quat[geom.id], size
    geom.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


def _scale(spec: mujoco.MjSpec, nominal: mujoco.MjModel, p: Parameter, value: float) -> None:
    """Lengths x s; the compiler finds the masses from densities; explicit masses x s^3, inertias x s^5."""
    root = attributes.actor_root(nominal, p.target)
    ids = set(attributes.subtree(nominal, root))
    tops = {root} if root else {b for b in ids if nominal.body_parentid[b] == 0}
    for body in [b for b in spec.bodies if b.id in ids]:
        if not _from_geoms(spec, body):
            body.mass *= value**3
            body.ipos = np.array(body.ipos) * value
            _multiply_inertia(body, value**5)
        if body.id not in tops:
            body.pos = np.array(body.pos) * value
        for part in [*body.joints, *body.frames]:
            part.pos = np.array(part.pos) * value
        for part in [*body.geoms, *body.sites]:
            part.pos, part.fromto = np.array(part.pos) * value, np.array(part.fromto) * value
        for geom in body.geoms:
            geom.size, geom.mass = np.array(geom.size) * value, geom.mass * value**3
    _move_anchors(spec, {b.name for b in spec.bodies if b.id in ids}, lambda x: x * value)


def _move_anchors(spec: mujoco.MjSpec, bodies: set[str], move: Callable[[np.ndarray], np.ndarray]) -> None:
    for equality in spec.equalities:
        connects = equality.type == mujoco.mjtEq.mjEQ_CONNECT and equality.objtype == mujoco.mjtObj.mjOBJ_BODY
        if connects and equality.name1 in bodies:
            data = np.array(equality.data)
            data[:3] = move(data[:3])
            equality.data = data


class _Pairs:
    """Explicit contact pairs whose numbers are what their geoms combine to: they follow the geoms."""

    def __init__(self, nominal: mujoco.MjModel) -> None:
        self.geoms = [(int(a), int(b)) for a, b in zip(nominal.pair_geom1, nominal.pair_geom2, strict=True)]
        self.friction, self.solref = [], []
        for i, pair in enumerate(self.geoms):
            friction, solref = _combined(nominal, pair, nominal.geom_friction, nominal.geom_solref)
            self.friction.append(bool(np.allclose(nominal.pair_friction[i, :2], friction, rtol=1e-6, atol=0)))
            self.solref.append(bool(np.allclose(nominal.pair_solref[i], solref, rtol=1e-6, atol=0)))
        self.nominal = nominal

    def follow(self, spec: mujoco.MjSpec) -> None:
        frictions = {g.id: np.array(g.friction) for g in spec.geoms}
        solrefs = {g.id: np.array(g.solref) for g in spec.geoms}
        for pair in spec.pairs:
            friction, solref = _combined(self.nominal, self.geoms[pair.id], frictions, solrefs)
            if self.friction[pair.id]:
                pair.friction[:2] = friction
            if self.solref[pair.id]:
                pair.solref = solref


def _combined(model: mujoco.MjModel, pair: tuple[int, int], friction: Any, solref: Any) -> tuple[float, np.ndarray]:
    """Sliding friction and solref of a contact between two geoms (mj_contactParam)."""
    a, b = pair
    rank = int(model.geom_priority[a]) - int(model.geom_priority[b])
    if rank:
        winner = a if rank > 0 else b
        return friction[winner][0], np.array(solref[winner])
    one, two, small = model.geom_solmix[a], model.geom_solmix[b], mujoco.mjMINVAL
    mix = one / (one + two) if min(one, two) >= small else 0.5 if max(one, two) < small else float(one >= small)
    x, y = np.array(solref[a]), np.array(solref[b])
    both = mix * x + (1 - mix) * y if x[0] > 0 and y[0] > 0 else np.minimum(x, y)
    return max(friction[a][0], friction[b][0]), both


_COMPOSITE: dict[tuple[str, str], Callable[[mujoco.MjSpec, mujoco.MjModel, Parameter, float], None]] = {
    ("geom", "restitution"): _restitution,
    ("actuator", "gain"): _gain,
    ("actuator", "kp"): _kp,
    ("body", "mass"): _mass,
    ("body", "inertia"): _inertia,
    ("body", "length"): _length,
    ("option", "gravity"): _gravity,
    ("actor", "scale"): _scale,
}
