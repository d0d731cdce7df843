"""The race: known parameters first, then all single effects, pairs of the best, and greedy steps forward and back."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.selection.bounds import widen_leading
from bayessim_mjx.diagnosis.selection.models import Model, scored
from bayessim_mjx.diagnosis.selection.race import (
    Progress,
    Race,
    Settings,
    compatible,
    exchange,
    fit_models,
    polish,
    special_cases,
    start_of,
    without,
)
from bayessim_mjx.diagnosis.selection.screen import screen
from bayessim_mjx.diagnosis.selection.tried import ranked

__all__ = [
    "Progress",
    "Race",
    "Settings",
    "compatible",
    "fit_models",
    "parts_of",
    "ranked",
    "run",
    "special_cases",
    "together",
    "without",
]


@dataclass(frozen=True)
class OtherWays:
    """When the search also tries other ways than the greedy one."""

    far: float = 1.5  # noises that remain: beyond, the search also tries other ways
    much: float = 0.03  # and of the whole gap
    elsewhere: int = 3  # times
    better: float = 0.5  # of the gap that remains, which another way has to undercut


OTHER_WAYS = OtherWays()


def run(
    fitter: Fitter,
    candidates: Sequence[Candidate],
    settings: Settings,
    progress: Progress | None = None,
    keep: Callable[[Race], None] = lambda race: None,
) -> Race:
    """The whole race on the windows of `fitter`; `keep` is called with it after each stage."""
    say = progress or (lambda text, done, total: None)
    race = begin(fitter, candidates, settings, say, keep)
    if not race.above_noise(race.base):
        return race
    best = _pairs(race, say)
    keep(race)
    best = _elsewhere(race, _greedy(race, best, say), say)
    race.winner = simplest(race, best, say)
    return race


def begin(
    fitter: Fitter,
    candidates: Sequence[Candidate],
    settings: Settings,
    say: Progress,
    keep: Callable[[Race], None] = lambda race: None,
) -> Race:
    """The race up to its single effects; of these a few for the table where there is nothing to explain."""
    nominal = fitter.begin(fitter.base)
    say("known parameters", 0, 1)
    start = replace(nominal, A=nominal.A.copy())  # in the memory order of later steps: sums round alike
    (fit,) = fitter.iterate([start], 10, lambda f: range(len(f.coordinates)))
    fit = fitter.refresh(fit)
    base = scored(fitter, fit, ())
    race = Race(fitter, candidates, settings, nominal, base, winner=base)
    if race.rough:
        race.base = race.winner = polish(race, base)
        fit = race.base.fit
    race.models[frozenset()] = race.base
    keep(race)
    say("screening", 0, 1)
    race.screened = screen(fitter, fit, candidates, settings.screened)
    if not race.above_noise(race.base):
        fit_models(race, [(race.base, s) for s in race.screened[:4]], "single effects", say)
        return race
    _singles(race, say)
    widen_leading(race, say)
    keep(race)
    return race


def simplest(race: Race, model: Model, say: Progress) -> Model:
    """A law gives way to its own special case, or to several of them, where they close nearly as much."""
    for effect in model.effects:
        parts = parts_of(race, model, effect)
        smaller = [exchange(race, model, effect, part, say) for part in parts]
        if len(parts) > 1:
            smaller.append(together(race, model, effect, parts, say))
        near = [m for m in smaller if race.closure(model) - race.closure(m) < race.settings.tie / 2]
        near = [m for m in near if m.size <= model.size and m.total < 3.0 * max(model.total, race.noise * len(m.cost))]
        if near:
            return simplest(race, polish(race, min(near, key=lambda m: (m.size, m.total))), say)
    return model


def parts_of(race: Race, model: Model, effect: Candidate) -> list[Candidate]:
    """Special cases of one of a model's effects that fit beside its others."""
    parts = [c for c in race.candidates if c.effect in special_cases(effect) and c.where == effect.where]
    return [p for p in parts if all(e is effect or compatible(e, p) for e in model.effects)]


