"""Parameters from a `randomization_params` section in BayesSimIG's YAML format, mapped onto MuJoCo elements.

Order of the vector: actors in the file's order, then groups. In list groups (bodies, shapes, tendons, actuators) the
outer loop runs over elements, the inner over attributes; for dofs the other way round; `scale` is one number.
Names: `<element>_<attribute>`, plus `_mult` for scaling. `effects` groups are only found here: `effects/reading.py`
makes effects of them, whose parameters follow the model's.
"""

import dataclasses
import fnmatch
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import attributes, checks, elements, geometry
from bayessim_mjx.parameters.attributes import COMPOSITE, FIELDS, suggest
from bayessim_mjx.parameters.elements import Element
from bayessim_mjx.parameters.parameter import OPERATIONS, Parameter, Schedule

SECTION_KEYS = ("frequency", "observations", "actions", "sim_params", "actor_params", "option", "effects")
GROUPS: dict[str, tuple[str, tuple[str, ...]]] = {
    "rigid_body_properties": ("body", ("mass", "inertia", "length", "com_x", "com_y", "com_z")),
    "rigid_shape_properties": ("geom", ("friction", "restitution", "length")),
    "dof_properties": ("joint", ("stiffness", "damping", "armature", "friction")),
    "tendon_properties": ("tendon", ("stiffness", "damping", "friction")),
    "actuator_properties": ("actuator", ("gain", "kp", "kv", "bias")),
    "option": ("option", ("gravity",)),
}
PATH = "task.randomization_params"
OTHER_GROUPS = ("scale", "color", "effects")
ACCEPTED = ("schedule", "schedule_steps", "num_buckets", "setup_only")  # the last two mean nothing here: see foreign.py
SETTINGS = (
    "range", "operation", "distribution", "mean", "sd", "include", "exclude", "factor", "unit", "nominal", "zero",
)  # fmt: skip
EFFECT_SETTINGS = ("range", "operation", "distribution", "mean", "sd", "unit", "nominal")
DISTRIBUTIONS = {"uniform": "uniform", "loguniform": "loguniform", "log_uniform": "loguniform", "gaussian": "gaussian"}


def read(section: Mapping[str, Any], model: mujoco.MjModel) -> list[Parameter]:
    """Read the model's parameters of a section, in order; those of its effects are not among them.

    Args:
        section: `randomization_params`, or the `task` section that holds it.
        model: the nominal model.

    Raises:
        UserError: naming the key's path, its value and what is allowed.
    """
    section, actors = _open(section)
    found: list[Parameter] = []
    for actor, groups in actors.items():
        where = f"{PATH}.actor_params.{actor}"
        if actor == "option":
            found += _group(model, lambda _: (), "option", groups, where)
        elif actor != "effects":
            found += _actor(model, actor, {a: g for a, g in actors.items() if a not in ("effects", "option")}, where)
    found += _group(model, lambda _: (), "option", section.get("option") or {}, f"{PATH}.option")
    return found


def effect_groups(section: Mapping[str, Any]) -> Iterator[tuple[str, str, str, Mapping[str, Any]]]:
    """(path, effect, where, {parameter: settings}) of a section's `effects`, at its top or below `actor_params`."""
    section, actors = _open(section)
    groups = [(f"{PATH}.actor_params.{a}.effects", g["effects"]) for a, g in actors.items() if "effects" in g]
    groups += [(f"{PATH}.actor_params.effects", actors.get("effects")), (f"{PATH}.effects", section.get("effects"))]
    for path, group in groups:
        for effect, places in checks.mapping(group, path).items():
            for place, parameters in checks.mapping(places, f"{path}.{effect}").items():
                where = f"{path}.{effect}.{place}"
                yield where, str(effect), str(place), checks.mapping(parameters, where)


