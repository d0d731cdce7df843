"""The pool of models fitted so far, and fitting more of them: in lockstep, from several starts, by one schedule."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.discretisation import contacts
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.selection import shortlist
from bayessim_mjx.diagnosis.selection.budget import LEAVING_OUT, SINGLES
from bayessim_mjx.diagnosis.selection.heats import Heats
from bayessim_mjx.diagnosis.selection.models import Model, scored
from bayessim_mjx.diagnosis.selection.screen import Screened, Secants
from bayessim_mjx.diagnosis.selection.sets import Key, log_prior
from bayessim_mjx.diagnosis.selection.tried import Settings, Tried

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Rules:
    """How fits far from the logs are brought to their end."""

    batch: int = 12  # models fitted in lockstep; after each batch what is known is told
    # of polishing, as long as a round of so many steps gains that many nats: evidence is compared to about one
    rounds: int = 5
    steps: int = 4
    gains: float = 1.0
    refreshed: float = 0.3  # of the time left, for the first columns of all that are polished
    near: float = (
        1.3  # times the best one's cost, as near as a fit has to be able to come: a rule of thumb, not counted
    )
    left: float = 1.0  # mean square of start states, in their own variances, from which on measured ones are begun at
    astray: float = 10.0  # noises that a fit leaves: from there on nothing is as it was a step before


RULES = Rules()
POLISHING = "polishing"
# of a fit that goes on with new columns: steps that were refused on old ones would hold it, and its start states, back
AFRESH: dict[str, Any] = {"history": (), "damping": 1e-3, "reach": np.ones(1)}


@dataclass(eq=False)
class Pool(Tried):
    """What was fitted so far, and goes on. `models` maps the labels of a model's effects to it.

    Attributes:
        vain: sets that gained too little on some windows to be fitted on all.
        keep: called with the pool after each batch of fits.
    """

    fitter: Fitter
    candidates: Sequence[Candidate]
    settings: Settings
    nominal: Fit
    base: Model
    models: dict[frozenset[str], Model] = field(default_factory=dict)
    screened: list[Screened] = field(default_factory=list)
    cut_short: set[str] = field(default_factory=set)
    skipped: dict[str, int] = field(default_factory=dict)
    vain: set[Key] = field(default_factory=set)
    keep: Callable[[Pool], None] = lambda pool: None
    secants: Secants = field(default_factory=Secants)
    _measured: dict[Fit, Fit] = field(default_factory=dict, repr=False)

    @property
    def rough(self) -> bool:
        """Whether contacts make what columns tell hold only nearby: fits then need them anew at every step."""
        return contacts(self.fitter.simulator.physics)

    def begun(self, fit: Fit) -> Fit:
        """The fit that models of more effects begin at: with contacts at the measured start states, if it left them.

        Starts farther off than their noise are those that a fit needs while it lacks an effect. They keep the effect
        from the logs, as over contacts no step leads back to where they were.
        """
        if not self.rough or np.mean((fit.offsets / self.fitter.spread) ** 2) < RULES.left:
            return fit
        if fit not in self._measured:
            self._measured[fit] = self.fitter.begin(fit.coordinates, fit.values)
        return self._measured[fit]


def fresh(pool: Pool, fit: Fit) -> list[int]:
    """Columns to be differenced anew: the effects' at every step, the known parameters' at every third if cheap.

    Far from the logs, where they change from step to step, at every one.
    """
    base = len(pool.fitter.base)
    turn = base <= pool.settings.fresh and (_astray(pool, fit) or len(fit.history) % 3 == 0)
    return list(range(0 if turn else base, len(fit.coordinates)))


Entries = dict[Key, tuple[list[Fit], tuple[Candidate, ...]]]  # {labels: (a fit per start, effects)}
Parents = Mapping[Key, Model]  # {labels: the fitted model that they extend}


def fit_entries(
    pool: Pool, entries: Entries, label: str, say: Progress, part: str = "", parents: Parents = MappingProxyType({})
) -> None:
    """Fit models in lockstep, each from all of its starts, and keep the best of each.

    Args:
        part: of the budget, by whose end the rest is left out; "": all are fitted.
        parents: of those that extend a fitted model. Where they gain less on some windows than so many effects have to
            (`log_prior`), they are `pool.vain` and are no models.
    """
    heats = Heats(lambda: bool(part) and pool.settings.budget.over(part))
    total, done = sum(len(several) for several, _ in entries.values()), 0
    every = list(entries.items())
    leading = min((model.fit for model in parents.values()), key=lambda fit: fit.cost, default=pool.base.fit)
    own = shortlist.windows_of(leading)
    for first in range(0, len(every), RULES.batch):
        some = dict(every[first : first + RULES.batch])
        if part and pool.settings.budget.over(part) and (first or part != SINGLES):
            _left_out(pool, [effects for _, (_, effects) in every[first:]], label)
            return
        done += sum(len(several) for several, _ in some.values())
        _fit_batch(pool, some, parents, own, heats, functools.partial(_say_left, say, label, done, total))
        pool.keep(pool)


def _say_left(say: Progress, label: str, done: int, total: int, left: int) -> None:
    say(label, done - left, total)


def _fit_batch(
    pool: Pool,
    entries: Entries,
    parents: Parents,
    own: NDArray[np.int64] | None,
    heats: Heats,
    progress: Callable[[int], None],
) -> None:
    """All starts on some windows, where there are many; the best start of each model then on all of them."""
    rules = pool.settings.iterations, lambda f: fresh(pool, f), pool.settings.tolerance
    every = [several for several, _ in entries.values()]
    if own is None:
        going = heats.among(list(map(len, every)))
        fits = pool.fitter.iterate([f for fs in every for f in fs], *rules, progress, going)
        heats.learn(fits)
        best = [min(some, key=lambda fit: fit.cost) for some in _in_turn(fits, every)]
        kept = list(entries)
    else:
        part = shortlist.on(pool.fitter, own)
        smaller = [parents.get(key) for key in entries]
        there = np.array([np.inf if model is None else shortlist.cost(part, model.fit, own) for model in smaller])
        starts = [shortlist.cut(f, own) for fs in every for f in fs]
        fits = part.iterate(starts, *rules, progress, heats.among(list(map(len, every))))
        heats.learn(fits)
        first = [
            min(zip(some, fs, strict=True), key=lambda pair: pair[0].cost)
            for some, fs in zip(_in_turn(fits, every), every, strict=True)
        ]
        cost = np.array([ranked.cost for ranked, _ in first])
        heats.least = min(heats.least, float(cost.min()))
        share = len(own) / len(pool.base.fit.r)
        least = [_least_gain(pool, key, model) for key, model in zip(entries, smaller, strict=True)]
        gains = there - cost > share * np.array(least)
        kept = [key for key, gained in zip(entries, gains, strict=True) if gained]
        pool.vain |= set(entries) - set(kept)
        again = [shortlist.back(fit, ranked, own) for (ranked, fit), gained in zip(first, gains, strict=True) if gained]
        close = shortlist.close(cost[gains], heats.least)
        best = pool.fitter.iterate(again, *rules, None, heats.finals(close)) if again else []
    for key, fit in zip(kept, best, strict=True):
        pool.models[key] = scored(pool.fitter, fit, entries[key][1])


def _least_gain(pool: Pool, key: Key, parent: Model | None) -> float:
    """What the cost has to fall by, so that the likelihood outweighs the prior odds of so many effects more."""
    more = key - {e.label for e in parent.effects} if parent else frozenset()
    return -2.0 * log_prior(more, len(pool.candidates))


def _in_turn(fits: Sequence[Fit], like: Sequence[Sequence[Fit]]) -> Iterator[Sequence[Fit]]:
    """The fits in groups of the same sizes."""
    rest = iter(fits)
    return (list(itertools.islice(rest, len(several))) for several in like)


def _left_out(pool: Pool, models: Sequence[Sequence[Candidate]], label: str) -> None:
    """Remembers what there was no time for."""
    pool.cut_short.update(effects[0].label for effects in models if len(effects) == 1)
    pool.skipped[label] = pool.skipped.get(label, 0) + len(models)


def _astray(pool: Pool, fit: Fit) -> bool:
    """Whether a fit is so far from the logs that its derivatives hold nowhere else."""
    return fit.cost > RULES.astray**2 * pool.noise * len(fit.r)


def polish(pool: Pool, models: Sequence[Model], say: Progress = lambda text, done, total: None) -> list[Model]:
    """All columns anew at the fits, and more steps, again and again as long as it helps; returns the models that were.

    Where time is limited these are the first ones, as many as it is enough for; others stay as the search left them.
    """
    fitter, count, budget = pool.fitter, itertools.count(), pool.settings.budget
    began, left = budget.spent, budget.left(LEAVING_OUT)

    def told(fit: Fit) -> Fit:
        say(POLISHING, min(next(count), 2 * len(models) - 1), 2 * len(models))
        return fit

    fits: list[Fit] = []
    for model in models:
        if fits and budget.spent - began > RULES.refreshed * left:
            break
        fits.append(told(fitter.refresh(model.fit)))
    if later := models[len(fits) :]:
        pool.skipped[POLISHING] = pool.skipped.get(POLISHING, 0) + len(later)
    models = models[: len(fits)]
    fits = [_again(pool, fit) for fit in fits] if pool.rough else _to_the_end(pool, fits, told)
    new = [scored(fitter, fit, m.effects) for fit, m in zip(fits, models, strict=True)]
    pool.models.update({frozenset(c.label for c in m.effects): m for m in new})
    return new


def _to_the_end(pool: Pool, fits: Sequence[Fit], told: Callable[[Fit], Fit]) -> list[Fit]:
    """Fits with all columns anew every few steps, and corrected by these alone, as long as that lowers their cost.

    None goes on when the time is over. One that could not come near the best, did each round to come bring as much as
    the last, is left where it is.
    """
    fits, running = list(fits), list(range(len(fits)))
    for made in range(RULES.rounds):
        if pool.settings.budget.over(LEAVING_OUT):
            break
        start = [replace(fits[i], **AFRESH) for i in running]
        tolerance = 2 * RULES.gains / max(fit.cost for fit in start)
        moved = pool.fitter.iterate(start, RULES.steps, lambda f: fresh(pool, f) if _astray(pool, f) else (), tolerance)
        for i, fit in zip(running, moved, strict=True):
            late = pool.settings.budget.over(LEAVING_OUT)
            fits[i] = fit if late else told(pool.fitter.refresh(fit))
        fell = {i: before.cost - fits[i].cost for i, before in zip(running, start, strict=True)}
        least, left = min(fit.cost for fit in fits), RULES.rounds - 1 - made
        running = [
            i for i in running if fell[i] > 2 * RULES.gains and fits[i].cost - left * fell[i] <= RULES.near * least
        ]
        if not running:
            break
    return fits


def _again(pool: Pool, fit: Fit) -> Fit:
    """A rough fit, from its own start states and from the measured ones."""
    both = {id(f): f for f in (fit, pool.begun(fit))}
    return min((_on(pool.fitter, f) for f in both.values()), key=lambda f: f.cost)


def _on(fitter: Fitter, fit: Fit) -> Fit:
    for _ in range(RULES.rounds):
        before = fit.cost
        (fit,) = fitter.iterate([replace(fit, history=())], 2, lambda f: range(len(f.coordinates)))
        fit = fitter.refresh(fit)
        if fit.cost > 0.9 * before:
            break
    return fit


def cut_back(pool: Pool, model: Model, kept: Sequence[Candidate]) -> Fit:
    """A fit of some of a model's effects, from where the model is; its first residuals come with the first step."""
    fit, base = model.fit, len(pool.fitter.base)
    names = {c.name for e in kept for c in e.coordinates}
    own = [i for i, c in enumerate(fit.coordinates) if i < base or c.name in names]
    coordinates = tuple(fit.coordinates[i] for i in own)
    columns = fit.A[:, :, own]
    return Fit(coordinates, fit.values[own], fit.offsets, fit.r, columns, fit.B, fit.weight, np.inf, doubt=fit.doubt)
