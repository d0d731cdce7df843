"""Tasks outside of the library: `path/slider.py:Slider`, and entry points of installed packages, not imported."""

from pathlib import Path
from typing import Any

GROUP = "bayessim_mjx.tasks"  # of entry points: <Name> = "package.module:Class"


def installed() -> dict[str, Any]:
    """{name: entry point} of the tasks of installed packages."""
    from importlib import metadata  # here, so that commands start fast

    return {point.name: point for point in metadata.entry_points(group=GROUP)}


def is_file(task: str) -> bool:
    """Whether a task is named by its file, as `path/slider.py:Slider`."""
    return task.rpartition(":")[0].endswith(".py")


def short(task: str) -> str:
    """Shorten a task's name for folders and titles: `Slider` of `path/slider.py:Slider`."""
    return task.rpartition(":")[2] if is_file(task) else task


def settings_beside(task: str) -> Path | None:
    """Find the YAML file of a task outside of the library: `slider.yaml` beside `slider.py`; it need not exist.

    None: no such task is known.
    """
    if is_file(task):
        return Path(task.rpartition(":")[0]).with_suffix(".yaml")
    if (point := installed().get(task)) is None:
        return None
    from importlib.util import find_spec

    try:
        spec = find_spec(point.module)
    except ImportError:  # `registry.make` says why
        return None
    return Path(spec.origin).with_suffix(".yaml") if spec is not None and spec.origin else None
