"""The last words of `bayessim-mjx logs check`: what comes next, and lines of a map where columns have a wrong name."""

from __future__ import annotations

from collections.abc import Mapping

import yaml

from bayessim_mjx.logs.overview import Overview
from bayessim_mjx.quantities import MOST, count, listed


def last_words(found: Overview, file: str, diagnose: str) -> str:
    """Of logs that can be read.

    Args:
        file: of the map; diagnose: the command of a diagnosis.
    """
    if found.exchanged:
        kinds = (("commands", "ctrl", found.exchanged[0].commands), ("positions", "qpos", found.exchanged[0].joints))
        each = [
            f"if the {words} are exchanged, these lines in {file} mend it:\n{_lines(found, _moved(found, stream, own))}"
            for words, stream, own in kinds
        ]
        return "\n".join(each)
    if found.unmeasured:
        lost = listed([*found.unmeasured], most=MOST)
        text = f"not measured: {lost}; next, without {'it' if len(found.unmeasured) == 1 else 'them'}: {diagnose}"
        alike = {name: own[0] for name, own in found.unmeasured.items() if len(own) == 1}
        if not alike:
            return text
        mend = f"if {listed([f'{c} is {n}' for n, c in alike.items()], most=MOST)}, these lines in {file} say so:"
        return f"{mend}\n{_lines(found, alike)}\n{text}"
    if found.doubts:
        text = f"no channel is missing; check the map against {count(len(found.doubts), 'note')} above, then:"
        return f"{text} {diagnose}"
    return f"nothing is missing; next: {diagnose}"


def _moved(found: Overview, stream: str, own: Mapping[str, str]) -> dict[str, str]:
    """{channel: the column of another one}."""
    return {
        f"{kind}:{name}": found.sources[f"{kind}:{other}"]
        for kind in ((stream,) if stream == "ctrl" else (stream, "qvel"))
        for name, other in own.items()
        if f"{kind}:{other}" in found.sources
    }


def _lines(found: Overview, changed: Mapping[str, str]) -> str:
    """Lines of a map for changed columns; where no map names channels, for all: a map that names one names each."""
    blocks: dict[str, dict[str, str]] = {}
    for name, column in (changed if found.mapped else found.sources | dict(changed)).items():
        stream, _, own = name.partition(":")
        if stream in ("ctrl", "qpos", "qvel"):
            blocks.setdefault(stream, {})[own] = column
        elif name != "time":
            blocks.setdefault("streams", {})[name] = column
    each = (yaml.safe_dump({key: own}, default_flow_style=None, width=10_000, sort_keys=False, allow_unicode=True)
            for key, own in blocks.items())  # fmt: skip
    return "".join(f"  {text}" for text in each).rstrip()


__all__ = ["last_words"]
