"""The state of a search, and its first and last fits: the known parameters, and the best sets to convergence."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.simulable import contacts
from bayessim_mjx.diagnosis.selection.budget import KNOWN, LEAVING_OUT, SCREENING, Budget, Progress
from bayessim_mjx.diagnosis.selection.models import BASE, Key, Model, scored
from bayessim_mjx.diagnosis.selection.numbers import EFFORT, FLOOR, ODDS, PRIORS, RELEVANCE
from bayessim_mjx.diagnosis.selection.screen import Screened, Secants, screen
from bayessim_mjx.diagnosis.statistics import Gap

POLISHING = "polishing"
# of a fit that goes on with new columns: steps that were refused on old ones would hold it, and its start states, back
AFRESH: dict[str, Any] = {"history": (), "damping": Fit.damping, "reach": np.ones(1)}


@dataclass(frozen=True)
class Settings:
    """Budgets of the search, by the robot's size.

    Attributes:
        screened: windows used in screening; iterations: of a fit.
        budget: time that the search may take.
        believed: share of the noise (rms) that is the sensors'; the rest bounds the error of the time step.
    """

    screened: int = EFFORT.windows
    iterations: int = EFFORT.steps
    believed: float = 1.0
    budget: Budget = Budget()


@dataclass(eq=False)
class SearchState:
    """What a search has fitted so far.

    Attributes:
        nominal: the simulator as delivered; base: the known parameters alone; models: by the labels of their effects.
        screened: the candidates' best starting points; secants: what each point does to some windows.
        cut_short: labels of candidates for which no time was left; skipped: {part of the search: models for which none
            was}.
        vain: sets that gained too little on some windows to be fitted on all.
        keep: called with the state after each batch of fits.
    """

    fitter: Fitter
    candidates: Sequence[Candidate]
    settings: Settings
    nominal: Fit
    base: Model
    models: dict[Key, Model] = field(default_factory=dict)
    screened: list[Screened] = field(default_factory=list)
    cut_short: set[str] = field(default_factory=set)
    skipped: dict[str, int] = field(default_factory=dict)
    vain: set[Key] = field(default_factory=set)
    keep: Callable[[SearchState], None] = lambda state: None
    secants: Secants = field(default_factory=Secants)
    _measured: dict[Fit, Fit] = field(default_factory=dict, repr=False)

    @property
    def noise(self) -> float:
        """Expected cost of a window under a perfect model."""
        return float(self.fitter.size)

    def above_noise(self, model: Model) -> bool:
        """Whether the model's held-out error needs an explanation.

        The error of the time step may be smaller than its bound, so a model with effects has to reach the sensors'
        noise alone.
        """
        return self.gap(model).rms > FLOOR * (self.settings.believed if model.effects else 1.0)

    def gap(self, model: Model) -> Gap:
        """The gap between the base model and `model`, on held-out windows."""
        return Gap(self.base.total, model.total, self.noise * len(model.cost))

    def log_prior(self, key: Key) -> float:
        """`log_prior` of a set of effects, with the candidates of this search."""
        return log_prior(key, len(self.candidates))

    @property
    def rough(self) -> bool:
        """Whether something can touch: columns then hold only nearby, and fits need new ones at every step."""
        return contacts(self.fitter.simulator.physics)

    def begun(self, fit: Fit) -> Fit:
        """The fit from which models with more effects begin: with contacts at measured start states, if it left them.

        A fit that lacks an effect may move its start states farther than their noise. Over contacts no step leads back,
        and the effect would find nothing to explain.
        """
        if (
            not self.rough or np.mean((fit.offsets / self.fitter.spread) ** 2) < 1.0
        ):  # mean square of start states, in variances
            return fit
        if fit not in self._measured:
            self._measured[fit] = self.fitter.begin(fit.coordinates, fit.values)
        return self._measured[fit]

    def fresh(self, fit: Fit) -> list[int]:
        """Columns to difference again at every step: the effects'."""
        return list(range(len(self.fitter.base), len(fit.coordinates)))


def log_prior(key: Key, candidates: int) -> float:
    """Log prior of a set of effects over no effect: every candidate is missing with the same small probability."""
    odds = PRIORS.expected / max(candidates - PRIORS.expected, 1.0)
    return len(key) * float(np.log(odds))


def ranked(state: SearchState, size: int | None = None) -> list[Model]:
    """Fitted models by held-out error, best first; size: only those with so many effects."""
    chosen = [m for m in state.models.values() if size is None or len(m.effects) == size]
    return sorted(chosen, key=lambda m: m.total)


