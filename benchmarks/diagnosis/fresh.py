"""What a diagnosis's effects close of the gap on motions that it has not seen: the truth for its share of the gap."""

import copy
import dataclasses
from typing import Any

import numpy as np

from bayessim_mjx.blind.reality.plant import Plant
from bayessim_mjx.blind.reality.system import System
from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.selection import heldout
from bayessim_mjx.diagnosis.selection.models import Model

REPEATS = 2  # motions of every run that was logged
OTHER = 50_000_000  # seeds apart


def closed(found: Findings, robot: System, plant: Plant, seed: int) -> float | None:
    """Share of the recalibrated simulator's squared gap that the named effects close; None where none is named.

    As the diagnosis counts it (`heldout.Closed`: the same windows, estimates and start states), but on other motions of
    the runs that were logged, and without noise, so that none has to be taken off.
    """
    if not found.model.effects:
        return None
    left = np.zeros(2)
    for k in range(1, REPEATS + 1):
        fitter = _fitter(found, robot, plant, seed + k * OTHER)
        for i, model in enumerate((found.selection.state.base, found.model)):
            left[i] += _predicted(fitter, model)
    return float(1 - left[1] / left[0])


def _fitter(found: Findings, robot: System, plant: Plant, seed: int) -> Fitter:
    """The diagnosis's own, on windows of fresh motion; the program is the one that is compiled already."""
    fitter = copy.copy(found.setup.fitter)
    cut = fitter.simulator.windows
    logs = []
    for log in found.setup.logs:
        run = robot.record(plant, int(log.name[:2]), seed)
        logs.append(dataclasses.replace(log, ctrl=run.ctrl, qpos=run.clean, qvel=run.clean_v))
    sizes = cut.batch.command.shape
    own: dict[str, Any] = {"limit": len(cut), "starts": list(zip(cut.log, cut.start, strict=True)), "centred": False}
    new = windows.cut(logs, found.setup.robot.mj_model, cut.dt, sizes[2], sizes[1], **own)
    same = {name: getattr(cut, name) for name in ("group", "groups", "sigma_q", "sigma_v", "spread")}
    fitter.simulator = copy.copy(fitter.simulator)
    fitter.simulator.windows = dataclasses.replace(new, **same)
    return fitter


def _predicted(fitter: Fitter, model: Model) -> float:
    """Mean square error, in noise variances."""
    fit = model.fit
    still = np.zeros_like(fit.offsets)
    theta = fitter.vector(fit.coordinates, fit.values)
    r = fitter.whiten(fitter.simulator.run(theta[None], still[None]))[0]
    begun = dataclasses.replace(fit, offsets=still, r=r, B=fitter.start_columns(theta, still, r))
    seen = heldout.predict(fitter, dataclasses.replace(model, fit=begun))
    return float(seen.cost(fitter.simulator.windows.steps).mean())
