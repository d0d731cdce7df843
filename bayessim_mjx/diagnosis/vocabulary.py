"""How effects and lists are put into sentences."""

from bayessim_mjx.effects.support.words import words


def missing(name: str, where: str) -> str:
    """`a command delay at torque`, after "the simulator lacks"."""
    own = words(name)
    if where in ("", "world") or (own.kind == "world" and where == "all"):
        return own.lacks
    return f"{own.lacks} at all {own.kind or 'place'}s" if where == "all" else f"{own.lacks} at {where}"


def titled(name: str, where: str) -> str:
    """`extra payload at tool`, on its own."""
    own = words(name)
    if where in ("", "world") or (own.kind == "world" and where == "all"):
        return own.noun
    return f"{own.noun} at all {own.kind or 'place'}s" if where == "all" else f"{own.noun} at {where}"


def listed(names: list[str], last: str = "and") -> str:
    """`a, b and c`."""
    return f" {last} ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else "".join(names)
