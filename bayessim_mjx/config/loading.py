"""Typed configuration, loaded strictly from YAML files, flags and dotted overrides.

Layers, later ones win: defaults < cfg/<task>.yaml < --cfg_env < --cfg_train < flags < `section.key=value`.
A file's `task.randomization_params`, `env.realParams` and `effects` replace earlier ones whole; an override changes
one entry. `task.randomization_params` alone may thus have fewer parameters than the task's own file. `effects` may be
the path of an effects.yaml, whose contents then are the setting.
`env.numEnvs` and `ppo.num_envs` are one number: giving either sets both.
"""

import dataclasses
import functools
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bayessim_mjx import outside_tasks
from bayessim_mjx.config import foreign
from bayessim_mjx.config.layers import SECTIONS, Layer, merge
from bayessim_mjx.config.settings import Config, EnvConfig, Frozen, Section, freeze
from bayessim_mjx.config.yaml_text import DEPTH, read_value, read_yaml
from bayessim_mjx.errors import UserError

DICT = "dict"  # the source of settings that are no file
CACHE = "BAYESSIM_MJX_CACHE"
CACHE_OFF = "off"
CACHE_DEFAULT = "~/.cache/bayessim_mjx"


def cfg_folder() -> Path:
    """Find the folder of task YAMLs: inside the package in a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    return next((f for f in (package / "cfg", package.parent / "cfg") if f.is_dir()), package / "cfg")


def task_file(task: str) -> Path:
    """cfg/<task in snake case>.yaml, or that beside the file of a task outside of the library; it need not exist."""
    snake = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", outside_tasks.short(task)).lower()
    own = cfg_folder() / f"{snake}.yaml"
    ours = own.is_file() and not outside_tasks.is_file(task)
    return own if ours else outside_tasks.settings_beside(task) or own


def load(
    task: str | None = None,
    *,
    cfg_env: str | Path | None = None,
    cfg_train: str | Path | None = None,
    flags: Mapping[str, tuple[str, Any]] | None = None,
    overrides: Iterable[str] = (),
) -> Config:
    """Load the configuration of `task` with all layers applied.

    Args:
        task: its name; may be left out where `cfg_env` holds `task_name`.
        cfg_env, cfg_train: YAML files over cfg/<task>.yaml; the second holds PPO settings.
        flags: {flag: (dotted key, value)}, e.g. {"--num_envs": ("env.numEnvs", 64)}.
        overrides: "section.key=value" texts.

    Raises:
        UserError: naming the value, its file, flag or override, and what is allowed.
    """
    files: list[Layer] = []
    if cfg_env is not None:
        files.append((str(cfg_env), read_yaml(cfg_env), True))
    if cfg_train is not None:
        files.append((str(cfg_train), _train_layer(cfg_train), True))
    task = task or next((str(raw["task_name"]) for _, raw, _ in files if raw.get("task_name")), None)
    if not task:
        raise UserError("no task: give --task NAME (--list_tasks shows the names)")
    more = [(flag, _nested(key, value), False) for flag, (key, value) in (flags or {}).items()]
    return _build(task, [*files, *more, *map(_override, overrides)])


def from_dict(raw: Mapping[str, Any], task: str | None = None, source: str = DICT) -> Config:
    """Make a Config from plain nested dicts with the YAML names (inverse of `Config.to_dict`); `raw` is not changed."""
    task = task or raw.get("task_name")
    if not task:
        raise UserError(f"{source}: no task_name")
    return _build(task, [(source, raw, True)])


def replace(config: Config, **sections: Any) -> Config:
    """Return a changed copy: `replace(config, ppo={"gamma": 0.9}, seed=3)`."""
    changed = {
        k: dataclasses.replace(getattr(config, k), **v) if isinstance(getattr(config, k), Section) else v
        for k, v in sections.items()
    }
    return dataclasses.replace(config, **changed)


def _train_layer(path: str | Path) -> dict[str, Any]:
    """Read a --cfg_train file: a `ppo:` section alone, its keys bare, or `policy:` and `learn:` as BayesSimIG's."""
    raw = read_yaml(path)
    if foreign.is_rlpt(raw):
        return foreign.read_rlpt(raw, str(path))
    if "ppo" not in raw:
        return {"ppo": raw}
    if len(raw) > 1:
        others = ", ".join(k for k in raw if k != "ppo")
        raise UserError(f"{path}: {others} beside `ppo:`: other sections belong in a --cfg_env file")
    return raw


def _nested(key: str, value: Any) -> dict[str, Any]:
    for part in reversed(key.split(".")):
        value = {part: value}
    return value


def _override(text: str) -> Layer:
    """`a.b=[1, 2]` as a layer; the value is YAML."""
    key, equals, value = text.partition("=")
    if not equals or not re.fullmatch(r"\w[\w.:-]*", key) or key.count(".") > DEPTH:
        raise UserError(f"override {text[:80]!r}: expected section.key=value, e.g. bayessim.components=5")
    source = f"override {text[:200]!r}"
    return source, _nested(key, read_value(value, source)), False


def _build(task: str, layers: Sequence[Layer]) -> Config:
    own = task_file(task)
    base: list[Layer] = [(str(own), read_yaml(own), True)] if own.is_file() else []
    declared = dict(base[0][1].get("env") or {}) if base else {}
    _one_number_of_worlds(layers)
    merged: dict[str, Any] = {"task_name": task}
    for source, raw, is_file in [*base, *layers]:
        if is_file and source != DICT:
            foreign.note(raw, source, declared)
        merge(merged, foreign.without(raw, declared) if is_file else raw, source, is_file, declared)
    merged.pop("task_name", None)
    known = {f.name for f in dataclasses.fields(EnvConfig)}
    env = merged.pop("env", {})
    options = {k: v for k, v in env.items() if k not in known}
    sections: dict[str, Any] = {k: cls(**merged.pop(k, {})) for k, cls in SECTIONS.items() if k != "env"}
    sections["env"] = EnvConfig(**{k: v for k, v in env.items() if k in known}, options=Frozen(freeze(options)))
    return Config(task=task, randomization=Frozen(freeze(merged.pop("task", {}))), **sections, **merged)


def _one_number_of_worlds(layers: Sequence[Layer]) -> None:
    """env.numEnvs and ppo.num_envs are one setting: the command line may not give two numbers for it."""
    given: dict[str, tuple[str, Any]] = {}
    for source, raw, is_file in layers:
        for section, key in (("env", "numEnvs"), ("ppo", "num_envs")):
            value = raw[section].get(key) if isinstance(raw.get(section), Mapping) else None
            if value is not None and not is_file:
                given[f"{section}.{key}"] = (source, value)
    if len(given) == 2 and len({str(value) for _, value in given.values()}) == 2:
        (a, (one, _)), (b, (two, _)) = given.items()
        raise UserError(f"{a} and {b} are one setting, but {one} and {two} give two numbers; give one of them")


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


def cache_folder() -> Path | None:
    """$BAYESSIM_MJX_CACHE, or ~/.cache/bayessim_mjx; None where the variable says off."""
    chosen = os.environ.get(CACHE)
    return None if chosen == CACHE_OFF else Path(chosen or CACHE_DEFAULT).expanduser()
