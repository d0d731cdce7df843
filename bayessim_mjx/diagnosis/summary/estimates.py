"""Numbers of named effects and of known parameters: estimates, scores among rivals, shares closed, suspect values."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx import effects as library
from bayessim_mjx.diagnosis import data_sheet, statistics
from bayessim_mjx.diagnosis.correction import UNIFORM
from bayessim_mjx.diagnosis.evidence.parameters import Posterior
from bayessim_mjx.diagnosis.evidence.selecting import Rival, Selection, Size, size_of
from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.fitting.candidates import Candidate, Coordinate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.phrases import effects as phrases
from bayessim_mjx.diagnosis.phrases import parameters as remarks
from bayessim_mjx.diagnosis.phrases.effects import CLEAR
from bayessim_mjx.diagnosis.result import Estimate, FoundEffect
from bayessim_mjx.diagnosis.selection import bounds, heldout
from bayessim_mjx.diagnosis.selection.models import Model, systematic
from bayessim_mjx.diagnosis.setup import Setup
from bayessim_mjx.effects.support.actuators import OfGains, OfLoops
from bayessim_mjx.effects.support.words import spelt

Array = NDArray[np.float64]


def effects_of(found: Findings, sd: Array, closed: dict[str, Any]) -> list[FoundEffect]:
    """List the effects of the verdict with all their numbers, the one that closes most first."""
    parts = _parts(found, closed)
    out = [_effect(found, e, sd, parts[e.label]) for e in found.model.effects]
    return sorted(out, key=lambda e: -e.gap_closed)


def answers(effects: list[FoundEffect], experiment: dict[str, Any]) -> list[dict[str, Any]]:
    """One answer for each effect: the explanations that these logs do not separate, with a number that all share.

    Args:
        experiment: the proposal (`Experiment.to_dict`).

    Returns:
        See `Diagnosis.answers`.
    """
    out = []
    for e in effects:
        label = f"{e.name}@{e.where}"
        rivals = [r for r in e.equivalent_to if "weight" in r]  # without one it contains the effect as a special case
        own = {"effects": [label], "probability": e.weight_among_rivals if rivals else 1.0}
        members = [own, *({"effects": r["effects"], "probability": r["weight"]} for r in rivals)]
        splits = experiment["name"] if rivals and experiment.get("file") else ""
        out.append({"effect": label, "members": members, "number": e.shared, "splits": splits})
    return out


def _parts(found: Findings, closed: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """{label: numbers of `FoundEffect` on its part of what all close}.

    Shares (Shapley) are of the linear promise where too many effects are named to fit all subsets.
    """
    base, fitted = found.selection.state.base, found.selection.subsets
    labels = [e.label for e in found.model.effects]
    if not labels:
        return {}
    if fitted:
        each = statistics.shapley(len(labels), lambda some: base.cost - fitted[frozenset(labels[i] for i in some)].cost)
    else:
        each = np.array([[closed["each"][n] if len(labels) > 1 else 1.0] for n in labels])
        each = each if each.sum() else np.ones_like(each)
    out = {}
    for label, own in zip(labels, each, strict=True):
        part = replace(_closed(found), own=own, every=each.sum(0))
        out[label] = {
            "share": float(own.sum() / each.sum()) if len(labels) > 1 else math.nan,
            "gap_closed": part.value,
            "gap_closed_ci": part.interval(),
            "predicted_gap_closed": closed["each"][label],
        }
    return out


def closed_by(found: Findings) -> dict[str, Any]:
    """Share of the recalibrated simulator's squared gap that all effects close: promised, and then really."""
    if not found.model.effects:
        return {}
    closed, (total, each) = _closed(found), found.selection.promised
    own = {"predicted": total, "realised": closed.value, "ci": closed.interval(), "each": each}
    elsewhere = found.selection.elsewhere if nested(found) else float("nan")
    return own | {"elsewhere": elsewhere, "nested": nested(found)}


def _closed(found: Findings) -> heldout.Closed:
    """On conditions that had no part in the fit; of three and more (`nested`) the choice was made without them too.

    Where the other conditions choose something else, that is what counts of a condition, as the search scored it.
    """
    selection, cut = found.selection, found.setup.fitter.simulator.windows
    before, after = (found.predictions[k].cost(cut.steps) for k in ("calibrated", "with_effects"))
    answer = frozenset(e.label for e in found.model.effects)
    for condition, chosen in selection.chosen.items() if nested(found) else ():
        if chosen != answer:
            own, models = cut.group == condition, selection.state.models
            after[own] = before[own] * models[chosen].cost[own] / models[frozenset()].cost[own]
    floor = heldout.noise_floor(found.model.fit, selection.estimated.noise)
    return heldout.Closed(before, after, cut.condition, floor)


