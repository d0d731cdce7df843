"""bayessim_mjx: adaptive domain randomisation and sim-to-real gap diagnosis on MuJoCo MJX.

The public names, by room (imported when first used, so that the commands start fast):

    config        load                                     settings of a run from cfg/<task>.yaml and overrides
    registry      make, names                              tasks by name
    parameters    Parameter, ParameterSpace                named physical numbers, written into an mjx.Model
    distributions Distribution                             prior, randomisation and posterior over theta
    physics       Physics, World, control_step             the one control step
    effects       Effect                                   what the nominal simulator leaves out
    env           Env, State, Task                         environments
    logs          Log, read_logs                           recorded motion
    rl.pretrained pretrained                               a policy that comes with the package
    diagnose      diagnose                                 logs and a simulator -> Diagnosis (also a command's module)
                  robot                                    the simulator under diagnosis, of a file, task or model

Rooms to import as modules: rollout (rollout, replay), rl (train, evaluate), inference (fit, condition, combine),
loop (make, init, run).
"""

from importlib import import_module
from typing import Any

from bayessim_mjx.wrappers import announce

_ROOMS = {
    "config": ("load",),
    "registry": ("make", "names"),
    "parameters": ("Parameter", "ParameterSpace"),
    "distributions": ("Distribution",),
    "physics": ("Physics", "World", "control_step"),
    "effects": ("Effect",),
    "env": ("Env", "State", "Task"),
    "logs": ("Log", "read_logs"),
    "rl.pretrained": ("pretrained",),
    "diagnose": ("robot",),
}
_WHERE = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = [
    "Distribution", "Effect", "Env", "Log", "Parameter", "ParameterSpace", "Physics", "State", "Task", "World",
    "control_step", "diagnose", "load", "make", "names", "pretrained", "read_logs", "robot",
]  # fmt: skip


announce()  # bayessim_mjx/<Task>-v0 in Gymnasium


def __dir__() -> list[str]:
    return sorted(__all__)  # what completion offers


def __getattr__(name: str) -> Any:
    if name == "diagnose":  # the command's module, which can be called
        return import_module("bayessim_mjx.diagnose")
    if name == "__version__":
        return import_module("bayessim_mjx.versions").of(["bayessim-mjx"])["bayessim-mjx"]
    if name in _WHERE:
        return getattr(import_module(f"bayessim_mjx.{_WHERE[name]}"), name)
    raise AttributeError(f"module 'bayessim_mjx' has no attribute {name!r}; it has {', '.join(__all__)}")
