"""Fits of whole sets of effects for the search, on a pool's simulator: extended, cut back, or all at once."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.data_sheet import DRIVES
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit
from bayessim_mjx.diagnosis.selection import chance, dense, heldout
from bayessim_mjx.diagnosis.selection.beam import Plan
from bayessim_mjx.diagnosis.selection.bounds import widened
from bayessim_mjx.diagnosis.selection.budget import LEAVING_OUT, TOGETHER
from bayessim_mjx.diagnosis.selection.laws import beside, law_of
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.pool import (
    Pool,
    Progress,
    fit_entries,
    polish,
    start_of,
    starts,
)
from bayessim_mjx.diagnosis.selection.screen import Screened, screen
from bayessim_mjx.diagnosis.selection.table import BASE, Key, Row, Table
from bayessim_mjx.diagnosis.selection.uncertainty import deviations

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """How much is fitted and looked at."""

    many: int = 5  # models of one call that are fitted from many starts
    # models within this factor of the least cost are asked whether their effects are there
    contenders: float = 3.0
    steps: float = 0.1  # of the simulator's time steps: a shorter lag or delay is what integrators differ by


LIMITS = Limits()


class Fits:
    """The models of a pool, as a table of scores that grows with what the search asks for."""

    def __init__(self, pool: Pool, say: Progress) -> None:
        self.pool, self.say = pool, say
        self.laws = {c.label: law_of(c) for c in pool.candidates}
        self._rows: dict[Key, tuple[Model, Row]] = {}
        self._folds: dict[Key, tuple[Model, Row]] = {}
        self._screened: dict[Key, list[Screened]] = {BASE: list(pool.screened)}
        self._polished: set[Key] = set()
        self._amounts: dict[Key, tuple[Screened, ...]] = {}

    @functools.cached_property
    def _chance(self) -> Array:
        return chance.of(self.pool) if self.pool.above_noise(self.pool.base) else np.zeros(0)

    @property
    def candidates(self) -> dict[str, Candidate]:
        """By their labels, in ranges as wide as they are by now."""
        return {c.label: c for c in self.pool.candidates}

    @property
    def table(self) -> Table:
        """All models so far."""
        pool = self.pool
        least = min(m.total for m in pool.models.values())
        rows = {key: self._row(key, m, m.total < LIMITS.contenders * least) for key, m in pool.models.items()}
        group = pool.fitter.simulator.windows.group
        settings = pool.settings
        return Table(rows, self.laws, group, pool.noise, settings.believed, self._chance, settings.tolerated)

    def _row(self, key: Key, model: Model, contender: bool) -> Row:
        fitted, row = self._rows.get(key, (None, None))
        if fitted is not model or row is None or (contender and len(row.distance) < len(key)):
            distance = distances(self.pool, model) if contender else {}
            row = Row(key, model.size, model.cost, model.samples, distance, belief=model.belief)
            self._rows[key] = (model, row)
        return row

    def additions(self, key: Key) -> list[str]:
        """Candidates that may bring something on top of a model, the most promising first."""
        return list(self.promises(key))

    def promises(self, key: Key) -> dict[str, float]:
        """{label: predicted drop of the cost} of candidates on top of a model, the most promising first."""
        if key not in self._screened:
            model = self.pool.models[key]
            others = [c for c in self.pool.candidates if all(beside(c, e) for e in model.effects)]
            pool = self.pool
            begun = pool.begun(model.fit)
            found = screen(pool.fitter, begun, others, pool.settings.screened, self.say, pool.secants)
            self._screened[key] = found
        return {s.candidate.label: s.gain for s in self._screened[key] if s.gain > 0}

    def together(self, most: int, count: int) -> list[Key]:
        """Sets of effects that promise most when all amplitudes are free at once (`dense`)."""
        fit = self.pool.begun(self.pool.base.fit)
        found = dense.supports(fit, self.pool.screened, self.pool.settings.screened, most, count)
        self._amounts = {frozenset(s.candidate.label for s in starts): tuple(starts) for starts in found}
        return list(self._amounts)

    def proposed(self, most: int) -> list[Key]:
        """The effects that were proposed before the search, the first laws of them, each from its own screening.

        What drives have that models leave out counts as one law.
        """
        known = [c for c in self.pool.screened if c.candidate.label in self.pool.settings.together]
        together = self.pool.settings.together  # the best told first
        effects = list(dict.fromkeys(label.split("@", 1)[0] for label in together))
        drives = [e for e in effects if e in DRIVES]
        others = [e for e in effects if e not in DRIVES]
        first = [*drives, *others[: most - 1]] if len(drives) > 1 else effects[:most]
        own = [s.candidate for s in known if s.candidate.effect in first]
        apart = all(beside(a, b) for i, a in enumerate(own) for b in own[:i])
        return [frozenset(c.label for c in own)] if len(own) > 1 and apart else []

    def over(self, part: str) -> bool:
        """Whether a part of the search has had its time."""
        return self.pool.settings.budget.over(part)

    def fit(self, plans: Sequence[Plan], label: str, needed: bool = False) -> None:
        """Fit what was not fitted before; needed: also when further effects have had their time."""
        entries: dict[Key, tuple[list[Fit], tuple[Candidate, ...]]] = {}
        for plan in plans:
            if plan.key not in self.pool.models and plan.key not in entries:
                entries[plan.key] = self._entry(plan, len(entries))
        fit_entries(self.pool, entries, label, self.say, LEAVING_OUT if needed else TOGETHER)

    def _entry(self, plan: Plan, rank: int) -> tuple[list[Fit], tuple[Candidate, ...]]:
        model = self.pool.models[plan.parent]
        kept = tuple(e for e in model.effects if e.label in plan.key)
        new = [self.candidates[label] for label in sorted(plan.key - plan.parent)]
        fit = model.fit if len(kept) == len(model.effects) else cut_back(self.pool, model, kept)
        if not new:
            return [fit], kept
        fit = self.pool.begun(fit)
        given = self._amounts.get(plan.key) if plan.parent == BASE else None
        every = [given or tuple(self._start(plan.parent, c) for c in new)]
        if all(frozenset([c.label]) in self.pool.models for c in new):
            every.append(tuple(start_of(self.pool, c) for c in new))  # a limit far off has no derivative
        fits = [self._from(fit, several) for several in every]
        if len(new) == 1:
            from_here = replace(model, effects=kept, fit=fit)
            if rank < LIMITS.many:
                fits[:1] = starts(self.pool, from_here, every[0][0], rank)
        return fits, (*kept, *(s.candidate for s in every[0]))

    def _from(self, fit: Fit, starts: Sequence[Screened]) -> Fit:
        coordinates = [c for s in starts for c in s.candidate.coordinates]
        return self.pool.fitter.derive(fit, coordinates, np.concatenate([s.start for s in starts]))

    def _start(self, parent: Key, candidate: Candidate) -> Screened:
        for key in (parent, BASE):
            for found in self._screened.get(key, []):
                if found.candidate.label == candidate.label:
                    return found
        raise KeyError(f"{candidate.label} was not screened")

    def polish(self, keys: Sequence[Key]) -> None:
        """All columns anew at the models' fits, and some more steps, in ranges as wide as it takes."""
        todo = [k for k in keys if k and k not in self._polished and k in self.pool.models]
        if todo and not self.over(LEAVING_OUT):
            polished = polish(self.pool, [self.pool.models[k] for k in todo], self.say)
            self._polished.update(todo[: len(polished)])
            wider = [widened(self.pool, model, self.say) for model in polished]
            if moved := [new for new, old in zip(wider, polished, strict=True) if new is not old]:
                polish(self.pool, moved, self.say)
            self.pool.keep(self.pool)

    def simulate(self, keys: Sequence[Key]) -> Table:
        """A table of some models, refitted without each condition, whose windows are then simulated.

        Where no time is left for that, they stay as the search scored them.
        """
        known, models = self.table, self.pool.models
        keys = [k for k in keys if k in models]  # there was no time for the others
        todo = [k for k in keys if self._folds.get(k, (None, None))[0] is not models[k]]
        if todo and not self.over(LEAVING_OUT):
            self.say("held out", 0, len(todo))
            self._simulate(todo)
        return replace(known, rows={k: self._folds[k][1] if k in self._folds else known.rows[k] for k in keys})

    def _simulate(self, keys: Sequence[Key]) -> None:
        fitter, models = self.pool.fitter, self.pool.models
        refitted = heldout.refitted(fitter, [models[k] for k in keys])
        for key, model, seen in zip(keys, refitted, heldout.predictions(fitter, refitted), strict=True):
            models[key] = model
            # start states count as in the search, or all models would come nearer to the noise than they did there
            cost = heldout.costs(fitter, model, seen)
            self._folds[key] = (model, replace(self._row(key, model, True), cost=cost, simulated=True))