def together(race: Race, model: Model, effect: Candidate, parts: Sequence[Candidate], say: Progress) -> Model:
    """All special cases of an effect in its place, and what else is then worth adding within as many numbers."""
    new = exchange(race, model, effect, parts[0], say)
    for part in parts[1:]:
        (new,) = fit_models(race, [(new, start_of(race, part))], "special cases", say)
    return _greedy(race, new, say, barred=(effect.effect,), size=model.size)


def _singles(race: Race, say: Progress) -> None:
    chosen = [s for s in race.screened if s.gain > 0][: race.settings.singles]
    fit_models(race, [(race.base, s) for s in chosen], "single effects", say)


def _pairs(race: Race, say: Progress) -> Model:
    """All pairs of the best singles; returns the smallest model that no other beats."""
    top = [m.effects[0] for m in ranked(race, 1)[: race.settings.pairs]]
    singles = ranked(race, 1)
    if not singles:
        return race.base
    if not race.above_noise(race.base):
        return race.base
    best = race.best_of(race.base, singles) or race.base
    plans = []
    for a, b in itertools.combinations(top, 2):
        if compatible(a, b):
            first = race.models[frozenset([a.label])]
            plans.append((first, start_of(race, b)))
    pairs = fit_models(race, plans, "pairs", say)
    best_pair = race.best_of(best, pairs)
    if best_pair is not None and race.passes(best, best_pair):
        return best_pair
    return best if race.passes(race.base, best) else race.base


def _greedy(race: Race, model: Model, say: Progress, barred: Sequence[str] = (), size: float = float("inf")) -> Model:
    """Add what passes, drop what does not, until nothing changes.

    Args:
        barred: effects that are not added; size: free numbers that the model may have at most.
    """
    for _ in range(race.settings.most):
        if not model.effects:
            return model
        model = polish(race, model)
        # at the noise nothing passes any more
        added = _forward(race, model, say, barred, size) if race.above_noise(model) else None
        if added is None:
            return _backward(race, model, say)
        smaller = _backward(race, added, say)
        if {c.label for c in smaller.effects} == {c.label for c in model.effects}:
            return smaller
        model = smaller
    return model


def _elsewhere(race: Race, model: Model, say: Progress) -> Model:
    """Other ways than the greedy one, where that ends far above the noise: one effect may stand in for several.

    Each of its effects in turn is left out, and the search goes on from the rest without that law.
    """
    settings = race.settings
    for _ in range(OTHER_WAYS.elsewhere):
        if not model.effects or race.at_noise(model, (settings.believed * OTHER_WAYS.far) ** 2):
            return model
        noise = settings.believed**2 * race.noise * len(model.cost)
        if model.total - noise < OTHER_WAYS.much * (race.base.total - noise):
            return model
        others = [_instead(race, model, e, say) for e in model.effects]
        best = min((m for m in others if m is not None), key=lambda m: m.total, default=model)
        if best.total - noise > OTHER_WAYS.better * (model.total - noise):
            return model
        model = best
    return model


def _instead(race: Race, model: Model, effect: Candidate, say: Progress) -> Model | None:
    """Where the search leads that may not use this effect's law, from the model's other effects."""
    rest = without(race, model, effect, say)
    start = _forward(race, rest, say, (effect.effect,), float("inf"))
    return None if start is None else _greedy(race, start, say, barred=(effect.effect,))


def _forward(race: Race, model: Model, say: Progress, barred: Sequence[str], size: float) -> Model | None:
    if len(model.effects) >= race.settings.most:
        return None
    others = [c for c in race.candidates if all(compatible(c, e) for e in model.effects) and c.effect not in barred]
    others = [c for c in others if model.size + len(c.coordinates) <= size]
    found = [s for s in screen(race.fitter, model.fit, others, race.settings.screened) if s.gain > 0][
        : race.settings.pairs
    ]
    bigger = fit_models(race, [(model, s) for s in found], f"{len(model.effects) + 1} effects", say)
    passing = [m for m in bigger if race.passes(model, m)]
    return race.best_of(model, passing)


def _backward(race: Race, model: Model, say: Progress) -> Model:
    """Drop effects that the others make superfluous."""
    while len(model.effects) > 1:
        smaller = [without(race, model, e, say) for e in model.effects]
        idle = [m for m in smaller if not race.passes(m, model)]
        if not idle:
            return model
        model = min(idle, key=lambda m: m.total)
    return model
