"""What is reported of known parameters: values against the data sheet, its accuracy, and remarks on suspect ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import data_sheet, phrases
from bayessim_mjx.diagnosis.evidence.parameters import Posterior
from bayessim_mjx.diagnosis.evidence.selecting import Selection
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.selection.models import Model

Array = NDArray[np.float64]
# standard deviations from what a data sheet states, from where on that is told: by chance of one normal value in 22.
# How often it is told wrongly of fitted values was not counted.
FAR = 2.0


def parameters(selection: Selection, model: Model, sd: np.ndarray, mean: np.ndarray) -> dict[str, dict[str, Any]]:
    """Of the robot (their mean), and as they are simulated at the time step of the fit."""
    remarks = structural(selection.state.fitter, model)
    base, values = selection.state.fitter.base, model.fit.values
    real = [float(np.clip(v, c.low, c.high)) for c, v in zip(base, mean, strict=True)]
    return {
        c.name: {
            **_against_data_sheet(c, real[i], float(model.fit.belief()[i])),
            "mean": real[i], "simulated": float(values[i]), "sd": float(sd[i]), "nominal": c.neutral,
            "low": c.low, "high": c.high, "unit": c.unit, "structural": remarks.get(c.name, ""),
            "same_as": list(selection.stand_ins.get(c.name, ())),
        }
        for i, c in enumerate(base)
    }  # fmt: skip


def _against_data_sheet(c: Coordinate, value: float, precision: float) -> dict[str, Any]:
    """How far a known parameter is from what was stated of it, where that is far: in words, and in sd."""
    away = abs(value - c.neutral) * precision**0.5
    if not (c.stated and away > FAR):
        return {"data_sheet": ""}
    return {"data_sheet": phrases.far_from_data_sheet(value, away), "away": away}


def accuracy(model: Model, sheet: Posterior) -> dict[str, dict[str, float]]:
    """Of each kind of parameter whose accuracy nobody stated."""
    every = [c.kind for c in model.fit.coordinates]
    ends = {kind: sheet.accuracy(kind) for kind in sheet.kinds}
    return {
        kind: {"median": middle, "low": low, "high": high, "parameters": every.count(kind)}
        for kind, (low, middle, high) in ends.items()
    }


def less_accurate(model: Model, sheet: Posterior) -> list[str]:
    """Kinds of parameters that lie farther from their data sheet than half of all do, 9 to 1 or surer."""
    found = {kind: own for kind, own in accuracy(model, sheet).items() if own["low"] > data_sheet.ACCURACY}
    return (
        [phrases.less_accurate({kind: (own["median"], own["low"], own["high"]) for kind, own in found.items()})]
        if found
        else []
    )


def structural(fitter: Fitter, model: Model) -> dict[str, str]:
    """Known parameters that sit at a bound or move between operating conditions (Wald test, Bonferroni)."""
    from scipy import stats  # takes long to import

    out = {}
    base = len(fitter.base)
    groups = len(model.estimates)
    for i, c in enumerate(model.fit.coordinates[:base]):
        value, width = model.fit.values[i], c.high - c.low
        if min(value - c.low, c.high - value) < 1e-3 * width:
            out[c.name] = phrases.stuck(value)
    if groups < 3:
        return out
    each, deviation = per_condition(fitter, model)
    for i, c in enumerate(model.fit.coordinates[:base]):
        z2 = float(
            np.sum(((each[:, i] - np.average(each[:, i], weights=1 / deviation[:, i] ** 2)) / deviation[:, i]) ** 2)
        )
        p = float(stats.chi2.sf(z2, groups - 1)) * base
        spread = float(np.std(each[:, i]))
        if p < 1e-3 and spread > 0.05 * (c.high - c.low) and c.name not in out:
            out[c.name] = phrases.moves(spread, groups, fitter.simulator.windows.blocks)
    return out


def per_condition(fitter: Fitter, model: Model) -> tuple[Array, Array]:
    """Each condition's own estimate and standard deviation, `[G, k]`, one Newton step from the common fit."""
    q, _ = model.fit.quadratic(fitter.spread)
    _, _, low, high = model.fit.prior()
    precision = model.fit.belief()
    pull = precision * (np.array([c.neutral for c in model.fit.coordinates]) - model.fit.values)
    group = fitter.simulator.windows.group
    each, deviation = [], []
    inflation = max(model.total / model.fit.r.size, 0.5) * model.fit.r.size / model.samples
    for name in np.unique(group):
        g, S = q.weighted(model.fit.weight * (group == name))
        H = S / inflation + np.diag(precision)
        covariance = np.linalg.pinv(H)
        each.append(model.fit.values + np.clip(covariance @ (g / inflation + pull), low, high))
        deviation.append(np.sqrt(np.diag(covariance)))
    return np.array(each), np.array(deviation)
