"""The selection by evidence: from candidates to the answer, what stands beside it, and their probabilities."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.evidence import force_left, laws
from bayessim_mjx.diagnosis.evidence.force_left import ForceLeft
from bayessim_mjx.diagnosis.evidence.laws import compatible, special_cases
from bayessim_mjx.diagnosis.evidence.search import Search
from bayessim_mjx.diagnosis.evidence.weighing import Estimated, Scored, Weighed, Weighing, at_its_mean, estimated
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.fitting.quadratic import Quadratic, eliminate, solve
from bayessim_mjx.diagnosis.phrases import effects as phrases
from bayessim_mjx.diagnosis.selection.models import BASE, Key, Model
from bayessim_mjx.diagnosis.selection.numbers import LEAVING_OUT, Progress
from bayessim_mjx.diagnosis.selection.screen import Column
from bayessim_mjx.diagnosis.selection.search_state import SearchState, Settings
from bayessim_mjx.diagnosis.selection.successive_halving import Entries, begin, cut_back, fit_entries
from bayessim_mjx.diagnosis.statistics import Gap, shapley

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Size:
    """How large an effect is: the parameter that lies most standard deviations from neutral, and by how much.

    Attributes:
        quantity: the parameter's name; mean, sd: of its distance from neutral, in its unit.
    """

    quantity: str
    mean: float
    sd: float
    unit: str


def size_of(effect: Candidate, values: Array, sd: Array) -> Size:
    """How large an effect with these numbers `[k]` and standard deviations `[k]` is; shapes are no sizes."""
    each = zip(effect.coordinates, effect.shapes, values, sd, strict=True)
    sizes = [
        Size(c.name.rsplit(".", 1)[1], abs(float(v - c.neutral)), float(s), c.unit)
        for c, shape, v, s in each
        if not shape
    ]
    return max(sizes, key=lambda size: size.mean / max(size.sd, 1e-12))


def size_in(of: Scored, effect: Candidate) -> Size:
    """How large one of the model's effects is."""
    mean, covariance = of.numbers()
    own = [of.model.fit.names.index(c.name) for c in effect.coordinates]
    return size_of(effect, mean[own], np.sqrt(np.diag(covariance)[own]))


@dataclass(frozen=True, eq=False)
class Rival:
    """Another explanation that fits these logs as well as the answer, or as a part of it.

    Attributes:
        effects: those that the answer lacks; model: these together with other effects of the answer.
        closure: share of the gap that the model closes; why: it is a rival, in words.
        contains: whether it contains the effect as a special case, and so is no other explanation.
        size: of its effect; None if it has several.
    """

    effects: tuple[Candidate, ...]
    model: Model
    closure: float
    why: str
    contains: bool = False
    size: Size | None = None

    def to_dict(self) -> dict[str, Any]:
        return {"effects": [c.label for c in self.effects], "gap_closed": self.closure, "why": self.why}


@dataclass(frozen=True, eq=False)
class Selection:
    """The result of the search.

    Attributes:
        state: all fitted models; it is only read from here on.
        answer: the named model (`state.base` if no effect is named).
        rivals: {label of one of its effects: explanations that may take its place}.
        subsets: {labels: the model with these of its effects}, every one refitted; {} of one effect or without time.
        promised: predicted share of the base model's gap that its effects close, {label: part}.
        chosen: {operating condition: effects that are named without it}.
        elsewhere: share of the gap closed on conditions that the choice was made without; NaN of one condition.
        hidden: labels of effects that would not show beside those of the answer (`laws.by_effects`).
        stand_ins: {known parameter: labels of effects that it may stand for} (`laws.by_parameters`).
        weighed: probabilities of the sets that were fitted; estimated: posterior of the answer's numbers.
        force: what the answer leaves as force.
    """

    state: SearchState
    answer: Model
    rivals: Mapping[str, tuple[Rival, ...]]
    subsets: Mapping[Key, Model]
    promised: tuple[float, Mapping[str, float]]
    chosen: Mapping[int, Key]
    elsewhere: float
    hidden: tuple[str, ...]
    stand_ins: Mapping[str, tuple[str, ...]]
    weighed: Weighed
    estimated: Estimated
    force: ForceLeft

    @property
    def ambiguous(self) -> bool:
        """Whether a rival that does not contain the effect as a special case fits as well."""
        return any(not r.contains for rivals in self.rivals.values() for r in rivals)