def nested(found: Findings) -> bool:
    """Whether there are conditions enough to choose without one: of two, the other alone tells no standard error.

    The costs behind such a choice are of fits that had seen the condition: it is not free of it altogether.
    """
    count = min(len(found.selection.chosen), found.setup.fitter.simulator.windows.conditions)
    return count - 1 > 1  # others, of which a choice needs two: n - 1 degrees of freedom (Student's t)


def _effect(found: Findings, effect: Candidate, sd: Array, part: dict[str, Any]) -> FoundEffect:
    setup, model = found.setup, found.model
    rivals = found.selection.rivals.get(effect.label, ())
    weighed = [r for r in rivals if not r.contains]
    weights = _weights(found, [model, *(r.model for r in weighed)])
    weight_of = dict(zip(map(id, weighed), weights[1:], strict=True))
    own = [model.fit.names.index(c.name) for c in effect.coordinates]
    numbers, ends = {}, []
    allowed = systematic(model, setup.fitter.simulator.windows.dt)
    for i, c in zip(own, effect.coordinates, strict=True):
        value, word = float(model.fit.values[i]), c.name.rsplit(".", 1)[1]
        bound = bounds.of(setup.physics, c, value)
        deviation = float(sd[i]) if bound is None or bound.kind == "off" else float("nan")
        unit, kind = _unit(setup, effect, c.unit), bound.kind if bound else ""
        numbers[word] = Estimate(value, deviation, unit, kind, float(allowed[i]))
        clause = (
            phrases.at_bound(bound, c.unit)
            if bound
            else phrases.UNKNOWN
            if deviation > UNIFORM * (c.high - c.low)
            else ""
        )
        ends += [f"{spelt(word)} {clause}"] if clause else []
    shared = _shared(effect, size_of(effect, model.fit.values[own], sd[own]), weighed, weights)
    return FoundEffect(
        name=effect.effect,
        where=effect.where,
        parameters=numbers,
        weight_among_rivals=weights[0],
        equivalent_to=[r.to_dict() | ({"weight": weight_of[id(r)]} if id(r) in weight_of else {}) for r in rivals],
        sentence=phrases.capital("; ".join(ends)) + "." * bool(ends),
        shared=shared | ({"unit": _unit(setup, effect, shared["unit"])} if shared else {}),
        modelled=_modelled(setup, effect),
        **part,
    )


def _modelled(setup: Setup, effect: Candidate) -> dict[str, float]:
    """Return the numbers of model or logs that an effect's parameters multiply, where all places have the same."""
    own = library.known(effect.effect)
    if own is None or not issubclass(own, OfGains | OfLoops):
        return {}
    physics = setup.physics
    site = next(s for e, s in zip(physics.effects, physics.sites, strict=True) if e.name == effect.effect)
    here = [i for name, i in zip(site.names, site.ids, strict=True) if effect.where in (name, "all")]
    if issubclass(own, OfGains):
        return own.modelled(physics.mj_model, here)
    return own.declared(setup.fitter.simulator.windows.batch.law, here)


def _shared(effect: Candidate, own: Size, rivals: list[Rival], weights: list[float]) -> dict[str, Any]:
    """How large it is, whichever of the rivals it is: of those whose sizes have its unit.

    Args:
        own: the effect's size; weights: of the effect, then of the rivals.
    """
    alike = [(r, w) for r, w in zip(rivals, weights[1:], strict=True) if r.size and r.size.unit == own.unit]
    if not alike or not own.unit:
        return {}
    every = [own, *(r.size for r, _ in alike if r.size)]
    weight = np.array([weights[0], *(w for _, w in alike)])
    mean, sd = (np.array([[getattr(s, k)] for s in every]) for k in ("mean", "sd"))
    weight = weight / weight.sum()
    low, high = statistics.mixture_quantiles(weight, mean, np.maximum(sd, 1e-300), (0.05, 0.95))[:, 0].tolist()
    return {
        "effects": [effect.label, *(r.effects[0].label for r, _ in alike)],
        "mean": float(weight @ mean[:, 0]),
        "low": max(low, 0.0),
        "high": high,
        "unit": own.unit,
        "quantities": list(dict.fromkeys(s.quantity for s in every)),
    }


def _weights(found: Findings, models: list[Model]) -> list[float]:
    """Probabilities of a model and its rivals beside each other; NaN of one that has none."""
    if len(models) < 2:
        return [float("nan")]
    weight = found.selection.weighed.weight
    each = np.array([weight.get(frozenset(e.label for e in m.effects), 0.0) for m in models])
    return (each / max(each.sum(), 1e-300)).tolist()


