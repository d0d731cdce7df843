"""What a diagnosis knows while its race goes on, on disk: a verdict takes minutes, and a process may be killed."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx.diagnosis.selection.race import Race
from bayessim_mjx.diagnosis.setup import Setup
from bayessim_mjx.diagnosis.summary.assemble import ranking

BEST = 20  # models listed


def write(path: Path, about: dict[str, Any], warnings: Sequence[str], setup: Setup, race: Race | None) -> None:
    """Write what is known so far, whole or not at all; no verdict is among it.

    Args:
        race: None before the first fit.
    """
    found = {"verdict": None, "about": about, "warnings": list(warnings)} | ({} if race is None else _so_far(race))
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".tmp")
    temporary.write_text(json.dumps(found | {"windows": len(setup.fitter.simulator.windows)}, indent=1) + "\n")
    os.replace(temporary, path)


def _so_far(race: Race) -> dict[str, Any]:
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