def select(
    fitter: Fitter,
    candidates: Sequence[Candidate],
    settings: Settings,
    say: Progress,
    keep: Callable[[SearchState], None] = lambda state: None,
) -> Selection:
    """Search for the effects that the logs on the windows of `fitter` call for.

    Args:
        keep: called with the state of the search after each part.
    """
    state = begin(fitter, candidates, settings, say, keep)
    search = Search(state, say)
    found = search.run()
    keep(state)
    at_its_mean(search.weighing, found.answer)
    state.base = state.models[BASE]
    names = np.unique(fitter.simulator.windows.group)
    chosen = {int(g): search.weighing.without(int(g)).answer for g in names} if len(names) > 1 and found.answer else {}
    answer = state.models[found.answer]
    several = len(answer.effects) > 1 and not settings.budget.over(LEAVING_OUT)
    subsets = _subsets(state, answer, say) if several else {}
    return Selection(
        state=state,
        answer=answer,
        rivals={e.label: tuple(_rivals(search.weighing, e, found)) for e in answer.effects},
        subsets=subsets,
        elsewhere=_elsewhere(state, chosen),
        promised=promised(state, answer.effects) if answer.effects else (0.0, {}),
        chosen=chosen,
        hidden=laws.by_effects(state, answer, say),
        stand_ins=laws.by_parameters(answer, [state.models[k] for k in found.beside if found.answer < k]),
        weighed=found,
        estimated=estimated(search.weighing, found),
        force=force_left.of_set(search.weighing, found.answer),
    )


def _rivals(weighing: Weighing, effect: Candidate, found: Weighed) -> list[Rival]:
    """List sets that may stand in an effect's place, most likely first: sets without strong evidence against them."""
    others = [k for k in found.beside if k and not found.answer < k]
    return [_rival(weighing, effect, k, found) for k in others if effect.label not in k and k - found.answer]


def _rival(weighing: Weighing, effect: Candidate, key: Key, found: Weighed) -> Rival:
    state = weighing.state
    model, answer = state.models[key], state.models[found.answer]
    others = tuple(e for e in model.effects if e.label not in found.answer)
    size = size_in(weighing.scored[key], others[0]) if len(others) == 1 else None
    contains = any(effect.effect in special_cases(o) and o.where == effect.where for o in others)
    same = any(o.effect == effect.effect and not compatible(o, effect) for o in others)
    closed = state.gap(model).closed
    nats = found.nats[found.answer] - found.nats[key]
    why = phrases.CONTAINS if contains else phrases.close_by(nats, state.gap(answer).closed - closed)
    return Rival(others, model, closed, why, contains or same, size)


def _subsets(state: SearchState, answer: Model, say: Progress) -> dict[Key, Model]:
    """{labels: the model with these of the answer's effects}, each fitted from one with one effect more.

    None has a larger error than one that it contains (`none_worse`).
    """
    every = frozenset(e.label for e in answer.effects)
    for size in range(len(every) - 1, 0, -1):
        entries: Entries = {}
        for own in map(frozenset, itertools.combinations(sorted(every), size)):
            parent = state.models.get(own | {min(every - own)})
            if own not in state.models and parent is not None:
                kept = tuple(e for e in parent.effects if e.label in own)
                entries[own] = ([cut_back(state, parent, kept)], kept)
        fit_entries(state, entries, "leaving effects out", say, LEAVING_OUT)
    keys = [frozenset(own) for n in range(len(every)) for own in itertools.combinations(sorted(every), n)]
    if not all(key in state.models for key in keys):
        return {}
    found = none_worse(state, keys, say)
    return found | {every: min((answer, *found.values()), key=lambda model: model.total)}


