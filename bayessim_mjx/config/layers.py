"""One layer of settings after the other: each is checked on its own and written over what is there."""

import dataclasses
import typing
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bayessim_mjx import trust
from bayessim_mjx.config import listing
from bayessim_mjx.config.settings import (
    YAML_NAMES,
    BayesSimConfig,
    Config,
    EnvConfig,
    Frozen,
    MonitorConfig,
    PPOConfig,
    RealConfig,
    Section,
    checked,
    coerce,
    thaw,
)
from bayessim_mjx.config.yaml_text import read_yaml
from bayessim_mjx.errors import UserError, nearest, unknown

Layer = tuple[str, Mapping[str, Any], bool]  # where it comes from, nested values, is it a file (else flag or override)
SECTIONS: dict[str, type[Section]] = {
    "env": EnvConfig, "bayessim": BayesSimConfig, "ppo": PPOConfig, "real": RealConfig, "monitor": MonitorConfig,
}  # fmt: skip
TOP_KEYS = [YAML_NAMES.get(f.name, f.name) for f in dataclasses.fields(Config)]
REAL_KEYS = ("weights", "means", "stds")
EFFECTS_SCHEMA = 1
EFFECTS_KEYS = ("schema", "effects", "calibrated", "simulated")
TASK_KEYS = ("randomize", "randomization_params")
PARAMS = "task.randomization_params"
NEW_GROUPS = ("option", "effects")  # which an override may add; what is in `effects` is for the effects to check
RANDOMIZED_KEYS = (
    "range", "operation", "distribution", "mean", "sd", "nominal", "include", "exclude", "factor", "unit", "schedule",
    "schedule_steps", "num_buckets", "setup_only", "zero",
)  # fmt: skip
NUISANCE_KEYS = ("observations", "actions", "sim_params")  # noise: two numbers of their own meaning, nothing inferred
OPERATIONS = ("scaling", "additive", "absolute")


def merge(merged: dict[str, Any], raw: Mapping[str, Any], source: str, is_file: bool, declared: Mapping) -> None:
    """Check one layer and write it over what is there; the layer itself is never changed."""
    for key, value in _with_effects(raw, source, is_file).items():
        if key not in TOP_KEYS:
            raise unknown(f"{source}: key", str(key), TOP_KEYS + _dotted(str(key)), listing.COMMAND)
        if key == "task_name":
            if value != merged["task_name"]:
                raise UserError(f"{source}: task_name = {value!r}, but the task is {merged['task_name']!r}")
        elif key in SECTIONS or key == "task":
            if value is not None and not isinstance(value, Mapping):
                raise UserError(f"{key} = {value!r} ({source}): expected a section of `key: value` lines")
            below = merged.setdefault(key, {})
            if key == "task":
                _merge_task(below, value or {}, source, is_file)
            else:
                value = _one_length(value or {}, source) if key == "env" else value
                _merge_section(below, value or {}, source, is_file, key, declared)
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


def _with_effects(raw: Mapping[str, Any], source: str, is_file: bool) -> Mapping[str, Any]:
    """Add the contents of the layer's effects.yaml; effects without calibrated parameters replace those before."""
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
    found = read_effects(effects)
    _note_stepping(effects)
    return {**raw, **found}


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
            if (nested := _subsection(cls, key)) and isinstance(value, Mapping):
                merged[key] = _merge_nested(nested, merged.get(key) or {}, value, path, source)
            else:
                merged[key] = _field(cls, key, value, path, source)
        elif key in extra:
            merged[key] = _like(value, declared[key], path, source)
        else:
            raise unknown(
                f"{source}: key", path, [f"{section}.{k}" for k in [*fields, *extra]], f"{listing.COMMAND} {section}"
            )


def _subsection(cls: type[Section], key: str) -> type[Section] | None:
    """Find the class of a setting that is a section of its own, such as ppo.rnd."""
    options = (o for o in typing.get_args(typing.get_type_hints(cls)[key]) if isinstance(o, type))
    return next((o for o in options if issubclass(o, Section)), None)


def _merge_nested(cls: type[Section], merged: Mapping, raw: Mapping, path: str, source: str) -> dict[str, Any]:
    """Plain values of a section within a section: checked one by one here, and together when all layers are there."""
    fields, merged = [f.name for f in dataclasses.fields(cls)], dict(merged)  # type: ignore[arg-type]
    for key, value in raw.items():
        if key not in fields:
            raise unknown(f"{source}: key", f"{path}.{key}", [f"{path}.{k}" for k in fields])
        if (nested := _subsection(cls, key)) and isinstance(value, Mapping):
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


def _field(cls: type[Section], key: str, value: Any, path: str, source: str) -> Any:
    name = next((n for n, y in YAML_NAMES.items() if cls is Config and y == key), key)
    hint = typing.get_type_hints(cls)[name]
    metadata = next(f.metadata for f in dataclasses.fields(cls) if f.name == name)  # type: ignore[arg-type]
    return checked(value, hint, metadata, path, source)


def _like(value: Any, default: Any, path: str, source: str) -> Any:
    """Convert a task's own setting to the type that its cfg file has."""
    if default is None or value is None:
        return value
    if isinstance(default, list):
        return coerce(value, tuple[Any, ...], path, source)
    return coerce(value, dict if isinstance(default, Mapping) else type(default), path, source)


def _dotted(key: str) -> list[str]:
    """Full names of the section keys that are called nearly `key`: the hint for a forgotten section."""
    names = {f.name: f"{s}.{f.name}" for s, cls in SECTIONS.items() for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    return [names[n] for n in nearest(key, names, 2, 0.7)]


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
    return {key: raw.get(key) or [] for key in EFFECTS_KEYS[1:3]}


def _note_stepping(path: str) -> None:
    """Warn where the numbers of an effects.yaml belong to another integrator or time step than a model was given."""
    found = read_yaml(path).get("simulated")
    if isinstance(found, Mapping):
        option = " ".join(f'{key}="{found.get(key)}"' for key in ("integrator", "timestep"))
        text = f"effects = {path}: the diagnosis simulated with <option {option}/>, and its errors hold for that"
        warnings.warn(f"{text}; set it in the task's model, which keeps its own integrator and time step", stacklevel=2)


def _merge_task(merged: dict, raw: Mapping, source: str, is_file: bool) -> None:
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
