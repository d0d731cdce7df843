"""What a diagnosis knows while its search goes on, on disk: a verdict takes minutes, and a process may be killed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bayessim_mjx import atomic
from bayessim_mjx.diagnosis.gap import of_one
from bayessim_mjx.diagnosis.result import plain
from bayessim_mjx.diagnosis.selection.tried import Tried
from bayessim_mjx.diagnosis.setup import Setup
from bayessim_mjx.diagnosis.summary import first_look
from bayessim_mjx.diagnosis.summary.assemble import ranking

BEST = 20  # models listed


def write(path: Path, about: Mapping[str, Any], setup: Setup, tried: Tried | None) -> None:
    """Write what is known so far, whole or not at all; no verdict is among it.

    Args:
        about: what is diagnosed; tried: None before the first fit.
    """
    found = {"verdict": None, "about": dict(about), "before_simulation": first_look.lines(setup.look)}
    found |= {"warnings": list(setup.warnings)} | ({} if tried is None else _so_far(tried))
    path.parent.mkdir(parents=True, exist_ok=True)
    every = plain(found | {"windows": len(setup.fitter.simulator.windows)})
    atomic.write_text(path, json.dumps(every, indent=1, allow_nan=False) + "\n")


def _so_far(tried: Tried) -> dict[str, Any]:
    """Gaps in noise standard deviations, recalibrated parameters and the best models."""
    fit, calibrated = tried.base.fit, tried.gap(tried.base)
    nominal, _ = tried.nominal.quadratic(tried.fitter.spread)
    best = [{k: row[k] for k in ("label", "score", "se", "gap_closed", "parameters")} for row in ranking(tried)[:BEST]]
    return {
        "gap": {"nominal": of_one(float(nominal.c.sum()), calibrated.noise).rms, "calibrated": calibrated.rms},
        "parameters": dict(zip(fit.names, map(float, fit.values), strict=True)),
        "candidates": best,
    }
