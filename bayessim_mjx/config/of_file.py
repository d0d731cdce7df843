"""What cfg/<task>.yaml says, as attributes of the task's class: a task's ranges stand in its file alone."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bayessim_mjx.config.loading import task_file
from bayessim_mjx.config.settings import freeze
from bayessim_mjx.config.yaml_text import read_yaml


class OfFile:
    """A class attribute, e.g. `randomization = OfFile("task")`: that entry of the class's file.

    A subclass without a file of its own takes that of its nearest base class.

    Args:
        path: keys and indices that lead to the entry.

    Raises:
        AttributeError: on reading, where there is no file or no such entry.
    """

    def __init__(self, *path: str | int) -> None:
        self.path = path

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, instance: Any, owner: type) -> Any:
        entry: Any = next((_contents(f) for f in (task_file(k.__name__) for k in owner.__mro__) if f.is_file()), None)
        try:
            for key in self.path:
                entry = entry[key]
        except (KeyError, IndexError, TypeError):
            file = task_file(owner.__name__)
            raise AttributeError(f"{owner.__name__} has no {self.name}: {file} gives none") from None
        return entry


@functools.cache
def _contents(path: Path) -> Mapping[str, Any]:
    return freeze(read_yaml(path))
