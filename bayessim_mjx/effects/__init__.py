"""Unmodelled effects, one per file, looked up by name: `effects.make("coulomb_friction", where="hinge")`."""

import difflib
import importlib
import pkgutil
from typing import Any

from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.errors import UserError

__all__ = ["Effect", "make", "names"]


def names() -> list[str]:
    """Names of all effects: the files of this folder."""
    return sorted(m.name for m in pkgutil.iter_modules(__path__) if m.name != "effect")


def make(effect: str, where: str, **settings: Any) -> Effect:
    """The effect called `effect` at the place `where`.

    Args:
        effect: a name from `names()`.
        where: MuJoCo name of the joint, actuator ... concerned.
        settings: further fields of the effect, for example the upper limits of its parameters.

    Raises:
        UserError: on an unknown effect or setting.
    """
    if effect not in names():
        close = difflib.get_close_matches(effect, names())
        raise UserError(
            f"effect {effect!r}: " + (f"did you mean {close[0]}? " if close else "") + f"there are: {names()}"
        )
    module = importlib.import_module(f"{__name__}.{effect}")
    kind = getattr(module, "".join(part.capitalize() for part in effect.split("_")))
    allowed = set(kind.__dataclass_fields__)
    if unknown := set(settings) - allowed:
        raise UserError(f"effect {effect}: no settings {sorted(unknown)}; allowed are {sorted(allowed)}")
    return kind(where=where, **settings)
