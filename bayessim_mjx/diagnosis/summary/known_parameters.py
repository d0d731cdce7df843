"""What is reported of known parameters: values against the data sheet, its accuracy, and remarks on suspect ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import data_sheet
from bayessim_mjx.diagnosis.evidence.parameters import Posterior
from bayessim_mjx.diagnosis.evidence.selecting import Selection
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.phrases import parameters as phrases
from bayessim_mjx.diagnosis.phrases.effects import CLEAR
from bayessim_mjx.diagnosis.selection.models import Model

Array = NDArray[np.float64]


def parameters(selection: Selection, model: Model, sd: np.ndarray, mean: np.ndarray) -> dict[str, dict[str, Any]]:
    """Rows of the result's table: {name: the robot's value (`mean`), its sd, the simulated value, bounds, remarks}."""
    remarks = structural(selection.state.fitter, model)
    base, values = selection.state.fitter.base, model.fit.values
    real = [float(np.clip(v, c.low, c.high)) for c, v in zip(base, mean, strict=True)]
    return {
        c.name: {
            **_against_data_sheet(c, real[i], float(model.fit.belief()[i])),
            "mean": real[i], "simulated": float(values[i]), "sd": float(sd[i]), "nominal": c.neutral,
            "low": c.low, "high": c.high, "unit": c.unit, "structural": remarks.get(c.name, ""),
            "at_bound": _at_bound(c, float(values[i])),
            "same_as": list(selection.stand_ins.get(c.name, ())),
        }
        for i, c in enumerate(base)
    }  # fmt: skip


def _against_data_sheet(c: Coordinate, value: float, precision: float) -> dict[str, Any]:
    """The distance of a known parameter from its stated value, in words and in sd, if it is larger than `CLEAR`."""
    away = abs(value - c.neutral) * precision**0.5
    if not (c.stated and away > CLEAR):
        return {"data_sheet": ""}
    return {"data_sheet": phrases.far_from_data_sheet(value, away), "away": away}


def accuracy(model: Model, sheet: Posterior) -> dict[str, dict[str, float]]:
    """{kind: quantiles of its accuracy, and how many parameters it has}, of kinds whose accuracy was not stated."""
    every = [c.kind for c in model.fit.coordinates]
    ends = {kind: sheet.accuracy(kind) for kind in sheet.kinds}
    return {
        kind: {"median": middle, "low": low, "high": high, "parameters": every.count(kind)}
        for kind, (low, middle, high) in ends.items()
    }


def less_accurate(model: Model, sheet: Posterior) -> list[str]:
    """A remark on kinds of parameters that are farther from their data sheet than usual, with 95 % probability."""
    every = accuracy(model, sheet).items()
    found = {k: (own["median"], own["low"], own["high"]) for k, own in every if own["low"] > data_sheet.ACCURACY}
    return [phrases.less_accurate(found)] if found else []


def structural(fitter: Fitter, model: Model) -> dict[str, str]:
    """{known parameter: remark} where it sits at a bound or moves between conditions (Wald test, Bonferroni)."""
    from scipy import stats  # takes long to import

    out = {}
    base = len(fitter.base)
    groups = len(model.estimates)
    for i, c in enumerate(model.fit.coordinates[:base]):
        if _at_bound(c, model.fit.values[i]):
            out[c.name] = phrases.stuck(model.fit.values[i])
    if groups < 3:
        return out
    each, deviation = per_condition(fitter, model)
    for i, c in enumerate(model.fit.coordinates[:base]):
        own, sd = each[:, i], deviation[:, i]
        z2 = float(np.sum(((own - np.average(own, weights=1 / sd**2)) / sd) ** 2))
        p = float(stats.chi2.sf(z2, groups - 1)) * base
        spread = float(np.std(own))
        if p < 1e-3 and spread > 0.05 * (c.high - c.low) and c.name not in out:
            out[c.name] = phrases.moves(spread, groups, fitter.simulator.windows.blocks)
    return out


def _at_bound(c: Coordinate, value: float) -> bool:
    return bool(min(value - c.low, c.high - value) < 1e-3 * (c.high - c.low))


def per_condition(fitter: Fitter, model: Model) -> tuple[Array, Array]:
    """Estimates and standard deviations `[G, k]` of each condition alone, one Newton step from the common fit."""
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
