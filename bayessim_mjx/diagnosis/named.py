"""Numbers of the named effects: estimates, probability, what each closes, as promised and as realised."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bayessim_mjx.diagnosis import gap, promise, uncertainty, verdict
from bayessim_mjx.diagnosis.candidates import Candidate
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
    setup, race, model = found.setup, found.race, found.ruling.model
    rivals = found.ruling.rivals.get(effect.label, [])
    told = [model, *(r.model for r in rivals if not r.contains)]
    rng = np.random.default_rng(setup.seed)
    weight = uncertainty.win_share(told, setup.fitter.simulator.windows.group, race.noise, rng)
    own = [model.job.names.index(c.name) for c in effect.coordinates]
    numbers = {
        c.name.rsplit(".", 1)[1]: Estimate(float(model.job.values[i]), float(sd[i]), _unit(setup, effect, c.unit))
        for i, c in zip(own, effect.coordinates, strict=True)
    }
    return FoundEffect(
        name=effect.effect,
        where=effect.where,
        parameters=numbers,
        probability=float(weight[0]),
        gap_closed=part.closed,
        gap_closed_ci=part.ci,
        equivalent_to=[r.to_dict() for r in rivals],
        sentence="",
        predicted_gap_closed=part.promised,
        share=part.share if len(model.effects) > 1 else float("nan"),
    )


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
