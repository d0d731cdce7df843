"""Successive halving: many fits run in lockstep, those far behind stop early, those close to the best go to the end."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.selection import window_subset
from bayessim_mjx.diagnosis.selection.budget import SINGLES, Progress
from bayessim_mjx.diagnosis.selection.models import Key, Model, scored
from bayessim_mjx.diagnosis.selection.numbers import EFFORT
from bayessim_mjx.diagnosis.selection.search_state import SearchState


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
        self.least = np.inf  # cost of the best candidate in the end

    def among(self, starts: Sequence[int]) -> Callable[[int, Sequence[Fit], Sequence[int]], list[int]]:
        """Which fits of a batch go on, of candidates with so many starts each."""
        owner = np.repeat(np.arange(len(starts)), starts)

        def going(made: int, fits: Sequence[Fit], running: Sequence[int]) -> list[int]:
            if self.over():
                return []
            cost = np.array([fit.cost for fit in fits])
            best = np.array([float(np.min(cost[owner == i])) for i in range(len(starts))])
            self.pace[made] = min(self.pace.get(made, np.inf), float(best.min()))
            behind = 1.0 + (EFFORT.close - 1.0) / EFFORT.close ** (made - 1)
            limits = behind * np.minimum(best, EFFORT.close * self.pace[made])
            return [i for i in running if made < 1 or min(cost[i], _next(fits[i])) <= limits[owner[i]]]

        return going

    def learn(self, fits: Sequence[Fit]) -> None:
        """Take the pace from finished fits. Fits that are read from disk set the same pace as fits that were run."""
        for made in range(1, EFFORT.steps + 1):
            costs = [fit.history[min(made, len(fit.history) - 1)] for fit in fits if fit.history]
            self.pace[made] = min([self.pace.get(made, np.inf), *costs])

    def finals(self, close: NDArray[np.bool_]) -> Callable[[int, Sequence[Fit], Sequence[int]], list[int]]:
        """Which fits go on with all windows: each makes one step, so that it is ranked; only close ones make more."""

        def going(made: int, fits: Sequence[Fit], running: Sequence[int]) -> list[int]:
            return [] if self.over() else [i for i in running if made < 1 or close[i]]

        return going


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
    halving = SuccessiveHalving(lambda: bool(part) and state.settings.budget.over(part))
    total, done = sum(len(several) for several, _ in entries.values()), 0
    every = list(entries.items())
    leading = min((model.fit for model in parents.values()), key=lambda fit: fit.cost, default=state.base.fit)
    own = window_subset.windows_of(leading)
    for first in range(0, len(every), EFFORT.batch):
        some = dict(every[first : first + EFFORT.batch])
        if part and state.settings.budget.over(part) and (first or part != SINGLES):
            _left_out(state, [effects for _, (_, effects) in every[first:]], label)
            return
        done += sum(len(several) for several, _ in some.values())
        _fit_batch(state, some, parents, own, halving, functools.partial(_say_left, say, label, done, total))
        state.keep(state)


def _say_left(say: Progress, label: str, done: int, total: int, left: int) -> None:
    say(label, done - left, total)


def _fit_batch(
    state: SearchState,
    entries: Entries,
    parents: Parents,
    own: NDArray[np.int64] | None,
    halving: SuccessiveHalving,
    progress: Callable[[int], None],
) -> None:
    """All starts on a subset of the windows (None: on all); then the best start of each model on all windows."""
    every = [several for several, _ in entries.values()]
    part = state.fitter if own is None else window_subset.on(state.fitter, own)
    starts = [f if own is None else window_subset.cut(f, own) for fs in every for f in fs]
    rules = state.settings.iterations, state.fresh, EFFORT.tolerance
    fits = part.iterate(starts, *rules, progress, halving.among(list(map(len, every))))
    halving.learn(fits)
    rest = iter(fits)
    pairs = (zip(itertools.islice(rest, len(fs)), fs, strict=True) for fs in every)
    first = dict(zip(entries, (min(some, key=lambda pair: pair[0].cost) for some in pairs), strict=True))
    best = {key: fit for key, (fit, _) in first.items()}
    if own is not None:
        gaining = _gaining(state, part, own, best, parents)
        state.vain |= set(entries) - set(gaining)
        halving.least = min(halving.least, *(fit.cost for fit in best.values()))
        again = [window_subset.back(first[key][1], best[key], own) for key in gaining]
        close = window_subset.close(np.array([best[key].cost for key in gaining]), halving.least)
        found = state.fitter.iterate(again, *rules, None, halving.finals(close)) if again else []
        best = dict(zip(gaining, found, strict=True))
    for key, fit in best.items():
        state.models[key] = scored(state.fitter, fit, entries[key][1])


def _gaining(
    state: SearchState, part: Fitter, own: NDArray[np.int64], fits: Mapping[Key, Fit], parents: Parents
) -> list[Key]:
    """The models that gain enough on a subset of the windows over the model that they extend."""
    share, out = len(own) / len(state.base.fit.r), []
    for key, fit in fits.items():
        parent = parents.get(key)
        before = np.inf if parent is None else window_subset.cost(part, parent.fit, own)
        if before - fit.cost > share * _least_gain(state, key, parent):
            out.append(key)
    return out


def _least_gain(state: SearchState, key: Key, parent: Model | None) -> float:
    """The fall of the cost at which the likelihood outweighs the prior odds of the further effects."""
    more = key - {e.label for e in parent.effects} if parent else frozenset()
    return -2.0 * state.log_prior(more)


def _left_out(state: SearchState, models: Sequence[Sequence[Candidate]], label: str) -> None:
    """Record the models for which no time was left."""
    state.cut_short.update(effects[0].label for effects in models if len(effects) == 1)
    state.skipped[label] = state.skipped.get(label, 0) + len(models)
