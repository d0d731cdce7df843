"""Effects from settings: the list `effects:`, and the group `effects` of `task.randomization_params`.

Order of theta: the model's parameters, then the effects of the list in its order, then those that only the group names,
in its order; within an effect the order of its `space()`.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from bayessim_mjx import effects as room
from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import checks, reading
from bayessim_mjx.parameters.attributes import suggest


def listed(specs: Sequence[Mapping[str, Any]]) -> tuple[Effect, ...]:
    """Read the effects of a list of {effect, where, further settings of the effect, parameters}.

    `effect` is what `effects.load` takes. `parameters` gives ranges, priors and nominal values, as in an effects.yaml:
    {parameter: {range, distribution, nominal, ...}}, below the name of each place where `where` is a list.

    Raises:
        UserError: naming the entry, and what is unknown or missing in it.
    """
    return tuple(_listed(spec, f"effects[{i}]") for i, spec in enumerate(specs))


def _listed(spec: Any, path: str) -> Effect:
    if not isinstance(spec, Mapping):
        raise UserError(f"{path} = {spec!r}: expected {{effect: <name>, where: <name>}}")
    given = dict(spec)
    for key, what in (("effect", f"one of {', '.join(room.names())}"), ("where", "a joint, actuator ... of the model")):
        if given.get(key) is None:
            raise UserError(f"{path}.{key} is missing in {given}: give {what}")
    parameters = checks.mapping(given.pop("parameters", None), f"{path}.parameters")
    effect = _make(path, given.pop("effect"), given.pop("where"), given)
    if isinstance(effect.where, str):
        return _ranged(effect, effect.where, parameters, f"{path}.parameters")
    for place, settings in parameters.items():
        if place not in effect.where:
            raise UserError(f"{path}.parameters.{place}: {suggest(str(place), effect.where)}")
        below = f"{path}.parameters.{place}"
        effect = _ranged(effect, place, checks.mapping(settings, below), below)
    return effect


def _make(path: str, effect: Any, where: Any, settings: Mapping[str, Any]) -> Effect:
    try:
        return room.make(room.recorded(effect), where=where, **settings)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def stack(section: Mapping[str, Any], effects: Sequence[Effect] = ()) -> tuple[Effect, ...]:
    """`effects` and those of the section's group {effect: {where: {parameter: {range, distribution, ...}}}}, in order.

    Args:
        section: `randomization_params`, or the `task` section that holds it.
        effects: their ranges are changed where the group names them too.

    Raises:
        UserError: naming the key's path and what may be meant; a wrong `where` is found later, by `Physics`.
    """
    found = list(effects)
    for path, name, where, parameters in reading.effect_groups(section):
        spec = next((room.spec_of(e) for e in found if e.name == name), name)  # users' own go by their name too
        new = _make(path, spec, where, {})
        places = [i for i, e in enumerate(found) if (e.name, e.where) == (new.name, where)]
        if not places:
            places = [len(found)]
            found.append(new)
        found[places[0]] = _ranged(found[places[0]], where, parameters, path)
    return tuple(found)


def _ranged(effect: Effect, place: str, settings: Mapping[str, Any], path: str) -> Effect:
    """Give the effect other ranges and priors at one place."""
    own = {p.attribute: p for block in effect.with_all().blocks() if block.place == place for p in block.parameters}
    changed = {}
    for label, setting in settings.items():
        if label not in own:
            raise UserError(f"{path}.{label}: {effect.name} has no such parameter; {suggest(label, own)}")
        changed[own[label].name] = reading.effect_parameter(own[label], setting, f"{path}.{label}")
    parameters = tuple(changed.get(p.name, p) for p in effect.space().parameters)
    try:
        return dataclasses.replace(effect, parameters=parameters)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
