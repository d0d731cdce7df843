"""Environments by name: `make("Ant")`, `make("brax:ant")`, `names()`. The only dynamic import of tasks."""

import difflib
import importlib
import warnings
from collections.abc import Sequence
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from bayessim_mjx.effects.support import reading, storage
from bayessim_mjx.errors import UserError
from bayessim_mjx.task_names import names

if TYPE_CHECKING:
    from bayessim_mjx.config.settings import Config
    from bayessim_mjx.effects.effect import Effect
    from bayessim_mjx.env import Env

__all__ = ["EXTERNAL", "make", "names"]

EXTERNAL = ("brax", "playground")


def make(name: str, *, config: "Config | None" = None, effects: "Sequence[Effect]" = (), **env_overrides: Any) -> "Env":
    """The environment called `name`, at the task's defaults where neither `config` nor an override says otherwise.

    Args:
        name: a name from `names()` (case and underscores do not matter), "brax:<env>" or "playground:<env>".
        config: its `env` (episodeLength, variant, the task's own keys), `randomization`, `effects` and `calibrated` are
            used; `task.randomize = False` gives the nominal task, with an empty parameter space. What a diagnosis
            identified (`effects=effects.yaml`) belongs to nominal physics.
        effects: further effects, after those of the config.
        env_overrides: `env:` settings that win over the config's, e.g. `episodeLength=100`; `numEnvs`, how many worlds
            step together, is what `impl=auto` goes by.

    Raises:
        UserError: on an unknown name or setting.
    """
    if name.split(":")[0] in EXTERNAL and ":" in name:
        if config is not None and (config.effects or config.calibrated):
            raise UserError(f"effects: {name} is not simulated here, so it cannot take any; leave them out")
        from bayessim_mjx import external

        env_overrides.pop("numEnvs", None)  # these choose their implementation themselves
        return external.make(name, config=config, **env_overrides)
    kind = _task(name)
    if config is None:
        return kind(env_overrides, None, effects)
    settings = {key: config.env[key] for key in config.env} | env_overrides
    own = (*_listed(config), *effects)
    return kind(settings, config.randomization, own, storage.calibrated(config.calibrated))


def _listed(config: "Config") -> "tuple[Effect, ...]":
    """The config's effects; on nominal physics those whose values are known, as the others are neutral there."""
    specs = config.effects
    if config.randomization.get("randomize") is False:
        specs = tuple(spec for spec in specs if spec.get("parameters"))
        if len(specs) < len(config.effects):
            warnings.warn("effects: they are off, because task.randomize = False means nominal physics", stacklevel=3)
    return reading.listed(specs)


def _task(name: str) -> Any:
    no_file(name, "task")
    known = {title.lower(): title for title in names()}
    title = known.get(name.lower().replace("_", ""))
    if title is None:
        close = difflib.get_close_matches(name.lower(), known)
        hint = f"did you mean {known[close[0]]}? " if close else ""
        external = ", ".join(f"{prefix}:<env>" for prefix in EXTERNAL)
        raise UserError(f"task {name!r}: {hint}there are: {', '.join(names())}, {external}")
    snake = "".join(f"_{c.lower()}" if c.isupper() else c for c in title).lstrip("_")
    return getattr(importlib.import_module(f"bayessim_mjx.tasks.{snake}"), title)


def no_file(name: str, what: str) -> None:
    """UserError where the file of a model is given for the name of a task; `what` says where it was given."""
    if PurePath(name).suffix.lower() in (".xml", ".mjcf", ".urdf"):
        raise UserError(
            f"{what} {name!r}: a model's file is no task, which has rewards and resets too. "
            f"`bayessim-mjx diagnose --model {name}` compares it with logs; docs/own_task.md makes a task of it"
        )
