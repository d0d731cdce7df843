"""The search for sets of effects by their evidence: what promises most without a simulation is fitted, then weighed.

Each round looks at the leading model: what columns promise beside it, in the place of each of its effects, and without
each of them. What is fitted is weighed by its own evidence. It ends when no set that promises to be as likely as the
leading one is left unfitted.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.evidence.columns import Column, Part, Promise, Promises
from bayessim_mjx.diagnosis.evidence.gaussian import Hyper, Learnt, learn, windows_of
from bayessim_mjx.diagnosis.evidence.parameters import Integrated, belief_of, integrated
from bayessim_mjx.diagnosis.selection.sets import RELEVANCE, Key, Weighed, log_prior, weighed
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit
from bayessim_mjx.diagnosis.residual import forcing
from bayessim_mjx.diagnosis.selection.bounds import widened
from bayessim_mjx.diagnosis.selection.fits import cut_back
from bayessim_mjx.diagnosis.selection.laws import beside
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.pool import Entries, Pool, Progress, fit_entries, polish
from bayessim_mjx.diagnosis.selection.screen import looked_at, simulated

Array = NDArray[np.float64]
BASE: Key = frozenset()


@dataclass(frozen=True)
class Effort:
    """How much is fitted; more of each finds the same sets, later.

    Attributes:
        rounds: of looking around the leading model, at most.
        first: sets that are fitted in the first round, and in each further one.
        pairs: best pairs of columns of a look; seeds: sets that larger ones grow from.
        points: starting points of a candidate that are looked at in sets; anew: candidates simulated on a further model.
        margin: nats below the leading model, within which a promise is worth a fit: promises are linear.
        most: effects in a set.
    """

    rounds: int = 5
    first: int = 12
    further: int = 8
    pairs: int = 24
    seeds: int = 6
    points: int = 3
    anew: int = 16
    margin: float = 30.0
    most: int = 8


EFFORT = Effort()


@dataclass(frozen=True, eq=False)
class Scored:
    """A fitted model with its evidence."""

    model: Model
    learnt: Learnt
    found: Integrated


@dataclass(frozen=True)
class Plan:
    """A set that promises something: its evidence and prior over the known parameters, and how to begin its fit."""

    key: Key
    nats: float
    parent: Key
    columns: tuple[Column, ...]
    amounts: tuple[float, ...]


class Search:
    """The sets fitted so far, their evidence, and what promises more."""

    def __init__(self, pool: Pool, say: Progress) -> None:
        self.pool, self.say, fitter = pool, say, pool.fitter
        self.scale = forcing.force_scale(fitter)
        self.D = forcing.columns(fitter, pool.base.fit, forcing.default_nodes(fitter), self.scale)
        self.channels = int(fitter.used.sum())
        self.scored: dict[Key, Scored] = {}
        self.candidates = {c.label: c for c in pool.candidates}
        self._looked: set[Key] = set()

    def run(self) -> Weighed:
        """All rounds; the posterior over what was fitted."""
        self.score([BASE])
        for made in range(EFFORT.rounds):
            best = self.leading()[0]
            if best and self.excess(best) <= RELEVANCE.noise + RELEVANCE.share * max(self.excess(BASE), 0.0):
                break
            plans = self.plans(best)
            todo = self._worth(plans, EFFORT.further if made else EFFORT.first, least=0 if made else 6)
            if todo:
                self.fit(todo, f"round {made + 1}")
            self.better(self.leading()[:3])
            if not todo and self.leading()[0] == best:
                break
        self.finish()
        return self.weighed()

    def leading(self) -> list[Key]:
        return list(self.weighed().weight)

    def weighed(self) -> Weighed:
        excess = {k: self.excess(k) for k in self.scored}
        return weighed({k: s.found.nats for k, s in self.scored.items()}, excess, len(self.pool.candidates))

    def excess(self, key: Key) -> float:
        """Held-out squared error above the noise, in noise variances, mean of the windows."""
        model = self.scored[key].model
        return model.total / (self.pool.noise * len(model.cost)) - 1.0

    def total(self, key: Key) -> float:
        """Log of evidence and prior over those of the known parameters alone."""
        count = len(self.pool.candidates)
        return self.scored[key].found.nats + log_prior(key, count) - self.scored[BASE].found.nats

    def score(self, keys: Iterable[Key], like: Hyper | None = None) -> None:
        """The evidence of models that are fitted, anew where the fit is another."""
        fitter = self.pool.fitter
        for key in keys:
            model, old = self.pool.models.get(key), self.scored.get(key)
            if model is None or (old is not None and old.model is model):
                continue
            fit = model.fit
            begin = like if like is not None else None if BASE not in self.scored else self.scored[BASE].learnt.hyper
            own = windows_of(fit.r, fit.A, fit.B, self.D, fit.offsets, fitter.spread, self.scale, self.channels)
            learnt = learn(own, belief_of(fit), begin)
            self.scored[key] = Scored(model, learnt, integrated(fit, learnt))

    def finish(self) -> None:
        """The leading models brought to their end, and weighed with all memories of the force."""
        for _ in range(3):
            keys = [k for k in self.leading()[:6] if k]
            before = {k: self.pool.models[k] for k in keys}
            todo = [k for k in keys if k not in self._polished()]
            if not todo:
                break
            polish(self.pool, [self.pool.models[k] for k in todo], self.say)
            self._done |= set(todo)
            for k in todo:
                widened(self.pool, self.pool.models[k], self.say)
            self.score([k for k in keys if self.pool.models[k] is not before[k]])

    _done: set[Key] = set()

    def _polished(self) -> set[Key]:
        if "_done" not in self.__dict__:
            self._done = set()
        return self._done

    def better(self, keys: Sequence[Key]) -> None:
        """Wider ranges for leading models with a number at the end of one."""
        for key in keys:
            if key:
                widened(self.pool, self.pool.models[key], self.say)
        self.score(keys)
        self.candidates = {c.label: c for c in self.pool.candidates}

    # what promises more

    def plans(self, best: Key) -> list[Plan]:
        """Sets around the leading one, most promising first."""
        found = [] if best in self._looked else self._beside(best)
        self._looked.add(best)
        smaller = [best - {label} for label in best]
        for rest in smaller:
            if rest and rest not in self.scored:
                found.append(Plan(rest, np.inf, best, (), ()))
            elif rest in self.scored and rest not in self._looked:
                found += self._beside(rest)
                self._looked.add(rest)
        return sorted(found, key=lambda p: -p.nats)

    def _worth(self, plans: Sequence[Plan], most: int, least: int) -> list[Plan]:
        new: dict[Key, Plan] = {}
        for plan in plans:
            if plan.key not in self.pool.models and plan.key not in new:
                new[plan.key] = plan
        top = max(self.weighed().nats.values())
        return [p for i, p in enumerate(new.values()) if i < most and (i < least or p.nats > top - EFFORT.margin)]

    def _beside(self, key: Key) -> list[Plan]:
        """Sets that add to a fitted model, by its columns."""
        pool, model = self.pool, self.pool.models[key]
        fit, hyper = pool.begun(model.fit), self.scored[key].learnt.hyper
        others = [c for c in self.candidates.values() if all(beside(c, e) for e in model.effects)]
        columns = self._known(others)
        if not columns:
            return []
        promises = self._promises(fit, hyper, pool.secants.own, columns)
        if key:  # what was simulated on the known parameters leads to what is simulated here
            ranked = self._first(promises.singles(), columns)[: EFFORT.anew * EFFORT.points]
            labels = list(dict.fromkeys(columns[p.own[0]].candidate.label for p in ranked))[: EFFORT.anew]
            some = [self.candidates[label] for label in labels]
            plans = [(labels.index(columns[p.own[0]].candidate.label), columns[p.own[0]].point) for p in ranked if columns[p.own[0]].candidate.label in labels]
            own = looked_at(fit, pool.settings.screened)
            columns = [Column(some[i], point, change) for i, point, change in simulated(pool.fitter, fit, some, plans, own, self.say)]
            promises = self._promises(fit, hyper, own, columns)
        return self._sets(key, promises)

    def _known(self, others: Sequence[Candidate]) -> list[Column]:
        return [Column(c, point, change) for c in others for point, change in self.pool.secants.columns.get(c.label, ())]

    def _promises(self, fit: Fit, hyper: Hyper, own: NDArray[np.int64], columns: Sequence[Column]) -> Promises:
        part = Part(fit.r[own], fit.A[own], self.D[own], fit.B[own], fit.offsets[own], self.pool.fitter.spread, self.scale, self.channels, len(fit.r) / len(own))
        return Promises(part, belief_of(fit), hyper, columns)

    def _first(self, singles: Sequence[Promise], columns: Sequence[Column]) -> list[Promise]:
        """Of each candidate its best points, the most promising first."""
        count: dict[str, int] = {}
        out = []
        for p in sorted(singles, key=lambda p: -p.nats):
            label = columns[p.own[0]].candidate.label
            count[label] = count.get(label, 0) + 1
            if count[label] <= EFFORT.points:
                out.append(p)
        return out

    def _sets(self, key: Key, promises: Promises) -> list[Plan]:
        columns = promises.columns
        singles = self._first(promises.singles(), columns)
        blocked = np.array([[not beside(a.candidate, b.candidate) for b in columns] for a in columns])
        found = {p.own: p for p in singles}
        pairs = promises.pairs(blocked, EFFORT.pairs)
        found |= {p.own: p for p in pairs}
        price = -log_prior(frozenset("x"), len(self.pool.candidates))
        seeds = sorted(found.values(), key=lambda p: price * len(p.own) - p.nats)[: EFFORT.seeds]
        usable = [p.own[0] for p in singles]
        for seed in seeds:
            grown = seed
            while len(key) + len(grown.own) < EFFORT.most:
                more = [tuple(sorted((*grown.own, j))) for j in usable if not any(blocked[j, i] for i in grown.own)]
                each = promises.of(more)
                top = max(each, key=lambda p: p.nats, default=None)
                if top is None or top.nats < grown.nats + price:
                    break
                grown = top
                found[grown.own] = grown
        total = self.total(key)
        plans = []
        for p in found.values():
            some = [columns[j] for j in p.own]
            own = key | {c.candidate.label for c in some}
            if len(own) == len(key) + len(some):
                plans.append(Plan(own, total + p.nats - price * len(some), key, tuple(some), tuple(map(float, p.amounts))))
        return sorted(plans, key=lambda p: -p.nats)

    # fits

    def fit(self, plans: Sequence[Plan], label: str) -> None:
        entries: Entries = {plan.key: self._entry(plan) for plan in plans}
        fit_entries(self.pool, entries, label, self.say)
        self.score([p.key for p in plans])

    def _entry(self, plan: Plan) -> tuple[list[Fit], tuple[Candidate, ...]]:
        pool, model = self.pool, self.pool.models[plan.parent]
        kept = tuple(e for e in model.effects if e.label in plan.key)
        fit = model.fit if len(kept) == len(model.effects) else cut_back(pool, model, kept)
        if not plan.columns:
            return [fit], kept
        fit = pool.begun(fit)
        new = [self.candidates[c.candidate.label] for c in plan.columns]
        coordinates = [c for e in new for c in e.coordinates]
        starts = [np.concatenate([c.at(t) for c, t in zip(plan.columns, plan.amounts, strict=True)])]
        if len(new) == 1:
            starts.append(plan.columns[0].point)
        return [pool.fitter.derive(fit, coordinates, s) for s in starts], (*kept, *new)
