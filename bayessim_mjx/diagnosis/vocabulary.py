"""How effects and lists are put into sentences."""

from collections.abc import Iterable, Sequence

from bayessim_mjx.effects.support.words import words


def missing(name: str, where: str) -> str:
    """`a command delay at torque`, after "the simulator lacks"."""
    own = words(name)
    if where in ("", "world") or (own.kind == "world" and where == "all"):
        return own.lacks
    return f"{own.lacks} at all {_several(own.kind)}" if where == "all" else f"{own.lacks} at {where}"


def titled(name: str, where: str) -> str:
    """`extra payload at tool`, on its own."""
    own = words(name)
    if where in ("", "world") or (own.kind == "world" and where == "all"):
        return own.noun
    return f"{own.noun} at all {_several(own.kind)}" if where == "all" else f"{own.noun} at {where}"


def _several(kind: str) -> str:
    return "bodies" if kind == "body" else f"{kind or 'place'}s"


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


def listed(names: list[str], last: str = "and") -> str:
    """`a, b and c`."""
    return f" {last} ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else "".join(names)
