"""Unmodelled effects, one per file, looked up by name: `effects.make("coulomb_friction", where="hinge")`.

A user's own effect is a frozen dataclass like those here: installed under the entry point group
`bayessim_mjx.effects`, or in a file, called `path.py:MyEffect`.
"""

import contextlib
import dataclasses
import difflib
import functools
import importlib
import importlib.metadata
import inspect
import keyword
import pkgutil
import re
from pathlib import Path
from typing import Any

from bayessim_mjx import trust
from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.errors import UserError
from bayessim_mjx.quantities import listed

__all__ = ["Effect", "known", "load", "make", "names", "recorded", "spec_of"]

ENTRY_POINTS = "bayessim_mjx.effects"
_brought: dict[str, type[Effect]] = {}  # by name: the newest of those that files and packages brought
LIST = "`bayessim-mjx diagnose --list_effects` lists all"
SAME = {"motor": "actuator", "drive": "actuator", "latency": "delay", "stiction": "friction", "dry": "coulomb"}
USUAL = {  # of several effects with this word, the one that is meant most often
    "friction": "coulomb_friction", "gain": "actuator_gain", "delay": "actuator_delay", "damping": "viscous_friction",
    "play": "backlash", "spring": "joint_spring", "mass": "payload",
}  # fmt: skip
KINDS = ("actuator", "joint", "body", "geom", "world")


def names() -> list[str]:
    """Names of all effects: the files of this folder that hold one, and the installed ones."""
    return sorted([*_library(), *_installed()])


@functools.cache
def _library() -> tuple[str, ...]:
    """List the files of this folder that define an effect of their name; the others are helpers."""
    return tuple(m.name for m in pkgutil.iter_modules(__path__) if _own(m.name) is not None)


def _own(name: Any) -> type[Effect] | None:
    """Get the class CamelCase of the file of that name, if it is an effect."""
    if not isinstance(name, str) or not name.isidentifier() or not (Path(__file__).parent / f"{name}.py").is_file():
        return None
    module = importlib.import_module(f"{__name__}.{name}")
    kind = getattr(module, "".join(part.capitalize() for part in name.split("_")), None)
    return kind if _is_effect(kind) else None


def _installed() -> dict[str, importlib.metadata.EntryPoint]:
    return {point.name: point for point in importlib.metadata.entry_points(group=ENTRY_POINTS)}


def _is_effect(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Effect) and kind is not Effect


def load(spec: str) -> type[Effect]:
    """Load the class of an effect that the user names: the file of `path.py:MyEffect` may run from now on.

    Args:
        spec: a name from `names()`, or `path.py:MyEffect`, relative to the working directory.

    Raises:
        UserError: no such effect, file or class; a class that does not keep the contract (`effect.py`).
    """
    if isinstance(spec, str) and ".py:" in spec:
        trust.allow([spec.rpartition(":")[0]])
    return recorded(spec)


def recorded(spec: str) -> type[Effect]:
    """Load the class of an effect that a file names (effects.yaml, diagnosis.json): `load` without its permission.

    Raises:
        UserError: as `load`; the user has not named the file of code.
    """
    if isinstance(spec, str) and ".py:" in spec:
        path, _, title = spec.rpartition(":")
        return _checked(_from_file(Path(path), title), spec)
    own = _own(spec)
    if own is not None:
        return own
    if spec in _installed():
        try:
            kind = _installed()[spec].load()
        except (Exception, SystemExit) as error:
            raise UserError(f"effect {spec!r}: its package cannot be imported: {error}") from error
        return _checked(kind, spec, spec)
    close = likely(str(spec))
    hint = f"did you mean {listed(close, 'or')}? {LIST}" if close else f"there are: {', '.join(names())} ({LIST})"
    raise UserError(f"no effect {spec!r}; {hint}; or a file: path.py:MyEffect")


def likely(spec: str) -> list[str]:
    """At most three effects that a user may mean by an unknown name, the likeliest first: by words, then by letters."""
    given = [SAME.get(word, word) for word in re.split(r"[\W_]+", spec.lower()) if word]
    own = {name: set(name.split("_")) for name in names()}
    first = [USUAL.get("_".join(given), "_".join(given))]
    within = [name for name, words in own.items() if words <= set(given)]
    around = [name for name, words in own.items() if given and set(given) <= words]
    close = difflib.get_close_matches(spec, own)
    return [name for name in dict.fromkeys([*first, *within, *around, *close]) if name in own][:3]