def effect_parameter(default: Parameter, setting: Any, where: str) -> Parameter:
    """Give an effect's parameter the range and prior of `setting`; nominal stays, or is the range's end next to it."""
    setting = checks.mapping(setting, where)
    checks.known(setting, (*EFFECT_SETTINGS, *ACCEPTED), where)
    checks.choice(setting, "operation", ("absolute",), "absolute", where)
    ranged: dict[str, Any] = {"range": (default.low, default.high), **setting}
    if "distribution" not in setting:
        ranged |= {"distribution": default.prior, "mean": setting.get("mean", default.mean)}
        ranged["sd"] = setting.get("sd", default.sd)
    same = ("unit", "operation", "attribute", "target", "kind", "factor", "axis")
    rest = {f.name: getattr(default, f.name) for f in dataclasses.fields(default) if f.name in same}
    rest["unit"] = str(setting.get("unit", default.unit))
    return _build(ranged, where, default.name, default.nominal, **rest)


def _open(section: Any) -> tuple[Mapping[str, Any], dict[str, Mapping[str, Any]]]:
    """Open a section as (the `randomization_params`, its actors); look at the keys that are not about parameters."""
    section = checks.mapping(section, PATH)
    if "randomization_params" in section:
        section = checks.mapping(section["randomization_params"], PATH)
    checks.known(section, SECTION_KEYS, PATH)
    actors = checks.mapping(section.get("actor_params"), f"{PATH}.actor_params")
    return section, {str(k): checks.mapping(v, f"{PATH}.actor_params.{k}") for k, v in actors.items()}


def _actor(
    model: mujoco.MjModel, actor: str, actors: Mapping[str, Mapping[str, Any]], where: str
) -> Iterator[Parameter]:
    """Parameters of one actor; the whole model has those that no actor of its own states for its bodies."""
    groups = actors[actor]
    checks.known(groups, (*GROUPS, *OTHER_GROUPS), where)
    elements.of_actor(model, actor, [], where)
    for group, content in groups.items():
        path = f"{where}.{group}"
        if group in ("color", "effects"):  # looks, not physics; not the model's
            continue
        if group == "scale":
            yield _scale(model, actor, list(actors), checks.mapping(content, path), path)
        else:
            bodies = functools.partial(_bodies, model, actor, actors, group)
            yield from _group(model, bodies, group, content or {}, path)


def _bodies(
    model: mujoco.MjModel, actor: str, actors: Mapping[str, Mapping[str, Any]], group: str, attribute: str
) -> list[int]:
    """Bodies of an actor without those of actors that state the attribute, or a scale, of their own."""
    others = [o for o, groups in actors.items() if "scale" in groups or attribute in (groups.get(group) or {})]
    return elements.of_actor(model, actor, others, f"{PATH}.actor_params.{actor}")


def _group(
    model: mujoco.MjModel, bodies: Callable[[str], Sequence[int]], group: str, content: Mapping[str, Any], where: str
) -> Iterator[Parameter]:
    """Parameters of one group, elements outside attributes, but for dofs attributes outside elements.

    bodies: attribute -> those that may take it.
    """
    kind, allowed = GROUPS[group]
    checks.known(content, allowed, where)
    content = {attribute: setting or {} for attribute, setting in content.items()}
    own = {a: elements.of_bodies(model, bodies(a), kind) for a in content}
    members = {a: _selected(model, own[a], kind, a, s, f"{where}.{a}") for a, s in content.items()}
    if kind == "joint":
        pairs = [(e, a) for a in content for e in members[a]]
    else:
        seen = list(dict.fromkeys(e for a in content for e in members[a]))
        every = [(e.kind, e.target) for e in elements.of_bodies(model, range(model.nbody), kind)]
        seen.sort(key=lambda e: every.index((e.kind, e.target)))
        pairs = [(e, a) for e in seen for a in content if e in members[a]]
    for e, a in pairs:
        yield _parameter(model, e, a, content[a], f"{where}.{a}")