def _unit(setup: Setup, effect: Candidate, unit: str) -> str:
    """Return a hinge's unit as a slide's, where the place is a slide."""
    model = setup.physics.mj_model
    if effect.kind not in ("joint", "actuator") or effect.where == "all":
        return unit
    try:
        joint = model.joint(effect.where).id if effect.kind == "joint" else int(model.actuator(effect.where).trnid[0])
    except KeyError:
        return unit
    if joint < 0 or int(model.jnt_type[joint]) != 2:
        return unit
    if unit == "N m s":
        return "N s/m"
    return unit.replace("kg m^2", "kg").replace("N m", "N").replace("(N)", "N").replace("rad", "m")


def parameters(selection: Selection, model: Model, sd: Array, mean: Array) -> dict[str, dict[str, Any]]:
    """Rows of the result's table: {name: the robot's value (`mean`), its sd, the simulated value, bounds, remarks}."""
    suspect = structural(selection.state.fitter, model)
    base, values = selection.state.fitter.base, model.fit.values
    real = [float(np.clip(v, c.low, c.high)) for c, v in zip(base, mean, strict=True)]
    return {
        c.name: {
            **_against_data_sheet(c, real[i], float(model.fit.belief()[i])),
            "mean": real[i], "simulated": float(values[i]), "sd": float(sd[i]), "nominal": c.neutral,
            "low": c.low, "high": c.high, "unit": c.unit, "structural": suspect.get(c.name, ""),
            "at_bound": _at_bound(c, float(values[i])),
            "same_as": list(selection.stand_ins.get(c.name, ())),
        }
        for i, c in enumerate(base)
    }  # fmt: skip


def _against_data_sheet(c: Coordinate, value: float, precision: float) -> dict[str, Any]:
    """Return the distance of a known parameter from its stated value, in words and in sd, if larger than `CLEAR`."""
    away = abs(value - c.neutral) * precision**0.5
    if not (c.stated and away > CLEAR):
        return {"data_sheet": ""}
    return {"data_sheet": remarks.far_from_data_sheet(value, away), "away": away}


def accuracy(model: Model, sheet: Posterior) -> dict[str, dict[str, float]]:
    """{kind: quantiles of its accuracy, and how many parameters it has}, of kinds whose accuracy was not stated."""
    every = [c.kind for c in model.fit.coordinates]
    ends = {kind: sheet.accuracy(kind) for kind in sheet.kinds}
    return {
        kind: {"median": middle, "low": low, "high": high, "parameters": every.count(kind)}
        for kind, (low, middle, high) in ends.items()
    }


def less_accurate(model: Model, sheet: Posterior) -> list[str]:
    """Remark on kinds of parameters that are farther from their data sheet than usual, with 95 % probability."""
    every = accuracy(model, sheet).items()
    found = {k: (own["median"], own["low"], own["high"]) for k, own in every if own["low"] > data_sheet.ACCURACY}
    return [remarks.less_accurate(found)] if found else []


def structural(fitter: Fitter, model: Model) -> dict[str, str]:
    """{known parameter: remark} where it sits at a bound or moves between conditions (Wald test, Bonferroni)."""
    from scipy import stats  # takes long to import

    base, groups = len(fitter.base), len(model.estimates)
    pairs = zip(model.fit.coordinates[:base], model.fit.values, strict=False)
    out = {c.name: remarks.stuck(v) for c, v in pairs if _at_bound(c, v)}
    if groups < 3:
        return out
    each, deviation = per_condition(fitter, model)
    for i, c in enumerate(model.fit.coordinates[:base]):
        own, sd = each[:, i], deviation[:, i]
        z2 = float(np.sum(((own - np.average(own, weights=1 / sd**2)) / sd) ** 2))
        p = float(stats.chi2.sf(z2, groups - 1)) * base
        spread = float(np.std(own))
        if p < 1e-3 and spread > 0.05 * (c.high - c.low) and c.name not in out:
            out[c.name] = remarks.moves(spread, groups, fitter.simulator.windows.blocks)
    return out


def _at_bound(c: Coordinate, value: float) -> bool:
    return bool(min(value - c.low, c.high - value) < 1e-3 * (c.high - c.low))


def per_condition(fitter: Fitter, model: Model) -> tuple[Array, Array]:
    """Estimates and standard deviations `[G, k]` of each condition alone, one Newton step from the common fit."""
    q, _ = model.fit.quadratic()
    _, _, low, high = model.fit.prior()
    precision = model.fit.belief()
    pull = -precision * model.fit.away
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
