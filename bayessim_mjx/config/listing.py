"""All settings with default and meaning, as lines of text: what `bayessim-mjx help settings [SECTION]` prints."""

import dataclasses
import textwrap
from typing import Any

from bayessim_mjx.config import settings
from bayessim_mjx.errors import unknown

COMMAND = "bayessim-mjx help settings"
TOP = "run"  # what the keys without a section are called here
WIDTH = 100  # characters of a line


def sections() -> dict[str, type[settings.Section]]:
    """{name: class} of all sections, those within a section too, as `ppo.rnd`."""
    kinds = [kind for kind in vars(settings).values() if isinstance(kind, type) and issubclass(kind, settings.Section)]
    return {kind.SECTION or TOP: kind for kind in kinds if kind is not settings.Section}


def text(section: str | None = None) -> str:
    """Write the settings of a section; None: of all.

    Raises:
        UserError: there is no such section.
    """
    known = sections()
    if section is not None and section not in known:
        raise unknown("section of settings", section, known)
    return "\n\n".join(_of(name, kind) for name, kind in known.items() if section in (None, name))


def paths() -> list[str]:
    """List the settings with their sections, as overrides spell them: `ppo.gamma`."""
    return [_key(kind, own) for kind in sections().values() for own in _stated(kind)]


def _stated(kind: type[settings.Section]) -> list[Any]:
    """Fields of a section, but a section of its own, which has its own part."""
    return [own for own in dataclasses.fields(kind) if "doc" in own.metadata]  # type: ignore[arg-type]


def _key(kind: type[settings.Section], own: Any) -> str:
    return f"{kind.SECTION}.{settings.YAML_NAMES.get(own.name, own.name)}".lstrip(".")


def _of(name: str, kind: type[settings.Section]) -> str:
    lines = [f"{name}:" if name != TOP else f"{name}, without a section:"]
    for own in _stated(kind):
        key = _key(kind, own)
        default = own.default if own.default_factory is dataclasses.MISSING else own.default_factory()
        lines.append(f"  {key} = {_written(default)}")
        lines += textwrap.wrap(own.metadata["doc"], WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6)
    return "\n".join(lines)


def _written(value: Any) -> str:
    """Write a default as on the command line."""
    if isinstance(value, tuple):
        return f"[{', '.join(map(_written, value))}]"
    return "null" if value is None else str(value) or "''"