def known(name: str) -> type[Effect] | None:
    """Find the effect of that name: the library's, one loaded from a file, or an installed one; None: no such."""
    found = _own(name) or _brought.get(name)
    if found is None and name in _installed():
        with contextlib.suppress(UserError):
            return recorded(name)
    return found


def _from_file(path: Path, title: str) -> Any:
    found = trust.module_of(path, title, "effect", __name__)
    if not hasattr(found, title):
        path = path.resolve()
        own = [n for n, kind in vars(found).items() if _is_effect(kind) and kind.__module__ == found.__name__]
        raise UserError(
            f"effect {path}:{title}: no class {title!r} in the file; its effects: {', '.join(own) or 'none'}"
        )
    return getattr(found, title)


def _checked(kind: Any, spec: str, name: str | None = None) -> type[Effect]:
    """Return the class, if it keeps the contract and its name is its own."""
    if not _is_effect(kind):
        raise UserError(f"effect {spec}: {kind!r} is no subclass of bayessim_mjx.effects.Effect")
    for attribute, what in (("name", "its name"), ("kind", f"one of {', '.join(KINDS)}"), ("quantities", "parameters")):
        if not getattr(kind, attribute, None):
            raise UserError(f"effect {spec}: the class lacks `{attribute}: ClassVar` ({what})")
    if not isinstance(kind.name, str) or not kind.name.isidentifier() or keyword.iskeyword(kind.name):
        raise UserError(f"effect {spec}: name = {kind.name!r}: expected one word of letters, digits and _")
    if kind.kind not in KINDS:
        raise UserError(f"effect {spec}: kind = {kind.kind!r}: allowed are {', '.join(KINDS)}")
    for attribute in ("noun", "lacks", "separates"):
        if not isinstance(getattr(kind, attribute), str):
            raise UserError(f"effect {spec}: {attribute} = {getattr(kind, attribute)!r}: expected a text")
    if kind.witness is not None and not _is_pair_of_texts(kind.witness):
        raise UserError(f"effect {spec}: witness = {kind.witness!r}: expected (stream of a log, what to record)")
    if not all(isinstance(q, Quantity) for q in kind.quantities):
        raise UserError(f"effect {spec}: quantities = {kind.quantities!r}: expected a tuple of effects.effect.Quantity")
    if "__dataclass_params__" not in vars(kind) or not kind.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise UserError(f"effect {spec}: the class lacks @dataclasses.dataclass(frozen=True)")
    if name not in (None, kind.name):
        raise UserError(f"effect {spec}: the class calls itself {kind.name!r}; name the entry point so")
    if _own(kind.name) is not None or (name is None and kind.name in _installed()):
        raise UserError(f"effect {spec}: there is an effect {kind.name!r} already; give the class another name")
    _brought[kind.name] = kind
    return kind


def _is_pair_of_texts(value: Any) -> bool:
    return isinstance(value, tuple) and len(value) == 2 and all(isinstance(text, str) for text in value)


def spec_of(effect: Effect) -> str:
    """Give the text by which `load` finds the effect's class: its name, or `path.py:MyEffect`."""
    kind = type(effect)
    if not kind.__module__.startswith(f"{__name__}.own_"):
        return effect.name
    return f"{inspect.getfile(kind)}:{kind.__qualname__}"


def make(effect: str | type[Effect], where: str | tuple[str, ...], **settings: Any) -> Effect:
    """Make the effect called `effect` at the place `where`.

    Args:
        effect: what `load` takes, or a class.
        where: MuJoCo name of the joint, actuator ... concerned, several names, or "all".
        settings: further fields of the effect, for example the upper limits of its parameters.

    Raises:
        UserError: on an unknown effect or setting.
    """
    kind = load(effect) if isinstance(effect, str) else effect
    label = effect if isinstance(effect, str) else kind.name
    if isinstance(where, list):
        where = tuple(where)
    if not isinstance(where, str) and not (isinstance(where, tuple) and all(isinstance(w, str) for w in where)):
        raise UserError(f"effect {label}: where = {where!r}: expected the MuJoCo name of a joint, actuator ...")
    allowed = {f.name: f.type for f in dataclasses.fields(kind) if f.name not in ("where", "parameters")}
    for name, value in settings.items():
        if name not in allowed:
            raise UserError(f"effect {label}: no setting {name!r}; allowed are {', '.join(allowed)}")
        if allowed[name] in (float, "float") and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise UserError(f"effect {label}: {name} = {value!r}: expected a number")
    return kind(where=where, **settings)
