"""Successive halving: many fits run in lockstep, those far behind stop early, those close to the best go to the end.

Starts and candidates are ranked on some of the windows, and the best go on with all. All windows are needed to say how
well a model predicts, fewer to see that it is far behind.

The first fit of a search (`begin`, the known parameters) and the last ones (`polish`, the best sets) stand apart.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.fitting.journal import Remembering
from bayessim_mjx.diagnosis.selection.models import BASE, Key, Model, scored
from bayessim_mjx.diagnosis.selection.numbers import (
    EFFORT,
    KNOWN,
    LEAVING_OUT,
    ODDS,
    RELEVANCE,
    SCREENING,
    SINGLES,
    Progress,
)
from bayessim_mjx.diagnosis.selection.screen import looked_at, part, screen
from bayessim_mjx.diagnosis.selection.search_state import SearchState, Settings

Array = NDArray[np.float64]
POLISHING = "final fits"
# of a fit that goes on with new columns: steps that were refused on old ones would hold it, and its start states, back
AFRESH: dict[str, Any] = {"history": (), "damping": Fit.damping, "reach": np.ones(1)}


class SuccessiveHalving:
    """Starts far behind their candidate's best stop first, then candidates far behind the best candidate.

    After n steps a start has to be within 1 + (c - 1) / c^(n - 1) times its candidate's best cost, c = `Effort.close`,
    and within c times that limit of the best candidate's: where it is, or after one more step like its last. A fit that
    stops keeps the cost that it reached.

    Args:
        over: whether the time is over.
    """

    def __init__(self, over: Callable[[], bool]) -> None:
        self.over = over
        self.pace: dict[int, float] = {}  # steps made -> cost of the best candidate, of all batches

    def among(self, starts: Sequence[int]) -> Callable[[int, Sequence[Fit], Sequence[int]], list[int]]:
        """Which fits of a batch go on, of candidates with so many starts each."""
        owner = np.repeat(np.arange(len(starts)), starts)

        def going(made: int, fits: Sequence[Fit], running: Sequence[int]) -> list[int]:
            if self.over():
                return []
            cost = np.array([fit.cost for fit in fits])
            best = np.array([float(np.min(cost[owner == i])) for i in range(len(starts))])
            self.pace[made] = min(self.pace.get(made, np.inf), float(best.min()))
            limits = _behind(made) * np.minimum(best, EFFORT.close * self.pace[made])
            return [i for i in running if made < 1 or min(cost[i], _next(fits[i])) <= limits[owner[i]]]

        return going

    def learn(self, fits: Sequence[Fit]) -> None:
        """Take the pace from finished fits. Fits that are read from disk set the same pace as fits that were run."""
        for made in range(1, EFFORT.steps + 1):
            costs = [fit.history[min(made, len(fit.history) - 1)] for fit in fits if fit.history]
            self.pace[made] = min([self.pace.get(made, np.inf), *costs])

    def finals(self) -> Callable[[int, Sequence[Fit], Sequence[int]], list[int]]:
        """Which fits go on with all windows: each makes one step, so that it is ranked, then as starts of one model.

        Fits that may come as close to the best as `Effort.margin` go on: the best of them decide the answer.
        """

        def going(made: int, fits: Sequence[Fit], running: Sequence[int]) -> list[int]:
            if self.over():
                return []
            self.pace[made] = best = min(self.pace.get(made, np.inf), *(fit.cost for fit in fits))
            limit = best * _behind(made) + 2.0 * EFFORT.margin
            return [i for i in running if made < 1 or min(fits[i].cost, _next(fits[i])) <= limit]

        return going


def _behind(made: int) -> float:
    """Return how many times the best cost a start may have after so many steps."""
    return 1.0 + (EFFORT.close - 1.0) / EFFORT.close ** (made - 1)


def _next(fit: Fit) -> float:
    """Cost after one more step that gains the same factor as the last, or what was promised if that was refused."""
    if len(fit.history) < 2:
        return np.inf
    before, now = fit.history[-2:]
    return fit.cost - fit.promise if before == now else now**2 / before


Entries = dict[Key, tuple[list[Fit], tuple[Candidate, ...]]]  # {labels: (a fit per start, effects)}
Parents = Mapping[Key, Model]  # {labels: the fitted model that they extend}


def fit_entries(
    state: SearchState,
    entries: Entries,
    label: str,
    say: Progress,
    part: str = "",
    parents: Parents = MappingProxyType({}),
) -> None:
    """Fit models in lockstep, each from all of its starts, and keep the best fit of each.

    Args:
        part: of the budget; models that are not begun at its end are left out. "": all are fitted.
        parents: the fitted models that some entries extend. An entry that gains less on a subset of the windows than
            its prior odds cost (`log_prior`) becomes no model; `state.vain` holds it.
    """
    halving, finals = (SuccessiveHalving(lambda: bool(part) and state.settings.budget.over(part)) for _ in range(2))
    total, done = sum(len(several) for several, _ in entries.values()), 0
    every = list(entries.items())
    leading = min((model.fit for model in parents.values()), key=lambda fit: fit.cost, default=state.base.fit)
    few = len(leading.r) < EFFORT.windows  # then extensions are ranked on all of them
    own = None if few else looked_at(leading, EFFORT.windows // 2)
    for first in range(0, len(every), EFFORT.batch):
        some = dict(every[first : first + EFFORT.batch])
        if part and state.settings.budget.over(part) and (first or part != SINGLES):
            late = [effects for _, (_, effects) in every[first:]]
            state.cut_short.update(effects[0].label for effects in late if len(effects) == 1)
            state.skipped[label] = state.skipped.get(label, 0) + len(late)
            return
        done += sum(len(several) for several, _ in some.values())

        def progress(left: int, begun: int = done) -> None:
            say(label, begun - left, total)

        _fit_batch(state, some, parents, own, (halving, finals), progress)
        state.keep(state)


def _fit_batch(
    state: SearchState,
    entries: Entries,
    parents: Parents,
    own: NDArray[np.int64] | None,
    races: tuple[SuccessiveHalving, SuccessiveHalving],
    progress: Callable[[int], None],
) -> None:
    """All starts on a subset of the windows (None: on all); then the best start of each model on all windows."""
    every, (halving, finals) = [several for several, _ in entries.values()], races
    part = state.fitter if own is None else fitter_on(state.fitter, own)
    starts = [f if own is None else cut(f, own) for fs in every for f in fs]
    rules, few = (state.fresh, RELEVANCE.share), min(state.settings.iterations, EFFORT.rounds)
    steps = state.settings.iterations if own is None else few  # starts and models are ranked, and go on with all
    fits = part.iterate(starts, steps, *rules, progress, halving.among(list(map(len, every))))
    halving.learn(fits)
    rest = iter(fits)
    pairs = (zip(itertools.islice(rest, len(fs)), fs, strict=True) for fs in every)
    first = dict(zip(entries, (min(some, key=lambda pair: pair[0].cost) for some in pairs), strict=True))
    best = {key: fit for key, (fit, _) in first.items()}
    if own is not None:
        gaining = _gaining(state, part, own, best, parents)
        state.vain |= set(entries) - set(gaining)
        again = [back(first[key][1], best[key], own) for key in gaining]
        found = state.fitter.iterate(again, state.settings.iterations, *rules, None, finals.finals()) if again else []
        finals.learn(found)
        best = dict(zip(gaining, found, strict=True))
    for key, fit in best.items():
        state.models[key] = scored(state.fitter, fit, entries[key][1])


def _gaining(
    state: SearchState, part: Fitter, own: NDArray[np.int64], fits: Mapping[Key, Fit], parents: Parents
) -> list[Key]:
    """Return the models whose likelihood gains more on a subset of the windows than the prior odds of their effects."""
    share, out = len(own) / len(state.base.fit.r), []
    for key, fit in fits.items():
        parent = parents.get(key)
        some = None if parent is None else cut(parent.fit, own)
        before = np.inf if some is None else part.cost(some, some.r, some.offsets, some.values)
        more = key - {e.label for e in parent.effects} if parent else frozenset()
        if before - fit.cost > -2.0 * share * state.log_prior(more):
            out.append(key)
    return out


class WindowSubset:
    """A simulator of the windows `own` of another, for a fitter; both share one compiled program."""

    def __init__(self, simulator: Any, own: NDArray[np.int64]) -> None:
        self.simulator, self.own, self.physics = simulator, own, simulator.physics
        self.apart = getattr(simulator, "apart", False)
        self.starts, self.loose = simulator.starts, simulator.loose
        all_of_it = simulator.windows  # its batch stays whole: the simulator has it
        parts = {name: getattr(all_of_it, name)[own] for name in ("log", "start", "group")}
        self.windows = replace(all_of_it, **parts)

    def run(self, thetas: Array, offsets: Array | None = None, windows: NDArray[np.int64] | None = None) -> Array:
        """As `Simulator.run`."""
        return np.asarray(self.simulator.run(thetas, offsets, self.own if windows is None else self.own[windows]))


def fitter_on(fitter: Fitter, own: NDArray[np.int64]) -> Fitter:
    """Return the fitter on some of its windows; it uses the same journal, but stores no columns there."""
    some: Any = WindowSubset(fitter.simulator, own)
    plain = Fitter(some, fitter.base, fitter.theta)
    journal = fitter.journal if isinstance(fitter, Remembering) else None
    return plain if journal is None else Remembering(plain, journal, bare=True)


def cut(fit: Fit, own: NDArray[np.int64]) -> Fit:
    """Return the start of a fit to some of the windows."""
    return replace(part(fit, own), cost=np.inf, history=(), reach=np.ones(1))


def back(fit: Fit, ranked: Fit, own: NDArray[np.int64]) -> Fit:
    """Return the start of a fit to all windows at the values of `ranked`, a fit to some; its first step simulates."""
    offsets = fit.offsets.copy()
    offsets[own] = ranked.offsets
    return replace(fit, values=ranked.values, offsets=offsets, cost=np.inf, history=(), reach=np.ones(1))


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
    say("fitting the known parameters", 0, 1)
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
    """Return settings with fewer windows for screening if time is limited; seconds: of one simulation of one window."""
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
    """Return a fit with contacts, from its own start states and from the measured ones; the better of both."""
    both = {id(f): replace(f, history=()) for f in (fit, state.begun(fit))}
    found = state.fitter.iterate(list(both.values()), EFFORT.steps, lambda f: range(len(f.values)), RELEVANCE.share)
    return min(map(state.fitter.refresh, found), key=lambda f: f.cost)


def cut_back(state: SearchState, model: Model, kept: Sequence[Candidate]) -> Fit:
    """Return the start of a fit with some of a model's effects, at the model's values; its first step simulates."""
    fit, base = model.fit, len(state.fitter.base)
    names = {c.name for e in kept for c in e.coordinates}
    own = [i for i, c in enumerate(fit.coordinates) if i < base or c.name in names]
    coordinates, values = tuple(fit.coordinates[i] for i in own), fit.values[own]
    loose = state.fitter.simulator.loose(state.fitter.vector(coordinates, values))
    new = Fit(coordinates, values, fit.offsets * loose, fit.r, fit.A[:, :, own], fit.B * loose, fit.weight, np.inf)
    return replace(new, doubt=fit.doubt, spread=np.where(loose, fit.spread, state.fitter.spread))
