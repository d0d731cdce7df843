"""From findings to the result: the verdict's name and words, numbers per effect, gap, ranking, numbers for pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayessim_mjx import versions
from bayessim_mjx.diagnosis import data_sheet, phrases, statistics
from bayessim_mjx.diagnosis.experiment.propose import Experiment
from bayessim_mjx.diagnosis.findings import Findings, Where
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.residual.black_boxes import BlackBoxes
from bayessim_mjx.diagnosis.result import Diagnosis, Gap, Place
from bayessim_mjx.diagnosis.selection import bounds, conditions, left_out, uncertainty
from bayessim_mjx.diagnosis.selection.accuracy import Posterior
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.selected import Selection
from bayessim_mjx.diagnosis.selection.tried import Tried, ranked
from bayessim_mjx.diagnosis.summary import effects_found, how_far
from bayessim_mjx.diagnosis.summary.details import details
from bayessim_mjx.diagnosis.summary.finer_steps import AtFinerSteps
from bayessim_mjx.diagnosis.summary.left_in_words import (
    black_boxes_in_words,
    located_in_words,
    not_on_offer,
    places_of,
    spectra_in_words,
)
from bayessim_mjx.diagnosis.summary.sentences import horizon_warning, sentences
from bayessim_mjx.diagnosis.summary.verdict import verdict_of
from bayessim_mjx.diagnosis.summary.whole_logs import Whole
from bayessim_mjx.logs.log import Channels

# standard deviations from what a data sheet states, from where on that is told: by chance of one normal value in 22.
# How often it is told wrongly of fitted values was not counted.
FAR = 2.0
PACKAGES = ("bayessim-mjx", "mujoco", "mujoco-mjx", "jax", "numpy")  # what the result depends on


def diagnosis_of(found: Findings, about: Mapping[str, Any] | None = None, file: str = "") -> Diagnosis:
    """The result of what was found.

    Args:
        about: what was diagnosed, see `Diagnosis`; file: name of the proposal's command file, where there is one.
    """
    setup, selection, model = found.setup, found.selection, found.model
    timestep = float(setup.robot.mj_model.opt.timestep) * (setup.discretisation.factor if setup.discretisation else 1)
    own = selection.estimated
    together = own.covariance + np.diag(uncertainty.systematic(model, timestep, selection.gap(model).left) ** 2)
    finer = found.part(AtFinerSteps)
    steps = finer.notes(found, together) if finer else []
    base = len(setup.fitter.base)
    together = _told(found, together + finer.covariance(base) if finer else together)
    sd = np.sqrt(np.diag(together))
    closed = effects_found.closed_by(found)
    effects = effects_found.effects_of(found, sd, closed)
    far = how_far.measured(found, {k: v for k, v in closed.items() if k != "each"})
    verdict = verdict_of(found, far)
    known = own.mean[:base] + (finer.shift[:base] if finer else 0.0)
    parameters = _parameters(selection, model, sd, known)
    over, where, proposal = found.part(Whole), found.part(Where), found.part(Experiment)
    far = how_far.with_whole(far, over, setup.tolerance) if over else far
    told = sentences(verdict, effects, parameters, found, far)
    told += [not_on_offer(e.name for e in setup.physics.effects)] if verdict.name == "unexplained" else []
    notes = [*setup.warnings, *steps, *(over.notes if over else ()), *(horizon_warning(far) if effects else [])]
    more = {"maps": where.found.maps, "frequency": [heard.details() for heard in where.spectra]} if where else {}
    lies = [*located_in_words(where.found), *spectra_in_words(where.spectra)] if where else []
    rivals = black_boxes_in_words(found.part(BlackBoxes), setup.fitter.simulator.windows.blocks)
    return Diagnosis(
        verdict=verdict.name,
        sentences=[*filter(None, [*told, left_out.not_tried(selection)]), *rivals, *lies],
        effects=effects,
        where=places_of(where.found) if where and where.found.spots else _where(found),
        gap=far,
        parameters=parameters,
        candidates=ranking(selection),
        warnings=[*notes, *_less_accurate(model, own.sheet), *found.warnings],
        next_experiment=proposal.to_dict(file) if proposal else {},
        versions=versions.of(PACKAGES),
        details=details(found, effects, closed) | more | ({"experiments": proposal.details()} if proposal else {}),
        covariance={"names": list(model.fit.names), "matrix": together},
        not_fitted=left_out.not_fitted(selection),
        about={**about, "conditions": setup.fitter.simulator.windows.conditions} if about else {},
        hidden=list(selection.hidden),
        accuracy=_accuracy(model, own.sheet),
        evidence=selection.weighed.told(),
    )


def _told(found: Findings, covariance: np.ndarray) -> np.ndarray:
    """The covariance without what it says of parameters that end at a bound."""
    model, physics = found.model, found.setup.physics
    at = []
    for effect in model.effects:
        for c, value in zip(effect.coordinates, model.values_of(effect), strict=True):
            bound = bounds.of(physics, c, float(value))
            at += [model.fit.names.index(c.name)] if bound is not None and bound.kind != "off" else []
    neutral = np.array([c.neutral for c in model.fit.coordinates])
    return bounds.spread_out(covariance, model.fit.values, neutral, at)


def _parameters(selection: Selection, model: Model, sd: np.ndarray, mean: np.ndarray) -> dict[str, dict[str, Any]]:
    """Of the robot (their mean), and as they are simulated at the time step of the fit."""
    remarks = conditions.structural(selection, model)
    base, values = selection.fitter.base, model.fit.values
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


def _accuracy(model: Model, sheet: Posterior) -> dict[str, dict[str, float]]:
    """Of each kind of parameter whose accuracy nobody stated."""
    every = [c.kind for c in model.fit.coordinates]
    ends = {kind: sheet.accuracy(kind) for kind in sheet.kinds}
    return {
        kind: {"median": middle, "low": low, "high": high, "parameters": every.count(kind)}
        for kind, (low, middle, high) in ends.items()
    }


def _less_accurate(model: Model, sheet: Posterior) -> list[str]:
    """Kinds of parameters that lie farther from their data sheet than half of all do, 9 to 1 or surer."""
    found = {kind: own for kind, own in _accuracy(model, sheet).items() if own["low"] > data_sheet.ACCURACY}
    return (
        [phrases.less_accurate({kind: (own["median"], own["low"], own["high"]) for kind, own in found.items()})]
        if found
        else []
    )


def ranking(tried: Tried) -> list[dict[str, Any]]:
    """Models tried, best first: held-out score, nats over the known parameters alone, and its standard error."""
    rows = statistics.leave_one_out(tried.fitter.simulator.windows.condition)
    absorbed = {s.candidate.label: s.absorbed for s in tried.screened}
    out: list[dict[str, Any]] = []
    rows_of = ranked(tried)[:60]
    samples = rows_of[0].samples  # one for all, so that scores are in the order of the errors
    for model in rows_of:
        ratio = np.log((rows @ tried.base.cost) / (rows @ model.cost))
        error = float(0.5 * samples * statistics.error(ratio)) if len(rows) else float("nan")
        out.append({
            "effects": [e.label for e in model.effects],
            "label": model.label,
            "score": 0.5 * samples * float(np.log(tried.base.total / model.total)),
            "se": error,
            "gap_closed": tried.gap(model).closed,
            "rms": float(np.sqrt(model.total / model.fit.r.size)),
            "parameters": dict(zip(model.fit.names, map(float, model.fit.values), strict=True)),
            "absorbed": absorbed.get(model.effects[0].label) if len(model.effects) == 1 else None,
        })  # fmt: skip
    return out


def _where(found: Findings) -> list[Place]:
    """Shares of the calibrated gap by joint, above the noise."""
    setup = found.setup
    cut = setup.fitter.simulator.windows
    calibrated = found.predictions["calibrated"]
    channels, used = Channels.of(setup.physics.mj_model).qvel, setup.fitter.used[: setup.physics.mj_model.nv]
    names = [n for n, seen in zip(channels, used, strict=True) if seen]
    if not names:
        return []
    costs = np.stack([np.maximum(calibrated.cost(cut.steps, slice(i, i + 1)) - 1.0, 0.0) for i in range(len(names))], 1)
    total = costs.sum()
    if total <= 0.1 * costs.size:
        return []
    ends = statistics.interval_of_shares(costs, cut.condition)
    out = [Place(n, float(costs[:, i].sum() / total), ends[i], "") for i, n in enumerate(names)]
    return sorted(out, key=lambda p: -p.share)


def insufficient(reason: str, notes: Sequence[str], about: Mapping[str, Any] | None = None) -> Diagnosis:
    """The verdict where nothing can be held out."""
    nothing = Gap(1.0, *(float("nan"),) * 4)
    said = [f"Too little data: {reason}."]
    return Diagnosis(
        "insufficient_data",
        said,
        [],
        [],
        nothing,
        {},
        [],
        list(notes),
        {},
        versions.of(PACKAGES),
        about=dict(about or {}),
    )