def _selected(
    model: mujoco.MjModel,
    members: Sequence[Element],
    kind: str,
    attribute: str,
    setting: Mapping[str, Any],
    where: str,
) -> list[Element]:
    """Elements that carry the attribute, restricted by `include` and `exclude` (names or patterns with *)."""
    checks.known(setting, (*SETTINGS, *ACCEPTED), where)
    usable = [e for e in members if e.kind == kind or attribute == "length"]
    if kind == "geom" and attribute == "length":  # one length per body, called like its first shape
        usable = list({elements.body_of(model, e): e for e in reversed(usable)}.values())[::-1]
    labels = [e.label for e in usable]
    for key in ("include", "exclude"):
        patterns = setting.get(key)
        patterns = [patterns] if isinstance(patterns, str) else patterns or []
        if not (isinstance(patterns, Sequence) and all(isinstance(p, str) for p in patterns)):
            raise UserError(f"{where}.{key} = {patterns!r}: expected names or patterns with *; there are: {labels}")
        for pattern in patterns:
            if not fnmatch.filter(labels, pattern):
                raise UserError(f"{where}.{key}: no element {pattern!r} here; {suggest(pattern, labels)}")
        if patterns:
            wanted = key == "include"
            usable = [e for e in usable if any(fnmatch.fnmatchcase(e.label, p) for p in patterns) == wanted]
    if not usable:
        raise UserError(f"{where}: the actor has no {kind} that could take it")
    return usable


def _parameter(model: mujoco.MjModel, e: Element, attribute: str, setting: Mapping[str, Any], where: str) -> Parameter:
    operation = checks.choice(setting, "operation", OPERATIONS, "scaling", where)
    name = f"{e.label}_{attribute}".lstrip("_") + ("_mult" if operation == "scaling" else "")
    axis = None
    if attribute == "length":
        kind, target = "body", elements.body_of(model, e)
        axis = geometry.long_axis(model, attributes.element(model, "body", target), f"{where}, {e.label}")
    else:
        kind, target = e.kind, e.target
    kind, attribute, target = _driven(model, kind, attribute, target, operation)
    factor = checks.number(setting.get("factor", 1.0), f"{where}.factor")
    unit = "" if operation == "scaling" else str(setting.get("unit", _unit(model, kind, attribute, target)))
    default = own_value(model, kind, attribute, target)
    if operation == "scaling" and "zero" in setting and default == 0:
        operation, factor = "absolute", checks.number(setting["zero"], f"{where}.zero")
    place = f"{where}, {e.label or kind}"
    if attribute.startswith("com_"):
        attributes.refuse_simple(model, attributes.element(model, kind, target), place)
    _check_default(default, kind, attribute, operation, place)
    neutral = 1.0 if operation == "scaling" else 0.0  # theta at which the model stays as it is
    return _build(
        setting,
        where,
        name,
        default / factor if operation == "absolute" else neutral,
        unit=unit,
        operation=operation,
        attribute=attribute,
        target=target,
        kind=kind,
        factor=factor,
        axis=axis,
    )


def _driven(model: mujoco.MjModel, kind: str, attribute: str, target: str, operation: str) -> tuple[str, str, str]:
    """Scaling a dof's stiffness or damping where the joint has none means its drive's: the servo's kp or kv.

    Isaac Gym keeps the gains of position drives in the dof's stiffness and damping.
    """
    if kind != "joint" or operation != "scaling" or attribute not in ("stiffness", "damping"):
        return kind, attribute, target
    if own_value(model, kind, attribute, target) != 0:
        return kind, attribute, target
    joint = attributes.element(model, "joint", target)
    on_joint = (model.actuator_trnid[:, 0] == joint) & (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT))
    servos = [int(i) for i in np.flatnonzero(on_joint) if attributes.has_affine_bias(model, int(i))]
    drive = {"stiffness": "kp", "damping": "kv"}[attribute]
    if len(servos) != 1 or model.actuator_biasprm[servos[0], {"kp": 1, "kv": 2}[drive]] == 0:
        return kind, attribute, target
    return "actuator", drive, attributes.names(model, "actuator")[servos[0]]


