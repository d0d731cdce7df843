"""From a race to a verdict: rivals, equivalences, what is structural, and the words."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bayessim_mjx.diagnosis import phrases
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.race import polish
from bayessim_mjx.diagnosis.selection.screen import screen
from bayessim_mjx.diagnosis.selection.search import (
    Progress,
    Race,
    compatible,
    fit_models,
    parts_of,
    ranked,
    special_cases,
    together,
    without,
)
from bayessim_mjx.diagnosis.selection.tried import Tried


@dataclass(frozen=True)
class Alike:
    """When two explanations are told as the same."""

    near: float = 1.2  # noise variances: models that leave less than that explain the same
    same: float = 0.02  # of what an effect closes
    most: int = 8  # rivals told of one effect, single ones first
    mild: float = 10.0  # nats: below, held-out evidence between two models is called a tie


ALIKE = Alike()


@dataclass(frozen=True, eq=False)
class Rival:
    """Another explanation that these logs cannot tell from (a part of) the winner."""

    effects: tuple[Candidate, ...]
    model: Model
    closure: float
    why: str
    contains: bool = False
    behind: float = 0.0  # nats

    def to_dict(self) -> dict[str, Any]:
        return {"effects": [c.label for c in self.effects], "gap_closed": self.closure, "why": self.why}


@dataclass(frozen=True, eq=False)
class Ruling:
    """The winner's effects with their rivals; elsewhere: see `decide.closed_elsewhere`, NaN where it is not known."""

    model: Model
    rivals: dict[str, list[Rival]] = field(default_factory=dict)
    elsewhere: float = float("nan")

    @property
    def ambiguous(self) -> bool:
        return any(not r.contains for rivals in self.rivals.values() for r in rivals)


def rule(race: Race, say: Progress) -> Ruling:
    """Look for rivals of every effect of the winner: replaced by another one, the model predicts as well.

    A rival that closes as much with fewer numbers takes the winner's place, and so does the same law at one place alone
    where that is as good as at all of them.
    """
    winner = race.winner
    ruling = Ruling(winner)
    for effect in winner.effects:
        ruling.rivals[effect.label] = [*_in_parts(race, winner, effect, say), *_rivals(race, winner, effect, say)]
    alike = _instead_of_all(race, winner)
    for rivals in ruling.rivals.values():
        rivals += alike
    fewer = [m for e in winner.effects for m in _fewer(race, winner, e, ruling.rivals[e.label], say)]
    if not fewer:
        return ruling
    race.winner = min(fewer, key=lambda m: (m.size, m.total))
    return rule(race, say)


def _fewer(race: Race, winner: Model, effect: Candidate, rivals: Sequence[Rival], say: Progress) -> list[Model]:
    """Rivals with fewer numbers that close as much of what the other effects leave."""
    rest = without(race, winner, effect, say).total
    least = (1.0 - ALIKE.same) * (rest - winner.total)
    models = [r.model for r in rivals if not r.contains and r.model.size < winner.size or _narrower(effect, r)]
    models = [m for m in models if rest - m.total >= least]
    return [m for m in models if race.at_noise(m, ALIKE.near) >= race.at_noise(winner, ALIKE.near)]


def _narrower(effect: Candidate, rival: Rival) -> bool:
    """Whether the rival is the same law at one of the places only, and the logs cannot tell."""
    (*others, own) = rival.effects
    return (
        not others and own.effect == effect.effect and effect.where == "all" != own.where and rival.behind < ALIKE.mild
    )


def _in_parts(race: Race, winner: Model, effect: Candidate, say: Progress) -> list[Rival]:
    """The special cases of an effect together, where they close nearly as much as it does."""
    parts = parts_of(race, winner, effect)
    if len(parts) < 2:
        return []
    model = together(race, winner, effect, parts, say)
    behind = race.closure(winner) - race.closure(model)
    if effect in model.effects or behind > race.settings.tie:
        return []
    own = tuple(e for e in model.effects if e not in winner.effects)
    why = phrases.simpler_instead(race.closure(model), race.closure(winner))
    return [Rival(own, model, race.closure(model), why, contains=True)]


def _rivals(race: Race, winner: Model, effect: Candidate, say: Progress) -> list[Rival]:
    rest = without(race, winner, effect, say)
    others = [c for c in race.candidates if c != effect and all(compatible(c, e) for e in rest.effects)]
    if rest.effects:
        found = [s for s in screen(race.fitter, rest.fit, others, race.settings.screened) if s.gain > 0][
            : race.settings.pairs
        ]
        models = fit_models(race, [(rest, s) for s in found], "rivals", say)
    else:
        models = [m for m in ranked(race, 1) if m.effects[0] != effect]
    models = [_finished(race, winner, m) for m in models]
    out = []
    for model in models:
        (other,) = [c for c in model.effects if c not in rest.effects]
        out += _rival(race, winner, effect, (other,), model)
    if not rest.effects:
        alone = {r.effects[0] for r in out}
        for model in ranked(race, 2):
            if effect not in model.effects and alone.isdisjoint(model.effects):
                out += [
                    r
                    for r in _rival(race, winner, effect, model.effects, model)
                    if r.closure > race.closure(winner) + 0.01
                ]
    return sorted(out, key=lambda r: (len(r.effects), -r.closure))[: ALIKE.most]


