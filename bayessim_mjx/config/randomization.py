"""`task:` of the settings: whether physics are randomised, and which parameters over which ranges."""

from collections.abc import Mapping
from typing import Any

from bayessim_mjx.config.settings import Frozen, coerce, thaw
from bayessim_mjx.errors import UserError, unknown

TASK_KEYS = ("randomize", "randomization_params")
PARAMS = "task.randomization_params"
NEW_GROUPS = ("option", "effects")  # which an override may add; what is in `effects` is for the effects to check
RANDOMIZED_KEYS = (
    "range", "operation", "distribution", "mean", "sd", "nominal", "include", "exclude", "factor", "unit", "schedule",
    "schedule_steps", "num_buckets", "setup_only", "zero",
)  # fmt: skip
NUISANCE_KEYS = ("observations", "actions", "sim_params")  # noise: two numbers of their own meaning, nothing inferred
OPERATIONS = ("scaling", "additive", "absolute")


def merge_task(merged: dict, raw: Mapping, source: str, is_file: bool, section: str, declared: Mapping) -> None:
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
