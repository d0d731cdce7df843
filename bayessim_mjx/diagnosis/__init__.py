"""Gap diagnosis: where logs and simulator differ, which missing effects cause it, and how much they explain.

    diagnose    the whole diagnosis in one call -> Diagnosis
    Diagnosis   the result: `.apply(physics)`, `.prior()`, `.save(folder)`
    load        a saved Diagnosis
    Verdict     the seven verdicts and their words
    robot       the simulator under diagnosis, from an MJCF file, a specification or a compiled model

Imported when first used, so that the commands start fast.
"""

from importlib import import_module
from typing import Any

_WHERE = {
    "diagnose": ("run", "diagnose"),
    "Diagnosis": ("result", "Diagnosis"),
    "load": ("result", "load"),
    "robot": ("fitting.robot", "robot_of"),
    "Verdict": ("result", "Verdict"),
}
__all__ = ["Diagnosis", "Verdict", "diagnose", "load", "robot"]


def __getattr__(name: str) -> Any:
    if name in _WHERE:
        room, own = _WHERE[name]
        return getattr(import_module(f"bayessim_mjx.diagnosis.{room}"), own)
    raise AttributeError(f"module 'bayessim_mjx.diagnosis' has no attribute {name!r}; it has {', '.join(__all__)}")
