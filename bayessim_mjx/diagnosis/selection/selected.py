"""The whole selection: from candidates to the model that the logs call for, its rivals and its parts, frozen."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from bayessim_mjx.diagnosis import phrases
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.selection import beam, heldout, hidden, predicted_gain, singles, weak_directions
from bayessim_mjx.diagnosis.selection.budget import LEAVING_OUT
from bayessim_mjx.diagnosis.selection.criteria import Criteria
from bayessim_mjx.diagnosis.selection.decide import Alternative, Decision, chosen_elsewhere, closed_elsewhere, order
from bayessim_mjx.diagnosis.selection.fits import Fits
from bayessim_mjx.diagnosis.selection.laws import compatible, special_cases
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.pool import Pool, Progress
from bayessim_mjx.diagnosis.selection.screen import Screened
from bayessim_mjx.diagnosis.selection.sets import Estimated, Weighed
from bayessim_mjx.diagnosis.selection.table import Key, Table
from bayessim_mjx.diagnosis.selection.tried import Settings, Tried
from bayessim_mjx.diagnosis.selection.weak_directions import Ridges

MANY = 4  # effects, up to which every subset is fitted


@dataclass(frozen=True, eq=False)
class Rival:
    """Another explanation that these logs cannot tell from (a part of) the answer.

    Attributes:
        effects: those that the answer does not have; model: with the answer's other ones.
        closure: share of the gap that the model closes; why: in words.
        contains: whether it is the effect and more: no other explanation.
    """

    effects: tuple[Candidate, ...]
    model: Model
    closure: float
    why: str
    contains: bool = False

    def to_dict(self) -> dict[str, Any]:
        return {"effects": [c.label for c in self.effects], "gap_closed": self.closure, "why": self.why}


@dataclass(frozen=True, eq=False)
class Selection(Tried):
    """What the selection came to.

    Attributes:
        answer: the model that is named (`base` where nothing is).
        rivals: {label of one of its effects: what may stand in its place}.
        table: the finalists' scores that it rests on; searched: those of all models; trace: the steps in words.
        subsets: {labels: the model with these of its effects}, every one refitted; {} of one effect or of too many.
        promised: share of the base model's gap that its effects promised to close before any was fitted, {label: part}.
        along: what was simulated along its weak directions.
        chosen: {operating condition: effects that are named without it}.
        elsewhere: share of the gap closed on conditions that the choice was made without; NaN of one condition.
        hidden: labels of effects that would not show beside those of the answer (`selection.hidden`).
        weighed, estimated: probabilities of sets and the answer's posterior, where the evidence decided.
    """

    fitter: Fitter
    candidates: tuple[Candidate, ...]
    settings: Settings
    criteria: Criteria
    nominal: Fit
    base: Model
    models: Mapping[frozenset[str], Model]
    screened: tuple[Screened, ...]
    answer: Model
    rivals: Mapping[str, tuple[Rival, ...]]
    table: Table | None = None
    searched: Table | None = None
    trace: tuple[str, ...] = ()
    subsets: Mapping[frozenset[str], Model] = field(default_factory=dict)
    promised: tuple[float, Mapping[str, float]] = (0.0, MappingProxyType({}))
    along: Ridges | None = None
    chosen: Mapping[int, Key] = field(default_factory=dict)
    elsewhere: float = float("nan")
    hidden: tuple[str, ...] = ()
    weighed: Weighed | None = None
    estimated: Estimated | None = None
    cut_short: frozenset[str] = frozenset()
    skipped: Mapping[str, int] = field(default_factory=dict)

    @property
    def ambiguous(self) -> bool:
        """Whether something else than what contains an effect as a special case would do as well."""
        return any(not r.contains for rivals in self.rivals.values() for r in rivals)

    def reopened(self) -> Pool:
        """A pool that goes on from here."""
        found = dict(self.models), list(self.screened), set(self.cut_short), dict(self.skipped)
        return Pool(self.fitter, self.candidates, self.settings, self.criteria, self.nominal, self.base, *found)


def select(
    fitter: Fitter,
    candidates: Sequence[Candidate],
    settings: Settings,
    criteria: Criteria,
    say: Progress,
    keep: Callable[[Tried], None] = lambda tried: None,
) -> Selection:
    """What the logs on the windows of `fitter` call for; `keep` is called with what was tried so far."""
    pool = singles.begin(fitter, candidates, settings, criteria, say, keep)
    if pool.above_noise(pool.base):
        beam.propose(Fits(pool, say), criteria)
    singles.fit_singles(pool, say)
    decision = beam.search(Fits(pool, say), criteria)
    keep(pool)
    return concluded(pool, decision, say)


def concluded(pool: Pool, decision: Decision, say: Progress, along_ridges: bool = True) -> Selection:
    """The answer where data and beliefs together put it, with its rivals and its parts.

    along_ridges: whether it still has to move along directions that the data hardly tell.
    """
    fitter, settings, searched = pool.fitter, pool.settings, decision.searched or decision.table
    pool.base = pool.models[frozenset()]
    named = pool.models[decision.answer]
    rivals = {e.label: _rivals(pool, e, named, decision) for e in named.effects}
    chosen = chosen_elsewhere(searched, order(searched.laws), pool.criteria) if named.effects else {}
    answer, along = named, None
    if answer.effects and along_ridges:
        answer, along = weak_directions.settled(fitter, answer)
        (answer,) = [answer] if answer is named else heldout.refitted(fitter, [answer])
        pool.models[decision.answer] = answer
    few = 1 < len(answer.effects) <= MANY and not settings.budget.over(LEAVING_OUT)
    subsets = _subsets(pool, answer, say) if few else {}
    total, each = predicted_gain.promised(pool, answer.effects) if answer.effects else (0.0, {})
    return replace(
        frozen(pool, answer, rivals),
        table=decision.table,
        searched=searched,
        trace=decision.trace,
        subsets=subsets,
        promised=(total, each),
        along=along,
        chosen=chosen,
        elsewhere=closed_elsewhere(searched, chosen),
        hidden=hidden.beside(pool, answer, say),
    )


def frozen(pool: Pool, answer: Model, rivals: Mapping[str, Sequence[Rival]]) -> Selection:
    """What a pool holds, and an answer with its rivals."""
    return Selection(
        fitter=pool.fitter,
        candidates=tuple(pool.candidates),
        settings=pool.settings,
        criteria=pool.criteria,
        nominal=pool.nominal,
        base=pool.base,
        models=MappingProxyType(dict(pool.models)),
        screened=tuple(pool.screened),
        cut_short=frozenset(pool.cut_short),
        skipped=MappingProxyType(dict(pool.skipped)),
        answer=answer,
        rivals=MappingProxyType({label: tuple(found) for label, found in rivals.items()}),
    )


def _rivals(pool: Pool, effect: Candidate, answer: Model, decision: Decision) -> list[Rival]:
    """What may stand in an effect's place, the fewest effects first."""
    found = [a for a in decision.rivals if effect.label not in a.key and a.key - decision.answer]
    return [_rival(pool, effect, answer, a, decision) for a in found]


