"""Operating conditions of logs: what is held out together, and what is said where nothing can be."""

from __future__ import annotations

from collections.abc import Sequence

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Log


def groups_of(logs: Sequence[Log], key: str | None = None) -> tuple[list[int], tuple[str, ...]]:
    """Operating condition of each log: metadata `key`, else `condition` or `operating_condition`, else one per log.

    Pieces of one file that was cut at its gaps are one log.

    Raises:
        UserError: the key that was asked for is in no log's metadata.
    """
    labels = _labels(logs, key)
    if key and not any(labels):
        have = ", ".join(sorted({k for log in logs for k in log.metadata})) or "no keys"
        raise UserError(f"--group {key}: no log's metadata has this key; there are: {have}")
    told = len(set(labels)) > 1  # the same condition everywhere cannot be held out
    labels = [label if label and told else file for label, file in zip(labels, _files(logs), strict=True)]
    names = tuple(dict.fromkeys(labels))
    return [names.index(label) for label in labels], names


def _files(logs: Sequence[Log]) -> list[str]:
    """Each log's name; of pieces of one file that of the file."""
    sources = [str(log.metadata.get("source", log.name)) for log in logs]
    names = [(log.name.rpartition("#")[0], log.name) for log in logs]
    return [file if file and sources.count(of) > 1 else log for (file, log), of in zip(names, sources, strict=True)]


def _labels(logs: Sequence[Log], key: str | None) -> list[str]:
    """Each log's condition, "" where its metadata do not tell."""
    found = [
        log.metadata.get(key) if key else log.metadata.get("condition", log.metadata.get("operating_condition"))
        for log in logs
    ]
    return ["" if value is None else str(value) for value in found]


def group_notes(logs: Sequence[Log], key: str | None) -> tuple[str, ...]:
    """What is held out in place of the conditions that were asked for, where these cannot be."""
    labels = _labels(logs, key)
    if not key or not any(labels):
        return ()
    without = [log.name for log, label in zip(logs, labels, strict=True) if not label]
    if without:
        return (f"--group {key}: {', '.join(without)} without this key: each is held out as a condition of its own",)
    if len(set(labels)) > 1:
        return ()
    instead = "single logs" if len(set(_files(logs))) > 1 else "blocks of the only log in time"
    return (f"--group {key}: {labels[0]!r} in all logs, so nothing can be held out by it; {instead} are held out",)
