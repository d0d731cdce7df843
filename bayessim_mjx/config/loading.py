"""Typed configuration, loaded strictly from YAML files, flags and dotted overrides.

Layers, later ones win: defaults < cfg/<task>.yaml < --cfg_env < --cfg_train < flags < `section.key=value`.
A file's `task.randomization_params`, `env.realParams` and `effects` replace earlier ones whole; an override changes
one entry. `task.randomization_params` alone may thus have fewer parameters than the task's own file. `effects` may be
the path of an effects.yaml, whose contents then are the setting.
`env.numEnvs` and `ppo.num_envs` are one number: giving either sets both.
"""

import dataclasses
import difflib
import re
import typing
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bayessim_mjx import trust
from bayessim_mjx.config import foreign
from bayessim_mjx.config.settings import (
    YAML_NAMES,
    BayesSimConfig,
    Config,
    EnvConfig,
    Frozen,
    MonitorConfig,
    PPOConfig,
    RealConfig,
    RNDConfig,
    Section,
    SymmetryConfig,
    WeightSchedule,
    checked,
    coerce,
    freeze,
    thaw,
)
from bayessim_mjx.config.yaml_text import DEPTH, read_value, read_yaml, to_yaml
from bayessim_mjx.errors import UserError, unknown

__all__ = [
    "BayesSimConfig", "Config", "EnvConfig", "Frozen", "MonitorConfig", "PPOConfig", "RNDConfig", "RealConfig",
    "Section", "SymmetryConfig", "WeightSchedule", "cfg_folder", "freeze", "from_dict", "load", "read_effects",
    "read_yaml", "replace", "task_file", "thaw", "to_yaml", "unknown",
]  # fmt: skip

Layer = tuple[str, Mapping[str, Any], bool]  # where it comes from, nested values, is it a file (else flag or override)
SECTIONS: dict[str, type[Section]] = {
    "env": EnvConfig, "bayessim": BayesSimConfig, "ppo": PPOConfig, "real": RealConfig, "monitor": MonitorConfig,
}  # fmt: skip
TOP_KEYS = [YAML_NAMES.get(f.name, f.name) for f in dataclasses.fields(Config)]
TASK_KEYS = ("randomize", "randomization_params")
PARAMS = "task.randomization_params"
NEW_GROUPS = ("option", "effects")  # which an override may add; what is in `effects` is for the effects to check
RANDOMIZED_KEYS = (
    "range", "operation", "distribution", "mean", "sd", "nominal", "include", "exclude", "factor", "unit", "schedule",
    "schedule_steps", "num_buckets", "setup_only",
)  # fmt: skip
NUISANCE_KEYS = ("observations", "actions", "sim_params")  # noise: two numbers of their own meaning, nothing inferred
REAL_KEYS = ("weights", "means", "stds")
OPERATIONS = ("scaling", "additive", "absolute")
EFFECTS_SCHEMA = 1
DICT = "dict"  # the source of settings that are no file
EFFECTS_KEYS = ("schema", "effects", "calibrated")


def cfg_folder() -> Path:
    """The folder of task YAMLs: inside the package in a wheel, beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    return next((f for f in (package / "cfg", package.parent / "cfg") if f.is_dir()), package / "cfg")


def task_file(task: str) -> Path:
    """cfg/<task in snake case>.yaml (which need not exist)."""
    return cfg_folder() / (re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", task).lower() + ".yaml")


def load(
    task: str | None = None,
    *,
    cfg_env: str | Path | None = None,
    cfg_train: str | Path | None = None,
    flags: Mapping[str, tuple[str, Any]] | None = None,
    overrides: Iterable[str] = (),
) -> Config:
    """The configuration of `task` with all layers applied.

    `flags` maps a flag's name to (dotted key, value), e.g. {"--num_envs": ("env.numEnvs", 64)}; `overrides` are
    "section.key=value" texts. `task` may be left out where `cfg_env` holds `task_name`. Raises UserError.
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
    """A Config from plain nested dicts with the YAML names (the inverse of `Config.to_dict`). `raw` is not changed."""
    task = task or raw.get("task_name")
    if not task:
        raise UserError(f"{source}: no task_name")
    return _build(task, [(source, raw, True)])


def replace(config: Config, **sections: Any) -> Config:
    """A changed copy: `replace(config, ppo={"gamma": 0.9}, seed=3)`."""
    changed = {
        k: dataclasses.replace(getattr(config, k), **v) if isinstance(getattr(config, k), Section) else v
        for k, v in sections.items()
    }
    return dataclasses.replace(config, **changed)


def read_effects(path: str | Path) -> dict[str, Any]:
    """`effects` and `calibrated` of an effects.yaml (see `effects/storage.py`), not looked into."""
    raw = read_yaml(path)
    for key in raw:
        if key not in EFFECTS_KEYS:
            raise unknown(f"{path}: key", str(key), EFFECTS_KEYS)
    if raw.get("schema") != EFFECTS_SCHEMA:
        raise UserError(
            f"{path}: schema = {raw.get('schema')!r}: expected schema: {EFFECTS_SCHEMA}, as a diagnosis writes"
        )
    return {key: raw.get(key) or [] for key in EFFECTS_KEYS[1:]}


