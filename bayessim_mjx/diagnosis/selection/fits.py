"""Fits of whole sets of effects for the search, on a race's simulator: extended, cut back, or all at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit
from bayessim_mjx.diagnosis.selection import dense, heldout, race
from bayessim_mjx.diagnosis.selection.beam import Plan
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.race import Progress, Race
from bayessim_mjx.diagnosis.selection.screen import Screened, screen
from bayessim_mjx.diagnosis.selection.table import BASE, Key, Law, Row, Table
from bayessim_mjx.diagnosis.selection.uncertainty import deviations


@dataclass(frozen=True)
class Limits:
    """How much is fitted and looked at."""

    many: int = 5  # models of one call that are fitted from many starts
    # models within this factor of the least cost are asked whether their effects are there
    contenders: float = 3.0


LIMITS = Limits()


class Fits:
    """The models of a race, as a table of scores that grows with what the search asks for."""

    def __init__(self, race: Race, say: Progress) -> None:
        self.race, self.say = race, say
        self.candidates = {c.label: c for c in race.candidates}
        self.laws = {c.label: law_of(c) for c in race.candidates}
        self._rows: dict[Key, tuple[Model, Row]] = {}
        self._folds: dict[Key, tuple[Model, Row]] = {}
        self._screened: dict[Key, list[Screened]] = {BASE: list(race.screened)}
        self._polished: set[Key] = set()
        self._amounts: dict[Key, tuple[Screened, ...]] = {}

    @property
    def table(self) -> Table:
        """All models so far."""
        race = self.race
        least = min(m.total for m in race.models.values())
        rows = {key: self._row(key, m, m.total < LIMITS.contenders * least) for key, m in race.models.items()}
        group = race.fitter.simulator.windows.group
        return Table(rows, self.laws, group, race.noise, race.settings.believed)

    def _row(self, key: Key, model: Model, contender: bool) -> Row:
        fitted, row = self._rows.get(key, (None, None))
        if fitted is not model or row is None or (contender and len(row.distance) < len(key)):
            distance = distances(self.race, model) if contender else {}
            row = Row(key, model.size, model.cost, model.samples, distance)
            self._rows[key] = (model, row)
        return row

    def additions(self, key: Key) -> list[str]:
        """Candidates that may bring something on top of a model, the most promising first."""
        if key not in self._screened:
            model = self.race.models[key]
            others = [c for c in self.race.candidates if all(race.compatible(c, e) for e in model.effects)]
            self.say("screening", 0, 1)
            self._screened[key] = screen(self.race.fitter, model.fit, others, self.race.settings.screened)
        return [s.candidate.label for s in self._screened[key] if s.gain > 0]

    def together(self, most: int, count: int) -> list[Key]:
        """Sets of effects that promise most when all amplitudes are free at once (`dense`)."""
        found = dense.supports(self.race.base.fit, self.race.screened, self.race.settings.screened, most, count)
        self._amounts = {frozenset(s.candidate.label for s in starts): tuple(starts) for starts in found}
        return list(self._amounts)

    def fit(self, plans: Sequence[Plan], label: str) -> None:
        """Fit what was not fitted before, all in lockstep."""
        entries: dict[Key, tuple[list[Fit], tuple[Candidate, ...]]] = {}
        for plan in plans:
            if plan.key not in self.race.models and plan.key not in entries:
                entries[plan.key] = self._entry(plan, len(entries))
        race.fit_entries(self.race, entries, label, self.say)

    def _entry(self, plan: Plan, rank: int) -> tuple[list[Fit], tuple[Candidate, ...]]:
        model = self.race.models[plan.parent]
        kept = tuple(e for e in model.effects if e.label in plan.key)
        new = [self.candidates[label] for label in sorted(plan.key - plan.parent)]
        fit = model.fit if len(kept) == len(model.effects) else cut_back(self.race, model, kept)
        if not new:
            return [fit], kept
        starts = self._amounts.get(plan.key) if plan.parent == BASE else None
        every = [starts or tuple(self._start(plan.parent, c) for c in new)]
        if all(frozenset([c.label]) in self.race.models for c in new):
            every.append(tuple(race.start_of(self.race, c) for c in new))  # a limit far off has no derivative
        fits = [self._from(fit, several) for several in every]
        if len(new) == 1:
            from_here = replace(model, effects=kept, fit=fit)
            if rank < LIMITS.many:
                fits[:1] = race.starts(self.race, from_here, every[0][0], rank)
        return fits, (*kept, *(s.candidate for s in every[0]))

    def _from(self, fit: Fit, starts: Sequence[Screened]) -> Fit:
        coordinates = [c for s in starts for c in s.candidate.coordinates]
        return self.race.fitter.derive(fit, coordinates, np.concatenate([s.start for s in starts]))

    def _start(self, parent: Key, candidate: Candidate) -> Screened:
        for key in (parent, BASE):
            for found in self._screened.get(key, []):
                if found.candidate.label == candidate.label:
                    return found
        raise KeyError(f"{candidate.label} was not screened")

    def polish(self, key: Key) -> None:
        """All columns anew at a model's fit, and some more steps."""
        if key and key not in self._polished:
            self._polished.add(key)
            self.say("polishing", 0, 1)
            race.polish(self.race, self.race.models[key])

    def simulate(self, keys: Sequence[Key]) -> Table:
        """A table of some models, whose held-out windows are simulated with the parameters found without them."""
        fitter, known = self.race.fitter, self.table
        steps = fitter.simulator.windows.steps
        for key in keys:
            model = self.race.models[key]
            if self._folds.get(key, (None, None))[0] is model:
                continue
            self.say("held out", 0, 1)
            cost = heldout.predict(fitter, heldout.steadied(fitter, model)).cost(steps) * self.race.noise
            self._folds[key] = (model, replace(known.rows[key], cost=cost, simulated=True))
        return replace(known, rows={key: self._folds[key][1] for key in keys})


def law_of(candidate: Candidate) -> Law:
    """What a decision knows of a candidate."""
    index = frozenset(i for c in candidate.coordinates for i in c.index)
    special = race.special_cases(candidate)
    return Law(candidate.label, candidate.effect, candidate.where, len(candidate.coordinates), index, special)


def distances(race: Race, model: Model) -> dict[str, float]:
    """{effect: standard deviations that its best told amplitude is away from neutral}."""
    if not model.effects:
        return {}
    sd = deviations(race.fitter, model)
    out = {}
    for effect in model.effects:
        own = [
            model.fit.names.index(c.name)
            for c, shape in zip(effect.coordinates, effect.shapes, strict=True)
            if not shape
        ]
        neutral = [c.neutral for c, shape in zip(effect.coordinates, effect.shapes, strict=True) if not shape]
        off = [abs(model.fit.values[i] - n) / max(sd[i], 1e-300) for i, n in zip(own, neutral, strict=True)]
        out[effect.label] = float(max(off, default=0.0))
    return out


def cut_back(race: Race, model: Model, kept: Sequence[Candidate]) -> Fit:
    """A fit of some of a model's effects, from where the model is; its first residuals come with the first step."""
    fit, base = model.fit, len(race.fitter.base)
    names = {c.name for e in kept for c in e.coordinates}
    own = [i for i, c in enumerate(fit.coordinates) if i < base or c.name in names]
    coordinates = tuple(fit.coordinates[i] for i in own)
    return Fit(coordinates, fit.values[own], fit.offsets, fit.r, fit.A[:, :, own], fit.B, fit.weight, np.inf)
