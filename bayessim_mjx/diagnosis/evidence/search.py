"""The search for sets of effects by their evidence: what promises most without a simulation is fitted, then weighed.

Single effects come first. Each further round looks at the leading set: with more effects, with others in the place of
each, and without each. It ends when the leading set leaves nothing that matters, or nothing new promises to be as
likely.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.evidence.laws import (
    as_large,
    inertia,
    neutral_beyond,
    related,
    same_lateness,
    special_case,
    stand_ins,
    with_same_inertia,
)
from bayessim_mjx.diagnosis.evidence.promises import Plan, around
from bayessim_mjx.diagnosis.evidence.weighing import Weighed, Weighing
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.selection.bounds import widened
from bayessim_mjx.diagnosis.selection.models import BASE, Key, Model, scored
from bayessim_mjx.diagnosis.selection.numbers import EFFORT, LEAVING_OUT, ODDS, SINGLES, TOGETHER, Progress
from bayessim_mjx.diagnosis.selection.search_state import SearchState
from bayessim_mjx.diagnosis.selection.successive_halving import Entries, cut_back, fit_entries, polish

Array = NDArray[np.float64]


class Search:
    """The search: fitted sets, their evidence, and plans for further sets."""

    def __init__(self, state: SearchState, say: Progress) -> None:
        self.state, self.say = state, say
        self.weighing = Weighing(state)
        self._plans: dict[Key, tuple[float, list[Plan]]] = {}  # with the evidence of the fit that they are of
        self._polished: set[Key] = set()
        self._again: set[tuple[Key, Key]] = set()

    def run(self) -> Weighed:
        """Run all rounds; returns the posterior over the fitted sets."""
        self._fit(self._worth(self._around(BASE), EFFORT.sets[:1], EFFORT.sets[1]), SINGLES, SINGLES)
        self._leading()
        for made in range(EFFORT.rounds):
            best = self._order()[0]
            todo = self._todo(best)
            if not todo or self.state.settings.budget.over(TOGETHER):
                break
            self._fit(todo, f"sets of effects, round {made + 1}", TOGETHER)
            self._leading()
        for _ in range(EFFORT.rounds):
            before = self._order()[0]
            self._finish()
            self._leading()
            best = self._order()[0]
            if best == before:
                break
            self._fit(self._todo(best), "next to the best set", TOGETHER)  # it led in none of the rounds
            self._leading()
        self._smaller()
        self._at_one_place()
        self._possible()
        return self.weighing.weighed()

    def _order(self) -> list[Key]:
        return list(self.weighing.weighed().weight)

    def _todo(self, best: Key) -> list[Plan]:
        """Plans around the leading set; if it leaves nothing relevant, larger sets have to promise more than it has."""
        smaller = [k for k in (best - {x} for x in sorted(best)) if k and k in self.weighing.scored]
        plans = [p for k in smaller for p in self._worth(self._around(k), EFFORT.sets[:1])]
        plans += [p for k in dict.fromkeys([best, *self.weighing.weighed().beside]) for p in self._related(k)]
        more = self._worth(self._around(best), EFFORT.sets)
        more += self._worth(self._around(BASE), EFFORT.sets) if best else []
        if self.weighing.settled(best):
            likelier = self.weighing.total(best) + np.log(ODDS.mention)
            more = [p for p in more if p.nats > likelier]
        plans += more
        return list({p.key: p for p in plans}.values())

    def _related(self, best: Key) -> list[Plan]:
        """In the place of an effect what may stand for it (`laws.related`), as large as it is, and as promised.

        All else begins where the effect has it: a law with a neutral number more is the same model, in the same place.
        A promise is one direction: friction that differs by direction, or falls with speed, is none of them.
        """
        out, model = [], self.state.models[best]
        for effect in model.effects:
            rest = best - {effect.label}
            if rest not in self.state.models:
                continue
            for c in (c for c in self.state.candidates if c.label not in best):
                columns, key = self.state.secants.of([c]), rest | {c.label}
                again = inertia(c, effect) or same_lateness(c, effect, self.state.fitter.simulator.physics.mj_model)
                alike = again or related(c, effect)
                if columns and alike and (self._first(best, key) if again else self._new(key)):
                    starts, known = self._begun(model, effect, c)
                    out.append(Plan(key, np.inf, rest, (columns[-1],), (1.0,), starts, best, known))
        return out

    def _first(self, best: Key, key: Key) -> bool:
        """Whether a set was not yet fitted from the leading one's inertia or delay: elsewhere it may rest far off."""
        new = (best, key) not in self._again
        self._again |= {(best, key)}
        return new

    def _begun(self, model: Model, effect: Candidate, law: Candidate) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Where a law begins in the place of an effect: (its numbers, the known parameters beside them)."""
        if inertia(law, effect):
            start = with_same_inertia(self.state.fitter, model, effect, law)
            return ((), ()) if start is None else ((start.own,), (start.known,))
        return as_large(law, effect, model.values_of(effect)), ()

    def _new(self, key: Key) -> bool:
        return key not in self.state.models and key not in self.state.vain

    def _around(self, key: Key) -> list[Plan]:
        """Plans around a set, anew where its fit has gained since: their evidence is counted from that fit."""
        total = self.weighing.total(key)
        if key not in self._plans or abs(self._plans[key][0] - total) > np.log(ODDS.mention):
            self._plans[key] = total, around(self.weighing, key, self.say)
        return self._plans[key][1]

    def _worth(self, plans: Sequence[Plan], sizes: Sequence[int], least: int = 0) -> list[Plan]:
        """Return the best of the new ones, so many of each size: a larger set also mends what is not linear."""
        top = max(self.weighing.weighed().nats.values())
        out: dict[Key, Plan] = {}
        count = [0] * len(sizes)
        for plan in sorted(plans, key=lambda p: -p.nats):
            size = len(plan.columns) - 1
            if size >= len(sizes) or not self._new(plan.key) or plan.key in out:
                continue
            if count[size] < (sizes[size] if plan.nats > top - EFFORT.margin else least):
                out[plan.key] = plan
                count[size] += 1
        return list(out.values())

    def _leading(self) -> None:
        """Wider ranges for what leads, and this without each of its effects, as long as that is new.

        Near the leading set too: a law that is not quite right has others beside it, which the right one needs no more.
        """
        while True:
            some = [k for k in self._order()[: len(EFFORT.sets)] if k]
            for key in some:
                widened(self.state, self.state.models[key], self.say)
            self.weighing.score(some)
            nats = self.weighing.weighed().nats
            near = [k for k in some if nats.get(k, -np.inf) > max(nats.values()) - EFFORT.margin]
            fewer = {k - {x}: k for k in near[::-1] for x in sorted(k) if k - {x} not in self.weighing.scored}
            if not fewer or self.state.settings.budget.over(LEAVING_OUT):
                return
            self._fit([Plan(key, np.inf, parent) for key, parent in fewer.items()], "leaving effects out", LEAVING_OUT)

    def _finish(self) -> None:
        """Bring the fits of the finalists to their end: of sets that may be the answer (`Effort.margin`)."""
        total = {k: self.weighing.total(k) for k in self._order()[: EFFORT.sets[0]]}
        near = [k for k, nats in total.items() if nats > max(total.values()) - EFFORT.margin]
        some = [k for k in near if k and k not in self._polished]
        if some and not self.state.settings.budget.over(LEAVING_OUT):
            polish(self.state, [self.state.models[k] for k in some], self.say)
            self._polished |= set(some)
            self.weighing.score(some)

    def _smaller(self) -> None:
        """Fit the leading set without each of its effects, from where it came to rest.

        A smaller set was fitted from elsewhere and may rest far off (a payload's mass and lever), so that a further
        effect seemed to be needed.
        """
        best = self._order()[0]
        plans = [Plan(best - {x}, np.inf, best) for x in sorted(best) if len(best) > 1]
        if plans and not self.state.settings.budget.over(LEAVING_OUT):
            self._fit(plans, "leaving effects out", LEAVING_OUT)

    def _possible(self) -> None:
        """Add to the answer one effect that may do the work of a known parameter.

        The logs do not need it, so it changes no name. It widens the interval of the parameter. A fit of before began
        at the parameter as it is, and may rest there.
        """
        key = self.weighing.weighed().answer
        known = (model := self.state.models[key]).fit.values[: len(self.state.fitter.base)]
        plans = [
            Plan(
                key | {s.column.candidate.label}, np.inf, key, (s.column,), (1.0,), (s.point,), key,
                (known - s.steps[: len(known)],),
            )
            for s in sorted(stand_ins(self.state, model), key=lambda s: -s.nats)[: EFFORT.sets[0]]
        ]  # fmt: skip
        if plans and self.state.settings.budget.over(TOGETHER):
            self.state.skipped["with known parameters, whose intervals are too narrow"] = len(plans)
        elif plans:
            self._fit(plans, "with known parameters", TOGETHER)

    def _at_one_place(self) -> None:
        """Try special cases where the laws that contain them came to rest: with the rest neutral both are one model.

        Friction that sticks makes a cost of many small basins, whose evidence differs by up to six nats.
        """
        found = self.weighing.weighed()
        for key in (found.answer, *found.beside):
            model = self.state.models[key]
            for law in model.effects:
                for c in (c for c in self.state.candidates if special_case(c, law) and c.where == law.where):
                    self._placed(model, law, c)

    def _placed(self, model: Model, law: Candidate, case: Candidate) -> None:
        """Try a special case in the place of a model's law, as large as it is; keep it where it is likelier."""
        state, starts = self.state, as_large(case, law, model.values_of(law))
        kept = tuple(e for e in model.effects if e is not law)
        if not starts:
            return
        fit = state.fitter.refresh(state.fitter.derive(cut_back(state, model, kept), case.coordinates, starts[0]))
        key = frozenset(e.label for e in (*kept, case))
        self._likelier({key: scored(state.fitter, fit, (*kept, case))})
        apart = 0.5 * float(np.sum((fit.r - model.fit.r) ** 2))  # nats: what the logs would tell of two such models
        if neutral_beyond(case, law, model.values_of(law)) or apart < np.log(ODDS.mention):
            self.weighing.special[frozenset(e.label for e in model.effects)] = key

    def _likelier(self, models: Mapping[Key, Model]) -> None:
        """Take models in the place of those of the same effects, where they are likelier."""
        before = {k: (self.state.models[k], self.weighing.scored[k]) for k in models if k in self.weighing.scored}
        self.state.models.update(models)
        self.weighing.score(list(models))
        for key, (model, found) in before.items():
            if self.weighing.scored[key].found.nats < found.found.nats:
                self.state.models[key], self.weighing.scored[key] = model, found
            else:
                self._polished.discard(key)

    def _fit(self, plans: Sequence[Plan], label: str, part: str) -> None:
        entries: Entries = {plan.key: self._entry(plan) for plan in plans}
        parents = {p.key: self.state.models[p.parent] for p in plans if p.columns}
        old = {key: self.state.models[key] for key in entries if key in self.weighing.scored}
        fit_entries(self.state, entries, label, self.say, part, parents)
        new = {key: self.state.models[key] for key in old if self.state.models[key] is not old[key]}
        self.state.models.update(old)
        self._likelier(new)
        self.weighing.score([p.key for p in plans])

    def _entry(self, plan: Plan) -> tuple[list[Fit], tuple[Candidate, ...]]:
        state, model = self.state, self.state.models[plan.parent if plan.origin is None else plan.origin]
        kept = tuple(e for e in model.effects if e.label in plan.key)
        fit = model.fit if len(kept) == len(model.effects) else cut_back(state, model, kept)
        if not plan.columns:
            return [fit], kept
        now = {c.label: c for c in state.candidates}  # in ranges as wide as they are by now
        new = [now[c.candidate.label] for c in plan.columns]
        coordinates = [c for e in new for c in e.coordinates]
        starts = [np.concatenate([c.at(t) for c, t in zip(plan.columns, plan.amounts, strict=True)])]
        starts += [p for i, p in enumerate(plan.points) if not any(np.array_equal(p, q) for q in plan.points[:i])]
        begun = state.begun(fit)
        fits = [begun] * len(starts)
        for i, known in enumerate(plan.known, len(starts) - len(plan.known)):
            fits[i] = replace(begun, values=np.concatenate([known, begun.values[len(known) :]]))
        return [state.fitter.derive(f, coordinates, s) for f, s in zip(fits, starts, strict=True)], (*kept, *new)
