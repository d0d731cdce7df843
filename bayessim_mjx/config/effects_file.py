"""effects.yaml as a diagnosis writes it: its outer form, which settings take over whole."""

from pathlib import Path
from typing import Any

from bayessim_mjx.config.yaml_text import read_yaml
from bayessim_mjx.errors import UserError, unknown

EFFECTS_SCHEMA = 1
EFFECTS_KEYS = ("schema", "effects", "calibrated")


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
