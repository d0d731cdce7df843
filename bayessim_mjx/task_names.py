"""The names of tasks, without importing them: the library's, and those of installed packages."""

import pkgutil

from bayessim_mjx import tasks
from bayessim_mjx.outside_tasks import installed

BASES = ("locomotion", "manipulation")  # public modules of tasks/ that hold what several tasks share


def names() -> list[str]:
    """Names of all tasks: one per file in tasks/, `ball_balance.py` holds BallBalance, and the installed ones."""
    return sorted({*library(), *installed()})


def library() -> list[str]:
    """Names of the library's own tasks; one of them stays the library's, whatever a package calls so."""
    modules = {m.name for m in pkgutil.iter_modules(tasks.__path__) if not m.name.startswith("_")} - {*BASES}
    return ["".join(part.capitalize() for part in module.split("_")) for module in modules]
