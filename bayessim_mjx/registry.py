"""Environments by name: `make("Ant")`, `make("slider.py:Slider")`, `make("brax:ant")`, `names()`.

The only dynamic import of tasks. A task outside of the library is named by its file and class, or by the entry point of
an installed package (group `bayessim_mjx.tasks`).
"""

import importlib
import re
import warnings
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

from bayessim_mjx import trust
from bayessim_mjx.effects.support import reading, storage
from bayessim_mjx.errors import UserError, unknown
from bayessim_mjx.outside_tasks import GROUP, installed, is_file
from bayessim_mjx.task_names import library, names

if TYPE_CHECKING:
    from bayessim_mjx.config.settings import Config
    from bayessim_mjx.effects.effect import Effect
    from bayessim_mjx.env import Env

__all__ = ["EXTERNAL", "make", "names"]

EXTERNAL = ("brax", "playground")


def make(name: str, *, config: "Config | None" = None, effects: "Sequence[Effect]" = (), **env_overrides: Any) -> "Env":
    """Make the environment called `name`, at the task's defaults where neither `config` nor an override says otherwise.

    Args:
        name: a name from `names()` (case and underscores do not matter), "path/file.py:Class", "brax:<env>" or
            "playground:<env>". Without `config` the file may run from now on; with it the user has to name the file
            (`trust.allow`, --task, --allow_code), as settings may be anybody's.
        config: its `env` (episodeLength, variant, the task's own keys), `randomization`, `effects` and `calibrated` are
            used; `task.randomize = False` gives the nominal task, with an empty parameter space. What a diagnosis
            identified (`effects=effects.yaml`) belongs to nominal physics.
        effects: further effects, after those of the config.
        env_overrides: `env:` settings that win over the config's, e.g. `episodeLength=100`; `numEnvs`, how many worlds
            step together, is what `impl=auto` goes by.

    Raises:
        UserError: on an unknown name or setting; on a class that is no task, or whose methods fail.
    """
    if name.split(":")[0] in EXTERNAL and ":" in name:
        if config is not None and (config.effects or config.calibrated):
            raise UserError(f"effects: {name} is not simulated here, so it cannot take any; leave them out")
        from bayessim_mjx import external

        env_overrides.pop("numEnvs", None)  # these choose their implementation themselves
        return external.make(name, config=config, **env_overrides)
    if is_file(name) and config is None:
        from bayessim_mjx.config import load

        trust.allow([name.rpartition(":")[0]])
        config = load(name)
    kind = class_of(name)
    if config is None:
        given: tuple = (env_overrides, None, effects)
    else:
        settings = {key: config.env[key] for key in config.env} | env_overrides
        own = (*_listed(config), *effects)
        given = (settings, config.randomization, own, storage.calibrated(config.calibrated))
    return _tried(name, kind, given) if is_file(name) else kind(*given)


def _listed(config: "Config") -> "tuple[Effect, ...]":
    """List the config's effects; on nominal physics those whose values are known, as the others are neutral there."""
    specs = config.effects
    if config.randomization.get("randomize") is False:
        specs = tuple(spec for spec in specs if spec.get("parameters"))
        if len(specs) < len(config.effects):
            warnings.warn("effects: they are off, because task.randomize = False means nominal physics", stacklevel=3)
    return reading.listed(specs)


def class_of(name: str) -> Any:
    """Find the class of a task of ours, of a file or of an installed package.

    Raises:
        UserError: there is none; it is no task, or cannot be imported.
    """
    no_file(name, "task")
    if is_file(name):
        path, _, title = name.rpartition(":")
        module = trust.module_of(Path(path), title, "task", "bayessim_mjx.tasks")
        if not hasattr(module, title):
            own = [n for n, kind in vars(module).items() if getattr(kind, "__module__", "") == module.__name__]
            raise UserError(f"task {name}: no class {title!r} in the file; it has: {', '.join(own) or 'none'}")
        return _checked(getattr(module, title), name)
    title = proper(name, "task")
    if title not in library():
        point = installed()[title]
        try:
            return _checked(point.load(), title)
        except (ImportError, AttributeError) as error:
            where = f"its entry point ({GROUP}) {point.value}"
            raise UserError(f"task {title!r}: {where} cannot be imported: {error}") from error
    snake = "".join(f"_{c.lower()}" if c.isupper() else c for c in title).lstrip("_")
    return getattr(importlib.import_module(f"bayessim_mjx.tasks.{snake}"), title)


def proper(name: str, what: str) -> str:
    """Return a task's name as `names()` has it; `what` says where it was given.

    Raises:
        UserError: no such task, with the close names and all that are allowed.
    """
    known = {title.lower(): title for title in names()}
    if (low := name.lower().replace("_", "")) in known:
        return known[low]
    if meant := [title for low, title in known.items() if f"-{low}-" in f"-{name.lower().replace('/', '-')}-"]:
        raise UserError(f"{what} {name!r} is unknown. Here it is called {meant[0]}")
    raise unknown(what, name, [*known.values(), "path/file.py:Class", *(f"{prefix}:<env>" for prefix in EXTERNAL)])


NEEDED = {"control_dt": "s", "default_episode_length": "control steps", "observation_names": "one for each number"}


def _checked(kind: Any, name: str) -> Any:
    """Return the class, if it is a whole task."""
    from bayessim_mjx.env import Task

    if not (isinstance(kind, type) and issubclass(kind, Task)):
        raise UserError(f"task {name}: {kind!r} is no subclass of bayessim_mjx.Task (docs/own_task.md)")
    if missing := sorted(kind.__abstractmethods__):
        raise UserError(f"task {name}: the class lacks the methods {', '.join(missing)} (docs/own_task.md)")
    for attribute, unit in NEEDED.items():
        if not hasattr(kind, attribute):
            raise UserError(f"task {name}: the class lacks `{attribute}` ({unit}; docs/own_task.md)")
    return kind


def _tried(name: str, kind: Any, given: tuple) -> "Env":
    """Make the environment of a user's file, its reset and step traced once: an error names the file and line."""
    import jax

    file = Path(name.rpartition(":")[0]).resolve()
    try:
        env = kind(*given)
        state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
        jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((env.action_size,), "float32"))
    except UserError:
        raise
    except Exception as error:
        said = re.sub(r"\s+", " ", str(error))
        raise UserError(f"task {name}{trust.line_of(error, file)}: {type(error).__name__}: {said}") from error
    return env


def no_file(name: str, what: str) -> None:
    """UserError where a task is a model's file, or code without its class; `what` says where it was given."""
    if PurePath(name).suffix.lower() == ".py":
        found = re.findall(r"^class (\w+)", Path(name).read_text(), re.MULTILINE) if Path(name).is_file() else []
        raise UserError(f"{what} {name!r}: give the class too, as in {name}:{found[-1] if found else 'MyTask'}")
    if PurePath(name).suffix.lower() in (".xml", ".mjcf", ".urdf"):
        raise UserError(
            f"{what} {name!r}: a model's file is no task, which has rewards and resets too. "
            f"`bayessim-mjx diagnose --model {name}` compares it with logs; docs/own_task.md makes a task of it"
        )
