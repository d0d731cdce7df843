"""The state of the race: what was fitted, what counts as better, and fitting more models."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bayessim_mjx.diagnosis.fitting.candidates import Candidate, Coordinate
from bayessim_mjx.diagnosis.fitting.discretisation import contacts
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.selection.models import Model, scored
from bayessim_mjx.diagnosis.selection.screen import Screened, screen
from bayessim_mjx.diagnosis.selection.tried import Settings, Tried
from bayessim_mjx.diagnosis.selection.uncertainty import deviations
from bayessim_mjx.effects import load, names

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Rules:
    """How fits far from the logs are brought to their end."""

    rounds: int = 5  # of polishing, where it has to be done again and again
    astray: float = 10.0  # noises that a fit leaves: from there on nothing is as it was a step before


RULES = Rules()


@dataclass(eq=False)
class Race(Tried):
    """What was tried. `models` maps the labels of a model's effects to it."""

    fitter: Fitter
    candidates: Sequence[Candidate]
    settings: Settings
    nominal: Fit
    base: Model
    winner: Model
    models: dict[frozenset[str], Model] = field(default_factory=dict)
    screened: list[Screened] = field(default_factory=list)

    @property
    def rough(self) -> bool:
        """Whether contacts make what columns tell hold only nearby: fits then need them anew at every step."""
        return contacts(self.fitter.simulator.physics)

    def passes(self, old: Model, new: Model) -> bool:
        """Whether `new`'s additional effects are both real and relevant."""
        c, s = self.better(old, new), self.settings
        if not self.above_noise(old):
            return False
        many = np.log(max(len(self.candidates), 2)) * max(1, len(new.effects) - len(old.effects))
        added = [e for e in new.effects if e not in old.effects]
        # by an effect that is hardly there a fit may only have come further
        if not all(self.distinct(new, e, 2.0 if c.share < 0.3 else 1.0) for e in added):
            return False
        if old.effects and old.total - new.total < s.least * self._above(self.base):
            return False
        relevance = s.more if old.effects else s.relevance
        if not (c.share > relevance and c.drop > s.drop and c.evidence > s.evidence + many):
            return False
        # what acts in few windows only (a limit, drag at speed) helps few of them, but then by much and harms no other
        rare = c.evidence > 10 * s.evidence + many and c.share > 0.3 and c.worst > -0.1
        return c.t > s.t or rare

    def best_of(self, old: Model, models: Sequence[Model]) -> Model | None:
        """The best model; of those that leave nearly as little of the gap of `old`, the one with the fewest numbers."""
        if not models:
            return None
        best = min(models, key=lambda m: m.total)
        room = 0.1 * max(old.total - self.noise * len(old.cost), 0.0)
        near = [m for m in models if m.total <= best.total + room and self.at_noise(m) >= self.at_noise(best)]
        told = [m for m in near if self.at_noise(m) or m.total < 2.0 * best.total]
        return min(told, key=lambda m: (m.size, m.total))

    def distinct(self, model: Model, effect: Candidate, far: float = 2.0) -> bool:
        """Whether at least one amplitude of the effect is `far` standard deviations away from neutral."""
        sd = deviations(self.fitter, model)
        own = [model.fit.names.index(c.name) for c in effect.coordinates]
        off = [
            abs(model.fit.values[i] - c.neutral) / max(sd[i], 1e-300)
            for i, c in zip(own, effect.coordinates, strict=True)
        ]
        return any(z > far for z, shape in zip(off, effect.shapes, strict=True) if not shape)


def fresh(race: Race, fit: Fit) -> list[int]:
    """Columns to be differenced anew: the effects' at every step, the known parameters' at every third if cheap.

    Far from the logs, where they change from step to step, at every one.
    """
    base = len(race.fitter.base)
    turn = base <= race.settings.fresh and (_astray(race, fit) or len(fit.history) % 3 == 0)
    return list(range(0 if turn else base, len(fit.coordinates)))


def fit_models(race: Race, plans: Sequence[tuple[Model, Screened]], label: str, say: Progress) -> list[Model]:
    """Models of the plans' effects plus one more each, fitted together; what was fitted before is looked up."""
    todo: Entries = {}
    for model, extra in plans:
        key = frozenset([*(c.label for c in model.effects), extra.candidate.label])
        if key not in race.models and key not in todo:
            todo[key] = (starts(race, model, extra, len(todo)), (*model.effects, extra.candidate))
    fit_entries(race, todo, label, say)
    keys = [frozenset([*(c.label for c in m.effects), e.candidate.label]) for m, e in plans]
    return [race.models[k] for k in keys]


Entries = dict[frozenset[str], tuple[list[Fit], tuple[Candidate, ...]]]  # {labels: (a fit per start, effects)}


def fit_entries(race: Race, entries: Entries, label: str, say: Progress) -> None:
    """Fit models in lockstep, each from all of its starts, and keep the best of each."""
    fitter = race.fitter
    fits = [fit for several, _ in entries.values() for fit in several]
    total = len(fits)
    fits = fitter.iterate(
        fits,
        race.settings.iterations,
        lambda f: fresh(race, f),
        race.settings.tolerance,
        progress=lambda left: say(label, total - left, total),
        keep=_Heats([len(several) for several, _ in entries.values()]),
    )
    for key, (several, effects) in entries.items():
        own, fits = fits[: len(several)], fits[len(several) :]
        race.models[key] = scored(fitter, min(own, key=lambda fit: fit.cost), effects)


