"""What a diagnosis knows while its race goes on, on disk: a verdict takes minutes, and a process may be killed."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx.diagnosis.selection.tried import Tried
from bayessim_mjx.diagnosis.setup import Setup
from bayessim_mjx.diagnosis.summary.assemble import ranking

BEST = 20  # models listed


def write(path: Path, about: Mapping[str, Any], setup: Setup, race: Tried | None) -> None:
    """Write what is known so far, whole or not at all; no verdict is among it.

    Args:
        about: what is diagnosed; race: None before the first fit.
    """
    found = {"verdict": None, "about": dict(about), "warnings": list(setup.warnings)} | (
        {} if race is None else _so_far(race)
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(found | {"windows": len(setup.fitter.simulator.windows)}, indent=1) + "\n")
    os.replace(temporary, path)


def _so_far(race: Tried) -> dict[str, Any]:
    """Gaps in noise standard deviations, recalibrated parameters and the best models."""
    fit, noise = race.base.fit, race.noise * len(race.base.cost)
    nominal, _ = race.nominal.quadratic(race.fitter.spread)
    gap = {"nominal": np.sqrt(nominal.c.sum() / noise), "calibrated": np.sqrt(race.base.total / noise)}
    best = [{k: row[k] for k in ("label", "score", "se", "gap_closed", "parameters")} for row in ranking(race)[:BEST]]
    return {
        "gap": {k: float(v) for k, v in gap.items()},
        "parameters": dict(zip(fit.names, map(float, fit.values), strict=True)),
        "candidates": best,
    }