def _build(setting: Mapping[str, Any], where: str, name: str, own: float, **rest: Any) -> Parameter:
    """Build a Parameter of the keys range, distribution, mean, sd, nominal (by default the model's value, clipped)."""
    low, high = checks.low_high(setting, where)
    distribution = checks.choice(setting, "distribution", tuple(DISTRIBUTIONS), "uniform", where)
    nominal = checks.number(setting.get("nominal", min(max(own, low), high)), f"{where}.nominal")
    rest["schedule"] = Schedule.read(setting, where)
    mean, sd = (None if setting.get(k) is None else checks.number(setting[k], f"{where}.{k}") for k in ("mean", "sd"))
    try:
        return Parameter(name, nominal, low, high, prior=DISTRIBUTIONS[distribution], mean=mean, sd=sd, **rest)
    except UserError as error:
        raise UserError(f"{where}: {error}") from None


def _unit(model: mujoco.MjModel, kind: str, attribute: str, target: str) -> str:
    unit = FIELDS[kind, attribute].unit if (kind, attribute) in FIELDS else COMPOSITE[kind, attribute]
    slide = int(mujoco.mjtJoint.mjJNT_SLIDE)
    if kind == "joint" and model.jnt_type[attributes.element(model, kind, target)] == slide:
        return {"N m/rad": "N/m", "N m s/rad": "N s/m", "kg m^2": "kg", "N m": "N"}[unit]
    return unit


def own_value(model: mujoco.MjModel, kind: str, attribute: str, target: str) -> float:
    """Return the model's own number; restitution counts as 0, lengths and scales as 1."""
    if kind == "option":
        return float(model.opt.gravity[2])
    if (kind, attribute) in FIELDS:
        field = FIELDS[kind, attribute]
        i = attributes.rows(model, field, attributes.element(model, kind, target))[0]
        value = np.asarray(getattr(model, field.name)[i]).reshape(-1)
        return field.sign * float(value[field.column or 0])
    if (kind, attribute) == ("geom", "restitution"):
        return 0.0
    names = {"mass": "body_mass", "inertia": "body_inertia", "gain": "actuator_gainprm", "kp": "actuator_gainprm"}
    if attribute not in names:
        return 1.0
    return float(np.asarray(getattr(model, names[attribute])[attributes.element(model, kind, target)]).reshape(-1)[0])


def _check_default(default: float, kind: str, attribute: str, operation: str, where: str) -> None:
    if operation == "scaling" and default == 0:
        advice = "use additive, exclude it, or give what stands for it: `zero: NUMBER`"
        raise UserError(f"{where}: scaling a number that is 0 in the model does nothing; {advice}")
    if (kind, attribute) in (("joint", "friction"), ("tendon", "friction")) and default <= 0:
        raise UserError(f"{where}: MJX ignores friction that is 0 in the MJCF; give frictionloss a small value there")
    if attribute in ("gain", "kp", "mass") and default == 0:
        raise UserError(f"{where}: it is 0 in the model and only known as a ratio; exclude it")


def _scale(
    model: mujoco.MjModel, actor: str, actors: Sequence[str], setting: Mapping[str, Any], where: str
) -> Parameter:
    """One number for the whole actor: `scale: {range: ...}`, or BayesSimIG's `scale: {scale: {range: ...}}`."""
    if set(setting) == {"scale"}:
        setting = setting["scale"]
    checks.known(setting, (*SETTINGS, *ACCEPTED), where)
    operation = checks.choice(setting, "operation", OPERATIONS, "scaling", where)
    have = attributes.names(model, "body")
    if actor not in have and len(actors) > 1:
        raise UserError(f"{where}: only a body can be scaled apart from other actors; {suggest(actor, have[1:])}")
    bodies = attributes.subtree(model, attributes.actor_root(model, actor))
    for g in np.flatnonzero(np.isin(model.geom_bodyid, bodies)):
        if int(model.geom_type[g]) not in geometry.PRIMITIVE:
            raise UserError(
                f"{where}: geom {attributes.names(model, 'geom')[g]} is a mesh, MJX cannot scale it per world"
            )
    name = f"{actor}_scale" + ("_mult" if operation == "scaling" else "")
    return _build(setting, where, name, 1.0, operation=operation, attribute="scale", target=actor, kind="actor")
