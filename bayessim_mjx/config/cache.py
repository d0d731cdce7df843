"""The user's folder of what is kept from run to run."""

import os
from pathlib import Path

VARIABLE = "BAYESSIM_MJX_CACHE"
OFF = "off"
DEFAULT = "~/.cache/bayessim_mjx"


def folder() -> Path | None:
    """$BAYESSIM_MJX_CACHE, or ~/.cache/bayessim_mjx; None where the variable says off."""
    chosen = os.environ.get(VARIABLE)
    return None if chosen == OFF else Path(chosen or DEFAULT).expanduser()
