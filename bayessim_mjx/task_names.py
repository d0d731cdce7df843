"""The names of tasks, without importing them: the library's, and those of installed packages."""

import pkgutil
from pathlib import Path
from typing import Any

from bayessim_mjx import tasks

BASES = ("locomotion", "manipulation")  # public modules of tasks/ that hold what several tasks share
GROUP = "bayessim_mjx.tasks"  # of entry points: <Name> = "package.module:Class"


def names() -> list[str]:
    """Names of all tasks: one per file in tasks/, `ball_balance.py` holds BallBalance, and the installed ones."""
    return sorted({*_library(), *installed()})


def _library() -> list[str]:
    modules = {m.name for m in pkgutil.iter_modules(tasks.__path__) if not m.name.startswith("_")} - {*BASES}
    return ["".join(part.capitalize() for part in module.split("_")) for module in modules]


def installed() -> dict[str, Any]:
    """{name: entry point} of the tasks of installed packages; a name of the library's own stays the library's."""
    from importlib import metadata  # here, so that commands start fast

    own = {*_library()}
    return {point.name: point for point in metadata.entry_points(group=GROUP) if point.name not in own}


def is_file(task: str) -> bool:
    """Whether a task is named by its file, as `path/slider.py:Slider`."""
    return task.rpartition(":")[0].endswith(".py")


def short(task: str) -> str:
    """The name of a task without the folder of its file, for folders and titles: `Slider` of `path/slider.py:Slider`."""
    return task.rpartition(":")[2] if is_file(task) else task


def settings_beside(task: str) -> Path | None:
    """The YAML file that belongs to a task outside of the library: `slider.yaml` beside `slider.py`; it need not exist.

    None: the task is the library's.
    """
    if is_file(task):
        return Path(task.rpartition(":")[0]).with_suffix(".yaml")
    if task not in _library() and (point := installed().get(task)) is not None:
        from importlib.util import find_spec

        try:
            spec = find_spec(point.module)
        except ImportError:  # `registry.make` says why
            return None
        return Path(spec.origin).with_suffix(".yaml") if spec is not None and spec.origin else None
    return None
