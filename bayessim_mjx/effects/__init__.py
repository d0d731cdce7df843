"""Unmodelled effects, one per file, looked up by name: `effects.make("coulomb_friction", where="hinge")`."""

import dataclasses
import difflib
import importlib
import pkgutil
from typing import Any

from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.errors import UserError

__all__ = ["Effect", "make", "names"]

NOT_EFFECTS = ("effect", "reading", "site", "friction")  # modules of this folder that are no effect


def names() -> list[str]:
    """Names of all effects: the files of this folder."""
    return sorted(m.name for m in pkgutil.iter_modules(__path__) if m.name not in NOT_EFFECTS)


def make(effect: str, where: str | tuple[str, ...], **settings: Any) -> Effect:
    """The effect called `effect` at the place `where`.

    Args:
        effect: a name from `names()`.
        where: MuJoCo name of the joint, actuator ... concerned.
        settings: further fields of the effect, for example the upper limits of its parameters.

    Raises:
        UserError: on an unknown effect or setting.
    """
    if effect not in names():
        close = difflib.get_close_matches(str(effect), names())
        hint = f"did you mean {close[0]}? " if close else ""
        raise UserError(f"no effect {effect!r}; {hint}there are: {', '.join(names())}")
    module = importlib.import_module(f"{__name__}.{effect}")
    kind = getattr(module, "".join(part.capitalize() for part in effect.split("_")))
    if isinstance(where, list):
        where = tuple(where)
    if not isinstance(where, str) and not (isinstance(where, tuple) and all(isinstance(w, str) for w in where)):
        raise UserError(f"effect {effect}: where = {where!r}: expected the MuJoCo name of a joint, actuator ...")
    allowed = {f.name: f.type for f in dataclasses.fields(kind) if f.name not in ("where", "parameters")}
    for name, value in settings.items():
        if name not in allowed:
            raise UserError(f"effect {effect}: no setting {name!r}; allowed are {', '.join(allowed)}")
        if allowed[name] is float and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise UserError(f"effect {effect}: {name} = {value!r}: expected a number")
    return kind(where=where, **settings)