def _instead_of_all(race: Race, winner: Model) -> list[Rival]:
    """Single effects that explain as much as several of the winner's together."""
    if len(winner.effects) < 2:
        return []
    out = []
    for model in ranked(race, 1):
        found = [r for e in winner.effects for r in _rival(race, winner, e, model.effects, model)]
        if found:
            out.append(replace(found[0], contains=any(r.contains for r in found)))
    return out


def _finished(race: Race, winner: Model, model: Model) -> Model:
    """A simpler rival that may not have come to its end: a few steps more where the winner is at the noise already."""
    simpler = model.size < winner.size and model.total < 100.0 * winner.total
    return (
        polish(race, model)
        if simpler and race.at_noise(winner, ALIKE.near) and not race.at_noise(model, ALIKE.near)
        else model
    )


def _rival(race: Race, winner: Model, effect: Candidate, others: tuple[Candidate, ...], model: Model) -> list[Rival]:
    c = race.better(model, winner)
    behind = race.closure(winner) - race.closure(model)
    misfit = race.above_noise(winner)
    told_apart = c.evidence > ALIKE.mild and (c.t > 2.0 or c.evidence > 3 * ALIKE.mild)
    # what is left of both is worth less than the simulators' own differences: significant, not relevant
    told_apart = told_apart and not (race.at_noise(winner, ALIKE.near) and race.at_noise(model, ALIKE.near))
    if told_apart and not (misfit and behind < race.settings.tie / 2):
        return []
    if behind > 3 * race.settings.tie:
        return []
    contains = any(effect.effect in special_cases(o) and o.where == effect.where for o in others)
    same = any(o.effect == effect.effect and compatible(o, effect) is False for o in others)
    why = phrases.CONTAINS if contains else phrases.close_by(c.evidence, behind)
    return [Rival(others, model, race.closure(model), why, contains or same, c.evidence)]


def structural(race: Tried, model: Model, sd: np.ndarray) -> dict[str, str]:
    """Known parameters that sit at a bound or move between operating conditions (Wald test, Bonferroni)."""
    from scipy import stats

    out = {}
    base = len(race.fitter.base)
    groups = len(model.estimates)
    for i, c in enumerate(model.fit.coordinates[:base]):
        value, width = model.fit.values[i], c.high - c.low
        if min(value - c.low, c.high - value) < 1e-3 * width:
            out[c.name] = phrases.stuck(value)
    if groups < 3:
        return out
    each, deviation = per_condition(race, model)
    for i, c in enumerate(model.fit.coordinates[:base]):
        z2 = float(
            np.sum(((each[:, i] - np.average(each[:, i], weights=1 / deviation[:, i] ** 2)) / deviation[:, i]) ** 2)
        )
        p = float(stats.chi2.sf(z2, groups - 1)) * base
        spread = float(np.std(each[:, i]))
        if p < 1e-3 and spread > 0.05 * (c.high - c.low) and c.name not in out:
            out[c.name] = phrases.moves(spread, groups)
    return out


def per_condition(race: Tried, model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Each condition's own estimate and standard deviation, `[G, k]`, one Newton step from the common fit."""
    q, _ = model.fit.quadratic(race.fitter.spread)
    precision, pull, low, high = model.fit.prior()
    group = race.fitter.simulator.windows.group
    each, deviation = [], []
    inflation = max(model.total / model.fit.r.size, 0.5) * model.fit.r.size / model.samples
    for name in np.unique(group):
        g, S = q.weighted(model.fit.weight * (group == name))
        H = S / inflation + np.diag(precision)
        covariance = np.linalg.pinv(H)
        each.append(model.fit.values + np.clip(covariance @ (g / inflation + pull), low, high))
        deviation.append(np.sqrt(np.diag(covariance)))
    return np.array(each), np.array(deviation)


def subsets(race: Race, model: Model, say: Progress) -> dict[frozenset[str], Model]:
    """{labels: the model with these of its effects}, every subset refitted; {} where they are too many."""
    effects = model.effects
    if len(effects) > 4:
        return {}
    out = {frozenset[str](): race.base}
    for size in range(1, len(effects) + 1):
        for some in itertools.combinations(effects, size):
            smaller = model
            for e in effects:
                if e not in some:
                    smaller = without(race, smaller, e, say)
            out[frozenset(c.label for c in some)] = smaller
    return out
