"""What scaling takes for a number that is 0 in the model, where a task has such a rule."""

from collections.abc import Mapping
from typing import Any


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
