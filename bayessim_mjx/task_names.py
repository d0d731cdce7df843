"""The names of our own tasks, without importing them."""

import pkgutil

from bayessim_mjx import tasks

BASES = ("locomotion", "manipulation")  # public modules of tasks/ that hold what several tasks share


def names() -> list[str]:
    """Names of our own tasks: one per file in tasks/, `ball_balance.py` holds BallBalance."""
    modules = {m.name for m in pkgutil.iter_modules(tasks.__path__) if not m.name.startswith("_")} - {*BASES}
    return sorted("".join(part.capitalize() for part in module.split("_")) for module in modules)