def none_worse(state: SearchState, keys: Sequence[Key], say: Progress) -> dict[Key, Model]:
    """{fitted set: the best model that it contains}: with its further effects neutral a set is each of its subsets.

    A fit may rest far off all the same, as the evidence takes a part of its error for a force. A set with a larger
    held-out error than one of its subsets is fitted again from there, its further effects neutral and as it has them;
    `state.models` keeps the better fit. Where that is still worse, the subset's model is its own.
    """
    out: dict[Key, Model] = {}
    for size in sorted({len(key) for key in keys}):
        old = {key: state.models[key] for key in keys if len(key) == size}
        within = {k: min((out[j] for j in out if j < k), key=lambda m: m.total, default=own) for k, own in old.items()}
        entries: Entries = {}
        for key, less in within.items():
            if less.total < old[key].total:
                held = {e.label for e in less.effects}
                further = tuple(e for e in old[key].effects if e.label not in held)
                coordinates = [c for e in further for c in e.coordinates]
                starts = np.array([c.neutral for c in coordinates]), np.concatenate([*map(old[key].values_of, further)])
                begun = state.begun(less.fit)
                fits = [state.fitter.derive(begun, coordinates, values) for values in starts]
                entries[key] = fits, (*less.effects, *further)
        fit_entries(state, entries, "leaving effects out", say, LEAVING_OUT)
        for key, model in old.items():
            state.models[key] = min(model, state.models[key], key=lambda m: m.total)
            out[key] = min(state.models[key], within[key], key=lambda m: m.total)
    return out


def _elsewhere(state: SearchState, chosen: Mapping[int, Key]) -> float:
    """Share of the squared gap closed on operating conditions that the choice was made without, at most 1.

    The fits behind the choice had seen the condition, so the share is a little too high. A share much below that of the
    answer means that the answer was chosen for what it does by chance. NaN of one condition, and where there is no gap.
    """
    group = state.fitter.simulator.windows.group
    after = sum(float(np.sum(state.models[k].cost[group == g])) for g, k in chosen.items())
    return replace(state.gap(state.models[BASE]), after=after).closed if chosen else float("nan")


def promised(state: SearchState, effects: Sequence[Candidate]) -> tuple[float, dict[str, float]]:
    """Shares of the recalibrated simulator's squared gap above the noise that adding effects promises to close.

    Before any is fitted: linear, from one simulation of each, in the unit of what they then close: mean squares of the
    windows.

    Returns:
        Of all effects, and of each (Shapley, 1953).
    """
    q, precision, high = _linear(state, effects)
    base = len(state.fitter.base)

    _, pull, low, top = state.base.fit.prior()
    even = np.ones(len(state.base.fit.r))  # all windows count alike, as in what is realised

    def left(some: frozenset[int]) -> float:
        """Mean square with some of the effects, the known parameters refitted."""
        columns = np.array([*range(base), *(base + i for i in sorted(some))], dtype=np.int64)
        more = np.zeros(len(some))
        own = q.subset(columns)
        g, S = own.weighted(even)
        limits = np.concatenate([low, more]), np.concatenate([top, high[sorted(some)]])
        p = solve(S + np.diag(precision[columns]), g + np.concatenate([pull, more]), *limits)
        return float(own.at(p).mean()) / state.noise

    before = left(frozenset())
    every = frozenset(range(len(effects)))

    def share(some: frozenset[int]) -> float:
        return max(Gap(before, left(some)).closed, 0.0)  # what promises harm is not added

    each, total = shapley(len(effects), share), share(every)
    return total, {e.label: share for e, share in zip(effects, each, strict=True)}


def _linear(state: SearchState, effects: Sequence[Candidate]) -> tuple[Quadratic, Array, Array]:
    """(quadratic in the known parameters' steps and the amounts of the effects, precisions, largest amounts).

    An amount of 1 is the start that the screening chose.
    """
    fitter, fit = state.fitter, state.base.fit
    starts = [next(s.start for s in state.screened if s.candidate.label == e.label) for e in effects]
    pairs = list(zip(effects, starts, strict=True))
    thetas = [fitter.vector((*fit.coordinates, *e.coordinates), np.concatenate([fit.values, s])) for e, s in pairs]
    moved = fitter.whiten(fitter.simulator.run(np.stack(thetas), np.repeat(fit.offsets[None], len(thetas), 0)))
    columns = [Column(*pair, fit.r - own) for pair, own in zip(pairs, moved, strict=True)]
    A = np.concatenate([fit.A, *(c.change[..., None] for c in columns)], axis=2)
    q, _ = eliminate(fit.r, A, fit.B, fit.offsets, fit.spread)
    precision, most = [c.precision for c in columns], [c.room[1] for c in columns]
    return q, np.array([*fit.belief(), *precision]), np.array(most)
