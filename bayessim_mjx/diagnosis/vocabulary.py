"""How effects are put into sentences."""

from collections.abc import Iterable, Sequence

from bayessim_mjx.effects.support.words import words
from bayessim_mjx.quantities import listed


def missing(name: str, where: str) -> str:
    """`a command delay at torque`, after "the simulator lacks"."""
    own = words(name)
    return own.at(where, own.lacks)


def titled(name: str, where: str) -> str:
    """`extra payload at tool`, on its own."""
    return words(name).at(where)


def by_law(effects: Iterable[Sequence[str]]) -> list[str]:
    """What is missing, a phrase for each law: `Coulomb friction at shoulder and elbow`.

    Args:
        effects: (name, place) of each.
    """
    places: dict[str, list[str]] = {}
    for name, where in effects:
        places.setdefault(name, []).append(where)
    own = {name: [w for w in where if w not in ("", "world", "all")] for name, where in places.items()}
    some = {name: [listed(at)] if len(at) > 1 else at for name, at in own.items()}
    tied = {name: [w for w in where if w in ("", "world", "all")] for name, where in places.items()}
    return [missing(name, where) for name in places for where in [*some[name], *tied[name]]]