def begin(
    fitter: Fitter,
    candidates: Sequence[Candidate],
    settings: Settings,
    say: Progress = lambda text, done, total: None,
    keep: Callable[[SearchState], None] = lambda state: None,
) -> SearchState:
    """Fit the known parameters and screen all candidates; returns the state of the search.

    Args:
        keep: called with the state after each part of the search, also after those that follow.
    """

    def in_time(made: int, fits: Sequence[Fit], running: Sequence[int]) -> Sequence[int]:
        return () if made > 1 and settings.budget.over(KNOWN) else running

    say("compiling the simulator", 0, 1)
    nominal = fitter.begin(fitter.base)
    settings = replace(settings, budget=settings.budget.searching())
    say("known parameters", 0, 1)
    began, before = settings.budget.now(), fitter.simulator.rollouts
    fit = nominal
    for _ in range(2):  # the second time from start states' columns of its own
        (fit,) = fitter.iterate(
            [replace(fit, **AFRESH)], EFFORT.steps, lambda f: range(len(f.coordinates)), keep=in_time
        )
        fit = fitter.refresh(fit)
        if settings.budget.over(KNOWN):
            break
    each = (settings.budget.now() - began) / max(fitter.simulator.rollouts - before, 1)
    settings = _affordable(candidates, settings, each)
    base = scored(fitter, fit, ())
    state = SearchState(fitter, candidates, settings, nominal, base, keep=keep)
    if state.rough:
        (state.base,) = polish(state, [base])
        fit = state.base.fit
    state.models[BASE] = state.base
    keep(state)
    over = functools.partial(settings.budget.over, SCREENING) if settings.budget.limited else None
    state.screened = screen(fitter, state.begun(fit), candidates, settings.screened, say, state.secants, over)
    return state


def _affordable(candidates: Sequence[Candidate], settings: Settings, seconds: float) -> Settings:
    """Settings with fewer windows for screening if time is limited; seconds: of one simulation of one window."""
    budget = settings.budget
    if not budget.limited:
        return settings
    points = max(sum(len(c.probes) for c in candidates), 1)
    windows = budget.left(SCREENING) / max(seconds, 1e-9) / points
    return replace(settings, screened=int(min(max(windows, 1.0), settings.screened)))


def polish(state: SearchState, models: Sequence[Model], say: Progress = lambda text, done, total: None) -> list[Model]:
    """Refresh all columns and make further steps as long as the cost falls; returns the models that were polished.

    If time is limited, these are the first ones; the others stay as the search left them.
    """
    fitter, count, budget = state.fitter, itertools.count(), state.settings.budget
    began, left = budget.spent, budget.left(LEAVING_OUT)

    def counted(fit: Fit) -> Fit:
        say(POLISHING, min(next(count), 2 * len(models) - 1), 2 * len(models))
        return fit

    fits: list[Fit] = []
    for model in models:
        if fits and budget.spent - began > left / 2:  # the other half is for steps
            break
        fits.append(counted(fitter.refresh(model.fit)))
    if later := models[len(fits) :]:
        state.skipped[POLISHING] = state.skipped.get(POLISHING, 0) + len(later)
    models = models[: len(fits)]
    fits = [_again(state, fit) for fit in fits] if state.rough else _to_the_end(state, fits, counted)
    new = [scored(fitter, fit, m.effects) for fit, m in zip(fits, models, strict=True)]
    state.models.update({frozenset(c.label for c in m.effects): m for m in new})
    return new


def _to_the_end(state: SearchState, fits: Sequence[Fit], counted: Callable[[Fit], Fit]) -> list[Fit]:
    """Fits with new columns every few steps, as long as that gains (`Odds.mention`) and there is time."""
    fits, running, gain = list(fits), list(range(len(fits))), 2 * math.log(ODDS.mention)
    for _ in range(EFFORT.rounds):
        if state.settings.budget.over(LEAVING_OUT):
            break
        start = [replace(fits[i], **AFRESH) for i in running]
        tolerance = gain / max(fit.cost for fit in start)
        moved = state.fitter.iterate(start, EFFORT.rounds, lambda f: (), tolerance)
        for i, fit in zip(running, moved, strict=True):
            late = state.settings.budget.over(LEAVING_OUT)
            fits[i] = fit if late else counted(state.fitter.refresh(fit))
        running = [i for i, before in zip(running, start, strict=True) if before.cost - fits[i].cost > gain]
        if not running:
            break
    return fits


def _again(state: SearchState, fit: Fit) -> Fit:
    """A fit with contacts, from its own start states and from the measured ones; the better of both."""
    both = {id(f): replace(f, history=()) for f in (fit, state.begun(fit))}
    found = state.fitter.iterate(list(both.values()), EFFORT.steps, lambda f: range(len(f.values)), RELEVANCE.share)
    return min(map(state.fitter.refresh, found), key=lambda f: f.cost)


def cut_back(state: SearchState, model: Model, kept: Sequence[Candidate]) -> Fit:
    """The start of a fit with some of a model's effects, at the model's values; its first step gives its residuals."""
    fit, base = model.fit, len(state.fitter.base)
    names = {c.name for e in kept for c in e.coordinates}
    own = [i for i, c in enumerate(fit.coordinates) if i < base or c.name in names]
    coordinates = tuple(fit.coordinates[i] for i in own)
    columns = fit.A[:, :, own]
    return Fit(coordinates, fit.values[own], fit.offsets, fit.r, columns, fit.B, fit.weight, np.inf, doubt=fit.doubt)
