"""Checks of a `randomization_params` section: each error names the key's path, its value and what is allowed.

`with_zeros` puts in what a task's scaling takes for numbers that are 0 in the model.
"""

import difflib
from collections.abc import Mapping, Sequence
from typing import Any

from bayessim_mjx.config.settings import number as finite
from bayessim_mjx.errors import UserError


def mapping(value: Any, where: str) -> Mapping[str, Any]:
    """Check that a section is a mapping; nothing at all is an empty one."""
    if value is None or isinstance(value, Mapping):
        return value or {}
    raise UserError(f"{where} = {value!r}: expected a section of `key: value` lines")


def known(section: Any, allowed: Sequence[str], where: str) -> None:
    """Refuse a section with other keys than the allowed ones."""
    if not isinstance(section, Mapping):
        raise UserError(f"{where} = {section!r}: expected a section with keys of {', '.join(allowed)}")
    for key in section:
        if key not in allowed:
            close = difflib.get_close_matches(str(key), allowed, 2)
            hint = f"did you mean {', '.join(close)}? " if close else ""
            raise UserError(f"{where}.{key}: unknown key; {hint}allowed: {', '.join(allowed)}")


def choice(setting: Mapping[str, Any], key: str, allowed: Sequence[str], default: str, where: str) -> str:
    """Return the value of `key`, one of the allowed."""
    value = setting.get(key, default)
    if value not in allowed:
        raise UserError(f"{where}.{key}: {value!r} is none of {', '.join(allowed)}")
    return value


def low_high(setting: Mapping[str, Any], where: str) -> tuple[float, float]:
    """Return the setting's `range`, low < high."""
    value = setting.get("range")
    if value is None:
        raise UserError(f"{where}.range: missing; give [low, high]")
    if isinstance(value, str) or not hasattr(value, "__len__") or len(value) != 2:
        raise UserError(f"{where}.range: {value!r} is not [low, high]")
    low, high = (number(v, f"{where}.range") for v in value)
    if not low < high:
        raise UserError(f"{where}.range: [{low:g}, {high:g}] is empty; low must be less than high")
    return low, high


def number(value: Any, where: str) -> float:
    """Return a finite number."""
    found = finite(value)
    if found is None:
        infinite = isinstance(value, float)
        raise UserError(f"{where}: {value!r} is not {'finite' if infinite else 'a number'}")
    return found


def with_zeros(section: Mapping[str, Any], zeros: Mapping[str, float]) -> Mapping[str, Any]:
    """Give joints' attributes their `zero` in a `randomization_params`, where they do not say another.

    Args:
        section: not changed.
        zeros: {attribute of dof_properties: what scaling takes for a number that is 0 in the model}.
    """

    def with_zero(setting: Any, zero: float) -> Any:
        return {"zero": zero, **setting} if isinstance(setting, Mapping) else setting

    def inner(groups: Any) -> Any:
        dofs = groups.get("dof_properties") if isinstance(groups, Mapping) else None
        if not isinstance(dofs, Mapping):
            return groups
        return {**groups, "dof_properties": {a: with_zero(s, zeros[a]) if a in zeros else s for a, s in dofs.items()}}

    actors = section.get("actor_params")
    if not zeros or not isinstance(actors, Mapping):
        return section
    return {**section, "actor_params": {actor: inner(groups) for actor, groups in actors.items()}}
