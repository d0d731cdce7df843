"""The selection by evidence: from candidates to the answer, what stands beside it, and their probabilities."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from bayessim_mjx.diagnosis import phrases
from bayessim_mjx.diagnosis.evidence.estimates import at_its_mean, estimated, size_in
from bayessim_mjx.diagnosis.evidence.search import Search
from bayessim_mjx.diagnosis.evidence.weighing import Weighing
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.selection import hidden, predicted_gain, stand_ins
from bayessim_mjx.diagnosis.selection.begin import begin
from bayessim_mjx.diagnosis.selection.budget import LEAVING_OUT
from bayessim_mjx.diagnosis.selection.laws import compatible, special_cases
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.pool import Entries, Pool, Progress, cut_back, fit_entries
from bayessim_mjx.diagnosis.selection.selected import Rival, Selection, selection_of
from bayessim_mjx.diagnosis.selection.sets import BASE, Key, Weighed
from bayessim_mjx.diagnosis.selection.tried import Settings, Tried

MANY = 4  # effects, up to which every subset is fitted


def select(
    fitter: Fitter,
    candidates: Sequence[Candidate],
    settings: Settings,
    say: Progress,
    keep: Callable[[Tried], None] = lambda tried: None,
) -> Selection:
    """What the logs on the windows of `fitter` call for; `keep` is called with what was tried so far."""
    pool = begin(fitter, candidates, settings, say, keep)
    search = Search(pool, say)
    found = search.run()
    keep(pool)
    at_its_mean(search.weighing, found.answer)
    pool.base = pool.models[BASE]
    names = np.unique(fitter.simulator.windows.group)
    chosen = {int(g): search.weighing.without(int(g)).answer for g in names} if len(names) > 1 and found.answer else {}
    answer = pool.models[found.answer]
    few = 1 < len(answer.effects) <= MANY and not settings.budget.over(LEAVING_OUT)
    return selection_of(
        pool,
        answer,
        rivals={e.label: tuple(_rivals(search.weighing, e, found)) for e in answer.effects},
        subsets=_subsets(pool, answer, say) if few else {},
        promised=predicted_gain.promised(pool, answer.effects) if answer.effects else (0.0, {}),
        chosen=chosen,
        elsewhere=_elsewhere(pool, chosen),
        hidden=hidden.beside(pool, answer, say),
        stand_ins=stand_ins.of_parameters(pool, answer),
        weighed=found,
        estimated=estimated(search.weighing, found),
    )


def _rivals(weighing: Weighing, effect: Candidate, found: Weighed) -> list[Rival]:
    """What may stand in an effect's place, most likely first: sets without strong evidence against them."""
    others = [k for k in found.beside if k and not found.answer < k]
    return [_rival(weighing, effect, k, found) for k in others if effect.label not in k and k - found.answer]


def _rival(weighing: Weighing, effect: Candidate, key: Key, found: Weighed) -> Rival:
    pool = weighing.pool
    model, answer = pool.models[key], pool.models[found.answer]
    others = tuple(e for e in model.effects if e.label not in found.answer)
    contains = any(effect.effect in special_cases(o) and o.where == effect.where for o in others)
    same = any(o.effect == effect.effect and not compatible(o, effect) for o in others)
    closed = pool.gap(model).closed
    nats = found.nats[found.answer] - found.nats[key]
    why = phrases.CONTAINS if contains else phrases.close_by(nats, pool.gap(answer).closed - closed)
    size = size_in(weighing.scored[key], others[0]) if len(others) == 1 else None
    return Rival(others, model, closed, why, contains or same, size)


def _subsets(pool: Pool, answer: Model, say: Progress) -> dict[Key, Model]:
    """{labels: the model with these of the answer's effects}, each fitted from one with one effect more."""
    every = frozenset(e.label for e in answer.effects)
    for size in range(len(every) - 1, 0, -1):
        entries: Entries = {}
        for own in map(frozenset, itertools.combinations(sorted(every), size)):
            parent = pool.models.get(own | {min(every - own)})
            if own not in pool.models and parent is not None:
                kept = tuple(e for e in parent.effects if e.label in own)
                entries[own] = ([cut_back(pool, parent, kept)], kept)
        fit_entries(pool, entries, "dropping", say, LEAVING_OUT)
    known = itertools.chain.from_iterable(itertools.combinations(every, n) for n in range(len(every) + 1))
    found = {frozenset(own): pool.models.get(frozenset(own)) for own in known}
    return {own: model for own, model in found.items() if model is not None} if all(found.values()) else {}


def _elsewhere(pool: Pool, chosen: Mapping[int, Key]) -> float:
    """Share of the squared gap closed on operating conditions that the choice was made without, at most 1.

    The fits behind the choice had seen the condition, so the share is a little too high. A share much below that of the
    answer means that the answer was chosen for what it does by chance. NaN of one condition, and where there is no gap.
    """
    group = pool.fitter.simulator.windows.group
    after = sum(float(np.sum(pool.models[k].cost[group == g])) for g, k in chosen.items())
    return replace(pool.gap(pool.models[BASE]), after=after).closed if chosen else float("nan")