class _Heats:
    """Successive halving: which fits go on. Starts far behind their candidate's best stop first, then candidates that
    are far behind the best candidate (they keep the cost they reached, and their place far down the table). What still
    falls fast goes on, and what was refused a step that would have brought much."""

    STARTS = {1: 4.0, 2: 2.0, 3: 1.3, 5: 1.03}  # steps made -> cost over the best start's
    CANDIDATES = {2: 8.0, 3: 5.0, 5: 3.0}  # and over the best candidate's
    FAST = 0.7  # cost after over cost before a step

    def __init__(self, starts: Sequence[int]) -> None:
        self.owner = np.repeat(np.arange(len(starts)), starts)  # `[fits]`, of each candidate's several starts

    def __call__(self, made: int, fits: Sequence[Fit], running: Sequence[int]) -> list[int]:
        cost = np.array([fit.cost for fit in fits])
        best = [float(np.min(cost[self.owner == i])) for i in range(self.owner[-1] + 1)]
        limits = np.full(len(best), np.inf)
        if made in self.STARTS:
            limits = self.STARTS[made] * np.array(best)
        if made in self.CANDIDATES:
            limits[np.array(best) > self.CANDIDATES[made] * min(best)] = 0.0
        return [i for i in running if cost[i] <= limits[self.owner[i]] or self._falls(fits[i])]

    def _falls(self, fit: Fit) -> bool:
        refused = len(fit.history) > 1 and fit.history[-1] == fit.history[-2]
        fell = len(fit.history) > 1 and fit.history[-1] < self.FAST * fit.history[-2]
        return fell or (refused and fit.promise > (1 - self.FAST) * fit.cost)


def starts(race: Race, model: Model, extra: Screened, rank: int) -> list[Fit]:
    """Jobs from several starting points: costs have several minima (an inertia hides in another, a shape is wrong)."""
    fitter, coordinates = race.fitter, extra.candidate.coordinates
    fits = [fitter.derive(model.fit, coordinates, extra.start)]
    if rank < race.settings.starts and extra.others:
        anew = _delivered(race, model, coordinates, extra)
        # a limit has no derivative below its threshold, so also from the probe itself, not scaled down to its step
        fits += [anew, fitter.derive(model.fit, coordinates, extra.others[0])]
        fits += [fitter.derive(model.fit, coordinates, other) for other in extra.others[1:]]
    return fits


def _delivered(race: Race, model: Model, coordinates: Sequence[Coordinate], extra: Screened) -> Fit:
    """A fit from the known parameters as they were delivered, not from where they went without the effect.

    Far from the logs the start states went astray as well, and what they do depends on the effect.
    """
    fitter, base = race.fitter, len(race.fitter.base)
    known = np.concatenate([[c.neutral for c in fitter.base], model.fit.values[base:]])
    if _astray(race, model.fit):
        return fitter.begin((*model.fit.coordinates, *coordinates), np.concatenate([known, extra.start]))
    anew = fitter.derive(model.fit, coordinates, extra.others[0])
    return replace(anew, values=np.concatenate([known, anew.values[len(known) :]]))


def _astray(race: Race, fit: Fit) -> bool:
    """Whether a fit is so far from the logs that its derivatives hold nowhere else."""
    return fit.cost > RULES.astray**2 * race.noise * len(fit.r)


def compatible(a: Candidate, b: Candidate) -> bool:
    """Not the same numbers twice (an effect at one joint and tied over all)."""
    return not {i for c in a.coordinates for i in c.index} & {i for c in b.coordinates for i in c.index}


def start_of(race: Race, candidate: Candidate) -> Screened:
    """The candidate with its values from its single fit as the start."""
    single = race.models.get(frozenset([candidate.label]))
    found = next(s for s in race.screened if s.candidate.label == candidate.label)
    if single is None:
        return found
    return Screened(candidate, single.values_of(candidate), found.gain, found.absorbed, found.column)


def polish(race: Race, model: Model) -> Model:
    """All columns anew at the fit, and some more steps; with contacts again and again, as long as it helps much."""
    fitter, fit = race.fitter, race.fitter.refresh(model.fit)
    if race.rough:
        for _ in range(RULES.rounds):
            before = fit.cost
            (fit,) = fitter.iterate([replace(fit, history=())], 2, lambda f: range(len(f.coordinates)))
            fit = fitter.refresh(fit)
            if fit.cost > 0.9 * before:
                break
    else:
        (fit,) = fitter.iterate([fit], 4, lambda f: fresh(race, f))
        fit = fitter.refresh(fit)
    new = scored(fitter, fit, model.effects)
    race.models[frozenset(c.label for c in model.effects)] = new
    return new


def without(race: Race, model: Model, effect: Candidate, say: Progress) -> Model:
    """The model without one of its effects, refitted."""
    rest = [e for e in model.effects if e != effect]
    key = frozenset(c.label for c in rest)
    if key not in race.models:
        small = race.base
        for e in rest:
            start = Screened(e, model.values_of(e), 0.0, 0.0, np.zeros(0))
            (small,) = fit_models(race, [(small, start)], "dropping", say)
        if rest and race.rough:
            polish(race, small)
    return race.models[key]


def exchange(race: Race, model: Model, old: Candidate, new: Candidate, say: Progress) -> Model:
    """The model with one effect in the place of another, refitted."""
    rest = without(race, model, old, say)
    if rest.effects:
        start = next(s for s in screen(race.fitter, rest.fit, [new], race.settings.screened))
        return fit_models(race, [(rest, start)], "exchanges", say)[0]
    return fit_models(race, [(race.base, start_of(race, new))], "exchanges", say)[0]


def special_cases(effect: Candidate) -> tuple[str, ...]:
    """Names of the effects that it contains, from its class."""
    return tuple(getattr(load(effect.effect), "contains", ())) if effect.effect in names() else ()