def distances(pool: Pool, model: Model) -> dict[str, float]:
    """{effect: standard deviations that its best told amplitude is away from neutral}.

    A time below a share (`steps`) of the simulator's own step is none: two integrators differ by so much.
    """
    if not model.effects:
        return {}
    sd = deviations(pool.fitter, model)
    instant = LIMITS.steps * float(pool.fitter.simulator.physics.mj_model.opt.timestep)
    out = {}
    for effect in model.effects:
        own = [
            model.fit.names.index(c.name)
            for c, shape in zip(effect.coordinates, effect.shapes, strict=True)
            if not shape
        ]
        neutral = [c.neutral for c, shape in zip(effect.coordinates, effect.shapes, strict=True) if not shape]
        away = {i: abs(model.fit.values[i] - n) for i, n in zip(own, neutral, strict=True)}
        units = {i: model.fit.coordinates[i].unit for i in own}
        off = [x / max(sd[i], 1e-300) for i, x in away.items() if units[i] != "s" or x > instant]
        out[effect.label] = float(max(off, default=0.0))
    return out


def cut_back(pool: Pool, model: Model, kept: Sequence[Candidate]) -> Fit:
    """A fit of some of a model's effects, from where the model is; its first residuals come with the first step."""
    fit, base = model.fit, len(pool.fitter.base)
    names = {c.name for e in kept for c in e.coordinates}
    own = [i for i, c in enumerate(fit.coordinates) if i < base or c.name in names]
    coordinates = tuple(fit.coordinates[i] for i in own)
    columns = fit.A[:, :, own]
    return Fit(coordinates, fit.values[own], fit.offsets, fit.r, columns, fit.B, fit.weight, np.inf, doubt=fit.doubt)
