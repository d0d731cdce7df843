"""The extensions of PPO that there are, each in its own file, and which of them the settings switch on.

One of your own is a subclass of `Extension`: as an object in `PPOConfig(extensions=(Mine(weight=0.1),))`, or installed
under the entry point group `bayessim_mjx.ppo_extensions` and named in settings, `{extension: NAME, weight: 0.1}`.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
from collections.abc import Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from jax.sharding import Mesh

from bayessim_mjx.config import PPOConfig, refuse_together
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl.extension import Extension, Learner
from bayessim_mjx.rl.groups import CriticGroups
from bayessim_mjx.rl.privileged import CriticTheta
from bayessim_mjx.rl.rnd import Novelty
from bayessim_mjx.rl.state import FIELDS
from bayessim_mjx.rl.symmetry import Symmetry

if TYPE_CHECKING:
    from bayessim_mjx.env import Env

EXTENSIONS: tuple[type[Extension], ...] = (CriticGroups, CriticTheta, Novelty, Symmetry)
ENTRY_POINTS = "bayessim_mjx.ppo_extensions"


@lru_cache(maxsize=32)
def active(config: PPOConfig) -> tuple[Extension, ...]:
    """Those that the settings switch on, one's own last; UserError."""
    built_in = [extension for kind in EXTENSIONS if (extension := kind.of(config)) is not None]
    own = [_installed(given) if isinstance(given, Mapping) else _checked(given) for given in config.extensions]
    names = [extension.name for extension in (*built_in, *own)]
    for extension in own:
        if names.count(extension.name) > 1:
            raise UserError(f"ppo.extensions: {extension.name!r} is there twice; leave one of them out")
        _refuse_together(extension, names, config)
    return (*built_in, *own)


def learner(env: Env, config: PPOConfig, mesh: Mesh | None = None) -> Learner:
    """Environment and settings as the learner sees them."""
    extensions = active(config)
    for extension in extensions:
        env = extension.shown(env)
    return Learner(env, config, extensions, mesh)


def _refuse_together(extension: Extension, names: list[str], config: PPOConfig) -> None:
    settings = {f.name for f in dataclasses.fields(config)}
    refuse_together({k: why for k, why in extension.incompatible_with.items() if k in settings}, config)
    for name, why in extension.incompatible_with.items():
        if name in names:
            raise UserError(f"ppo.extensions: {extension.name!r} with {name!r}: {why}")


def _installed(given: Mapping[str, Any]) -> Extension:
    """Load the extension `{extension: NAME, setting: value, ...}` of an installed package."""
    points = {point.name: point for point in importlib.metadata.entry_points(group=ENTRY_POINTS)}
    name, settings = given["extension"], {k: v for k, v in given.items() if k != "extension"}
    if name not in points:
        there = ", ".join(sorted(points)) or "none"
        raise UserError(f"ppo.extensions: no extension {name!r}; installed are: {there} (entry points {ENTRY_POINTS})")
    try:
        kind = points[name].load()
    except (Exception, SystemExit) as error:
        raise UserError(f"ppo.extensions: {name!r}: its package cannot be imported: {error}") from error
    if not (isinstance(kind, type) and dataclasses.is_dataclass(kind)):
        raise UserError(f"ppo.extensions: {name!r} is {kind!r}: expected a class with @dataclass(frozen=True)")
    allowed = [f.name for f in dataclasses.fields(kind)]
    for key in settings:
        if key not in allowed:
            raise UserError(f"ppo.extensions: {name!r} has no setting {key!r}; allowed are {', '.join(allowed)}")
    try:
        return _checked(kind(**settings))
    except TypeError as error:
        raise UserError(f"ppo.extensions: {name!r}: {error}") from None


def _checked(extension: Any) -> Extension:
    """Return the object, if it keeps the contract."""
    kind = type(extension)
    if not isinstance(extension, Extension):
        raise UserError(f"ppo.extensions: {extension!r} is no object of a subclass of bayessim_mjx.rl.Extension")
    name = getattr(kind, "name", None)
    if not isinstance(name, str) or not name.isidentifier() or name in FIELDS:
        taken = ", ".join(FIELDS)
        raise UserError(f"ppo.extensions: {kind.__name__}.name = {name!r}: expected a word that is not one of {taken}")
    if name in {known.name for known in EXTENSIONS}:
        raise UserError(f"ppo.extensions: {kind.__name__}.name = {name!r}: there is one already; give it another name")
    if not dataclasses.is_dataclass(kind) or not kind.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise UserError(f"ppo.extensions: {kind.__name__} lacks @dataclass(frozen=True)")
    return extension