def _train_layer(path: str | Path) -> dict[str, Any]:
    """A --cfg_train file: a `ppo:` section alone, or its keys bare."""
    raw = read_yaml(path)
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
        _merge(merged, foreign.without(raw, declared) if is_file else raw, source, is_file, declared)
    merged.pop("task_name", None)
    known = {f.name for f in dataclasses.fields(EnvConfig)}
    env = merged.pop("env", {})
    options = {k: v for k, v in env.items() if k not in known}
    sections: dict[str, Any] = {k: cls(**merged.pop(k, {})) for k, cls in SECTIONS.items() if k != "env"}
    sections["env"] = EnvConfig(**{k: v for k, v in env.items() if k in known}, options=Frozen(freeze(options)))
    return Config(task=task, randomization=Frozen(freeze(merged.pop("task", {}))), **sections, **merged)


def _merge(merged: dict[str, Any], raw: Mapping[str, Any], source: str, is_file: bool, declared: Mapping) -> None:
    """Check one layer and write it over what is there; the layer itself is never changed."""
    for key, value in _with_effects(raw, source, is_file).items():
        if key not in TOP_KEYS:
            raise unknown(f"{source}: key", str(key), TOP_KEYS + _dotted(str(key)))
        if key == "task_name":
            if value != merged["task_name"]:
                raise UserError(f"{source}: task_name = {value!r}, but the task is {merged['task_name']!r}")
        elif key in SECTIONS or key == "task":
            if value is not None and not isinstance(value, Mapping):
                raise UserError(f"{key} = {value!r} ({source}): expected a section of `key: value` lines")
            merge = _merge_task if key == "task" else _merge_section
            value = _one_length(value or {}, source) if key == "env" else value
            merge(merged.setdefault(key, {}), value or {}, source, is_file, key, declared)  # type: ignore[operator]
        else:
            merged[key] = _field(Config, key, value, key, source)
    sizes = [(raw.get("env") or {}).get("numEnvs"), (raw.get("ppo") or {}).get("num_envs")]
    given = [n for n in sizes if n is not None]
    if given and given[0] != given[-1]:
        raise UserError(f"{source}: env.numEnvs = {given[0]} and ppo.num_envs = {given[1]} are one setting; give one")
    if given:
        merged.setdefault("env", {})["numEnvs"] = merged.setdefault("ppo", {})["num_envs"] = given[0]


def _one_length(env: Mapping[str, Any], source: str) -> Mapping[str, Any]:
    """`env:` with maxEpisodeLength under the name episodeLength; some of BayesSimIG's files call it so."""
    if "maxEpisodeLength" not in env:
        return env
    longest, rest = env["maxEpisodeLength"], {k: v for k, v in env.items() if k != "maxEpisodeLength"}
    if rest.get("episodeLength", longest) != longest:
        given = rest["episodeLength"]
        raise UserError(f"{source}: env.episodeLength = {given} and env.maxEpisodeLength = {longest} are one setting")
    return {**rest, "episodeLength": longest}


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


def _with_effects(raw: Mapping[str, Any], source: str, is_file: bool) -> Mapping[str, Any]:
    """The layer with the contents of its effects.yaml; effects without calibrated parameters replace those before."""
    effects = raw.get("effects")
    if not is_file and isinstance(effects, list | tuple):  # named on the command line itself
        specs = [str(e.get("effect")) for e in effects if isinstance(e, Mapping)]
        trust.allow(spec.rpartition(":")[0] for spec in specs if ".py:" in spec)
    if not isinstance(effects, str):
        return {"calibrated": [], **raw} if "effects" in raw else raw
    if not Path(effects).is_file():
        raise UserError(
            f"effects = {effects!r} ({source}): no such file; expected an effects.yaml or a list of {{effect, where}}"
        )
    return {**raw, **read_effects(effects)}


def _merge_section(
    merged: dict, raw: Mapping, source: str, is_file: bool, section: str, declared: Mapping[str, Any]
) -> None:
    cls = SECTIONS[section]
    fields = [f.name for f in dataclasses.fields(cls) if f.name != "options"]  # type: ignore[arg-type]
    extra = [k for k in declared if k not in fields] if section == "env" else []
    for key, value in raw.items():
        path = f"{section}.{key}"
        if key in ("numEnvs", "num_envs") and value is None:
            continue  # null: the other of the two names decides
        if key in fields:
            if key == "realParams" and isinstance(value, Mapping):
                value = _real_params(value, {} if is_file else merged.get(key) or {}, source)
            if (nested := subsection(cls, key)) and isinstance(value, Mapping):
                merged[key] = _merge_nested(nested, merged.get(key) or {}, value, path, source)
            else:
                merged[key] = _field(cls, key, value, path, source)
        elif key in extra:
            merged[key] = _like(value, declared[key], path, source)
        else:
            raise unknown(f"{source}: key", path, [f"{section}.{k}" for k in [*fields, *extra]])