def _rival(pool: Pool, effect: Candidate, answer: Model, found: Alternative, decision: Decision) -> Rival:
    model = pool.models[found.key]
    others = tuple(e for e in model.effects if e.label not in decision.answer)
    contains = any(effect.effect in special_cases(o) and o.where == effect.where for o in others)
    same = any(o.effect == effect.effect and not compatible(o, effect) for o in others)
    behind = max(decision.table.closed(decision.answer) - found.closed, 0.0)
    why = phrases.CONTAINS if contains else phrases.close_by(found.nats, behind)
    return Rival(others, model, found.closed, why, contains or same)


def _subsets(pool: Pool, answer: Model, say: Progress) -> dict[frozenset[str], Model]:
    """{labels: the model with these of the answer's effects}, each fitted from one with one effect more."""
    every, fits = frozenset(e.label for e in answer.effects), Fits(pool, say)
    for size in range(len(every) - 1, 0, -1):
        some = [frozenset(own) for own in itertools.combinations(sorted(every), size)]
        fits.fit([beam.Plan(own, own | {min(every - own)}) for own in some], "dropping", needed=True)
    known = itertools.chain.from_iterable(itertools.combinations(every, n) for n in range(len(every) + 1))
    found = {frozenset(own): pool.models.get(frozenset(own)) for own in known}
    return {own: model for own, model in found.items() if model is not None} if all(found.values()) else {}
