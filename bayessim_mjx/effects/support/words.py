"""What is said of effects, for sentences, tables and advice: by their own words, else by name and docstring."""

import dataclasses
import inspect
import re

from bayessim_mjx import effects as room
from bayessim_mjx.effects.effect import Effect


@dataclasses.dataclass(frozen=True)
class Words:
    """Of one effect.

    Attributes:
        noun: what people call it.
        kind: of its places; "" where the effect is not known.
        lacks: what a simulator lacks that lacks it.
        separates: the experiment that separates it from look-alikes; "" where nothing is known of it.
        witness: (stream of a log that shows it directly, what to record), or None.
    """

    noun: str
    kind: str = ""
    lacks: str = ""
    separates: str = ""
    witness: tuple[str, str] | None = None

    def at(self, where: str, text: str = "", quoted: bool = False) -> str:
        """`extra payload at tool`, `viscous friction at all joints`; without a place where it has none.

        Args:
            where: a place of the effect, "all" or "world"; text: in place of the noun.
            quoted: `extra payload at body 'tool'`.
        """
        text = text or self.noun
        if where in ("", "world") or (self.kind == "world" and where == "all"):
            return text
        if where == "all":
            return f"{text} at all {'bodies' if self.kind == 'body' else (self.kind or 'place') + 's'}"
        kind = f"{self.kind} " if self.kind not in ("", "world") else ""
        return f"{text} at {kind}'{where}'" if quoted else f"{text} at {where}"


def words(name: str) -> Words:
    """Of the effect called `name`, which may be unknown here: a diagnosis from elsewhere, a file not loaded."""
    kind, plain = room.known(name), name.replace("_", " ")
    if kind is None:
        return Words(plain, lacks=plain)
    noun = kind.noun or plain
    return Words(noun, kind.kind, kind.lacks or noun, kind.separates or _law(kind), kind.witness)


def listing() -> list[tuple[str, str, str]]:
    """(name, kind of place, one line) of every effect."""
    found = []
    for name in room.names():
        kind = room.load(name)
        apart = "only for training" if kind.random else "" if kind.offered else "only where --effects names it"
        found.append((name, kind.kind, words(name).noun + (f" ({apart})" if apart else "")))
    return found


def spelt(parameter: str, effect: str = "") -> str:
    """Return the name of a parameter in words: `com_x` -> `centre of mass x`.

    Of a half with what it is half of, where its effect is named: `gap` of backlash -> `gap (half of the play)`.
    """
    text, whole = re.sub(r"^com ", "centre of mass ", parameter.replace("_", " ")), half_of(effect, parameter)
    return f"{text} (half of the {whole})" if whole and not text.startswith("half") else text


def half_of(effect: str, parameter: str) -> str:
    """Return the whole that a parameter is half of, which people state; "" where it is no half."""
    kind = room.known(effect)
    return next((q.half for q in kind.quantities if q.name == parameter), "") if kind else ""


def _law(kind: type[Effect]) -> str:
    """Name what its motion must excite, by the docstring's first line; "" without a docstring of its own."""
    text = inspect.cleandoc(kind.__doc__ or "").partition("\n")[0].rstrip(".")
    written = text and not text.startswith(f"{kind.__name__}(")  # a dataclass's own
    return f"a motion that excites its law, {text}" if written else ""
