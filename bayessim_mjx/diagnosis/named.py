"""Numbers of the named effects: estimates, weight among rivals, what each closes, as promised and as realised."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bayessim_mjx.diagnosis import bounds, gap, promise, uncertainty, verdict
from bayessim_mjx.diagnosis.candidates import Candidate
from bayessim_mjx.diagnosis.models import Model
from bayessim_mjx.diagnosis.race import Progress
from bayessim_mjx.diagnosis.result import Estimate, FoundEffect
from bayessim_mjx.diagnosis.run import Findings, Setup


def effects_of(found: Findings, sd: np.ndarray, closed: dict[str, Any], say: Progress) -> list[FoundEffect]:
    """The effects of the verdict with all their numbers, the one that closes most first."""
    parts = _parts(found, closed, say)
    out = [_effect(found, e, sd, parts[e.label]) for e in found.ruling.model.effects]
    return sorted(out, key=lambda e: -e.gap_closed)


@dataclass(frozen=True)
class _Part:
    """One effect's part of what all close: its share of that (Shapley), closed, with interval, and promised."""

    share: float
    closed: float
    ci: tuple[float, float]
    promised: float


def _parts(found: Findings, closed: dict[str, Any], say: Progress) -> dict[str, _Part]:
    """{label: part}; the shares are of the linear promise where too many effects are named to fit all subsets."""
    model, race = found.ruling.model, found.race
    labels = [e.label for e in model.effects]
    fitted = verdict.subsets(race, model, say) if len(labels) > 1 else {}
    if not fitted:
        total = sum(closed["each"].values()) if labels else 0.0
        share = {n: closed["each"][n] / total if len(labels) > 1 and total else 1.0 for n in labels}
        return {n: _part(s, (s, s), n, closed) for n, s in share.items()}

    def drop(some: frozenset[int]) -> np.ndarray:
        return np.asarray(race.base.cost - fitted[frozenset(labels[i] for i in some)].cost)

    each = promise.shapley(len(labels), drop)
    group = race.fitter.simulator.windows.group
    draws = uncertainty.bootstrap_weights(group, 400, np.random.default_rng(found.setup.seed))
    sampled = (draws @ each.T) / np.maximum((draws @ each.sum(0))[:, None], 1e-9)
    shares = each.sum(1) / each.sum()
    return {n: _part(shares[i], uncertainty.interval(sampled[:, i]), n, closed) for i, n in enumerate(labels)}


def _part(share: float, spread: tuple[float, float], label: str, closed: dict[str, Any]) -> _Part:
    whole, (low, high) = closed["realised"], closed["ci"]
    ends = min(share * whole, spread[0] * low), min(max(share * whole, spread[1] * high), 1.0)
    return _Part(float(share), float(share * whole), (float(ends[0]), float(ends[1])), closed["each"][label])


def closed_by(found: Findings) -> dict[str, Any]:
    """Share of the recalibrated simulator's squared gap that all effects close: promised, and then really."""
    model, cut = found.ruling.model, found.setup.fitter.simulator.windows
    if not model.effects:
        return {}
    before, after = (found.predictions[k].cost(cut.steps) for k in ("calibrated", "with_effects"))
    reference = min(1.0, float(after.mean()))
    realised, ci = gap.closure(before, after, reference, cut.group, found.setup.seed)
    total, each = promise.promised(found.race, model.effects, reference)
    return {"predicted": total, "realised": realised, "ci": ci, "each": each}


def _effect(found: Findings, effect: Candidate, sd: np.ndarray, part: _Part) -> FoundEffect:
    setup, model = found.setup, found.ruling.model
    rivals = found.ruling.rivals.get(effect.label, [])
    weighed = [r for r in rivals if not r.contains]
    own_weight, *others = _weights(found, [model, *(r.model for r in weighed)])
    weight_of = dict(zip(map(id, weighed), others, strict=True))
    own = [model.job.names.index(c.name) for c in effect.coordinates]
    numbers, ends = {}, []
    for i, c in zip(own, effect.coordinates, strict=True):
        value, word = float(model.job.values[i]), c.name.rsplit(".", 1)[1]
        bound = bounds.of(setup.physics, effect, c, value)
        deviation = float(sd[i]) if bound is None or bound.kind == "off" else float("nan")
        numbers[word] = Estimate(value, deviation, _unit(setup, effect, c.unit), bound.kind if bound else "")
        ends += [f"{word.replace('_', ' ')} {bound.why}"] if bound else []
    return FoundEffect(
        name=effect.effect,
        where=effect.where,
        parameters=numbers,
        weight_among_rivals=own_weight,
        gap_closed=part.closed,
        gap_closed_ci=part.ci,
        equivalent_to=[r.to_dict() | ({"weight": weight_of[id(r)]} if id(r) in weight_of else {}) for r in rivals],
        sentence=_sentence(ends),
        predicted_gap_closed=part.promised,
        share=part.share if len(model.effects) > 1 else float("nan"),
    )


def _sentence(clauses: list[str]) -> str:
    text = "; ".join(clauses)
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def _weights(found: Findings, models: list[Model]) -> list[float]:
    """Weights of a model and its rivals; NaN of one that has none."""
    if len(models) < 2:
        return [float("nan")]
    group, rng = found.setup.fitter.simulator.windows.group, np.random.default_rng(found.setup.seed)
    return uncertainty.win_share(models, group, found.race.noise, rng).tolist()


def _unit(setup: Setup, effect: Candidate, unit: str) -> str:
    """A hinge's unit as a slide's, where the place is a slide."""
    model = setup.physics.mj_model
    if effect.kind not in ("joint", "actuator") or effect.where == "all":
        return unit
    try:
        joint = model.joint(effect.where).id if effect.kind == "joint" else int(model.actuator(effect.where).trnid[0])
    except KeyError:
        return unit
    if joint < 0 or int(model.jnt_type[joint]) != 2:
        return unit
    swap = {"N m/rad": "N/m", "N m s/rad": "N s/m", "N m s": "N s/m", "kg m^2": "kg", "N m": "N", "rad": "m"}
    return swap.get(unit, unit.replace("N m", "N").replace("rad", "m"))