def subsection(cls: type[Section], key: str) -> type[Section] | None:
    """The class of a setting that is a section of its own, such as ppo.rnd."""
    options = (o for o in typing.get_args(typing.get_type_hints(cls)[key]) if isinstance(o, type))
    return next((o for o in options if issubclass(o, Section)), None)


def _merge_nested(cls: type[Section], merged: Mapping, raw: Mapping, path: str, source: str) -> dict[str, Any]:
    """Plain values of a section within a section: checked one by one here, and together when all layers are there."""
    fields, merged = [f.name for f in dataclasses.fields(cls)], dict(merged)  # type: ignore[arg-type]
    for key, value in raw.items():
        if key not in fields:
            raise unknown(f"{source}: key", f"{path}.{key}", [f"{path}.{k}" for k in fields])
        if (nested := subsection(cls, key)) and isinstance(value, Mapping):
            merged[key] = _merge_nested(nested, merged.get(key) or {}, value, f"{path}.{key}", source)
        else:
            merged[key] = _field(cls, key, value, f"{path}.{key}", source)
    return merged


def _real_params(value: Mapping, base: Mapping, source: str) -> dict[str, Any]:
    """{weights, means, stds}; rows are lists, or {parameter name: value} (checked against the task's parameters)."""
    wrong = next((k for k in value if k not in REAL_KEYS), None)
    if wrong is not None:
        raise unknown(f"{source}: key", f"env.realParams.{wrong}", [f"env.realParams.{k}" for k in REAL_KEYS])
    return {**base, **value}


def _merge_task(merged: dict, raw: Mapping, source: str, is_file: bool, section: str, declared: Mapping) -> None:
    """`task:`: a file gives the randomised parameters whole, an override changes what is there."""
    for key, value in raw.items():
        if key not in TASK_KEYS:
            raise unknown(f"{source}: key", f"task.{key}", [f"task.{k}" for k in TASK_KEYS])
        if key == "randomize":
            merged[key] = coerce(value, bool, "task.randomize", source)
        else:
            value = coerce(value or {}, Frozen, f"task.{key}", source)
            merged[key] = thaw(value) if is_file else _deep(merged.get(key, {}), value, f"task.{key}", source)
            _check_ranges(merged[key], f"task.{key}", source)


def _deep(base: Any, change: Any, path: str, source: str) -> Any:
    if not isinstance(change, Mapping) or not isinstance(base, Mapping):
        return thaw(change)
    more = RANDOMIZED_KEYS if "range" in base else NEW_GROUPS if path == PARAMS else ()
    allowed = list(dict.fromkeys([*base, *more]))
    for key in change:
        if key not in allowed and path.count(".") > 0 and not path.startswith(f"{PARAMS}.effects"):
            raise unknown(f"{source}: key", f"{path}.{key}", [f"{path}.{k}" for k in allowed])
    return {**base, **{k: _deep(base.get(k), v, f"{path}.{k}", source) for k, v in change.items()}}


def _check_ranges(node: Any, path: str, source: str) -> None:
    """Every `range` below `node` is [low, high] with low < high; other nonsense is the parameter space's to refuse."""
    if not isinstance(node, Mapping):
        return
    if "range" in node:
        low_high = coerce(node["range"], tuple[float, ...], f"{path}.range", source)
        if len(low_high) != 2 or low_high[0] >= low_high[1]:
            raise UserError(f"{path}.range = {list(low_high)} ({source}): expected [low, high] with low < high")
        if node.get("operation", "scaling") not in OPERATIONS:
            raise unknown(f"{source}: {path}.operation", str(node["operation"]), OPERATIONS)
    for key, value in node.items():
        if key not in NUISANCE_KEYS:
            _check_ranges(value, f"{path}.{key}", source)


def _field(cls: type[Section], key: str, value: Any, path: str, source: str) -> Any:
    name = next((n for n, y in YAML_NAMES.items() if cls is Config and y == key), key)
    hint = typing.get_type_hints(cls)[name]
    metadata = next(f.metadata for f in dataclasses.fields(cls) if f.name == name)  # type: ignore[arg-type]
    return checked(value, hint, metadata, path, source)


def _like(value: Any, default: Any, path: str, source: str) -> Any:
    """A task's own setting: of the type its cfg file has."""
    if default is None or value is None:
        return value
    if isinstance(default, list):
        return coerce(value, tuple[Any, ...], path, source)
    return coerce(value, dict if isinstance(default, Mapping) else type(default), path, source)


def _dotted(key: str) -> list[str]:
    """Full names of the section keys that are called nearly `key`: the hint for a forgotten section."""
    names = {f.name: f"{s}.{f.name}" for s, cls in SECTIONS.items() for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    return [names[n] for n in difflib.get_close_matches(key, names, n=2, cutoff=0.7)]
