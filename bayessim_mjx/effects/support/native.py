"""A model with identified parameters and effects written into it, as far as MuJoCo has elements for them.

The result is for MuJoCo. MJX has no rows for a frictionloss of 0 in the compiled model; written values are above 0.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import mujoco

from bayessim_mjx.effects.effect import Effect, Part
from bayessim_mjx.effects.support.bodies import whole_inertia
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.parameters.editing import frozen

Values = dict[str, dict[str, float]]  # [place][quantity]


def write_model(
    spec: mujoco.MjSpec,
    space: ParameterSpace,
    theta: Any,
    effects: Sequence[Effect] = (),
    values: Mapping[str, float] | None = None,
) -> tuple[mujoco.MjSpec, list[str]]:
    """Write parameters and effects natively into a copy of `spec`; it compiles.

    Args:
        spec: of the nominal model; not changed.
        space: the model's parameters; theta: `[d]`, or {name: value}.
        effects: at their places; unnamed elements among these get names (`joint3`) in the result.
        values: of the effects' parameters by their full names; those left out are nominal.

    Returns:
        (spec, one sentence for each thing that is not expressed in it, with the reason).
    """
    missing: list[str] = []
    spec = frozen(spec)
    try:
        spec = space.edit(spec, theta)
    except UserError as error:
        missing = [f"calibrated parameters: {error}"]
    for effect in effects:
        spec, why = _add(spec, effect, _values(effect, values or {}))
        part = "a part of " if isinstance(why, Part) else ""
        missing += [f"{part}{effect.name} at {', '.join(effect.places())}: {why}"] if why else []
    return spec, missing


def _values(effect: Effect, given: Mapping[str, float]) -> Values:
    return {b.place: {p.attribute: float(given.get(p.name, p.nominal)) for p in b.parameters} for b in effect.blocks()}


def _add(spec: mujoco.MjSpec, effect: Effect, values: Values) -> tuple[mujoco.MjSpec, str | None]:
    """(spec with the effect, None or the part that it lacks), or (the spec as it was, why it is not in there)."""
    new = spec.copy()
    model = whole_inertia(new, new.compile())
    at = effect.bind(model, float(model.opt.timestep), 1)  # refuses unknown places
    if effect.where == "all":
        values = {place: values["all"] for place in at.names}
    _name(new, effect.kind, values)
    try:
        why = effect.edit(new, values)
        new.compile()
    except Exception as error:  # MuJoCo's, on compiling, or of the method `edit` of a user's effect
        who = "MuJoCo refuses it" if isinstance(error, ValueError) else f"its edit() fails: {type(error).__name__}"
        why = f"{who}: {' '.join(str(error).split())}"
    return (spec, why) if why and not isinstance(why, Part) else (new, why)


def _name(spec: mujoco.MjSpec, kind: str, places: Iterable[str]) -> None:
    """Name the unnamed elements among the places as `Site` calls them."""
    members = {"actuator": "actuators", "joint": "joints", "body": "bodies", "geom": "geoms"}
    for element in getattr(spec, members[kind]) if kind in members else ():
        if not element.name and f"{kind}{element.id}" in places:
            element.name = f"{kind}{element.id}"
