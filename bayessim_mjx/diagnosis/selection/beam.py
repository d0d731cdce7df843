"""One search over sets of effects: a beam over neighbours, beside a dense start, with a table of what was visited.

Neighbours of a model: one effect added, dropped, exchanged for another one, replaced by its special cases, or spread
over all joints (`everywhere`). What is fitted is asked of `Fitting`, so that the search can be tried on planted tables.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from bayessim_mjx.diagnosis.selection.budget import FINALISTS, TOGETHER
from bayessim_mjx.diagnosis.selection.criteria import Criteria
from bayessim_mjx.diagnosis.selection.decide import Decision, admissible, decide, off, order, same, settled, value
from bayessim_mjx.diagnosis.selection.everywhere import by_law, laws, needed, spread
from bayessim_mjx.diagnosis.selection.table import BASE, Key, Table

ROUNDS = 4  # of growing and looking around, at most
# times the leading model's cost: from where polishing has brought others ahead of it. What is missed farther away was
# not counted; error rates with it are those of d462f0c in benchmarks/results.md.
CLOSE = 4.0
# laws that are begun with at once: as many as sets of candidates were counted with; of proposals not counted
ATONCE = 3


@dataclass(frozen=True)
class Plan:
    """A model to be fitted from a fitted one.

    Attributes:
        key: its effects; parent: the fitted model that it starts from.
    """

    key: Key
    parent: Key = BASE


class Fitting(Protocol):
    """What can fit models; the single effects are fitted beforehand."""

    @property
    def table(self) -> Table:
        """All models so far."""

    def additions(self, key: Key) -> list[str]:
        """Effects that may bring something on top of a fitted model, the most promising first."""

    def promises(self, key: Key) -> dict[str, float]:
        """{label: predicted drop of the cost} of them."""

    def together(self, most: int, count: int) -> list[Key]:
        """Sets of up to so many effects that promise most when all amplitudes are free at once."""

    def proposed(self, most: int) -> list[Key]:
        """What was proposed together before the search, where there is such a set: up to so many laws of it."""

    def over(self, part: str) -> bool:
        """Whether a part of the search has had its time."""

    def fit(self, plans: Sequence[Plan], label: str, needed: bool = False) -> None:
        """Fit what was not fitted before, as far as the time goes; needed: as far as that of leaving out goes."""

    def polish(self, keys: Sequence[Key]) -> None:
        """Bring the fits of models to their end."""

    def simulate(self, keys: Sequence[Key]) -> Table:
        """A table of some models that are fitted, refitted without each condition, whose windows are then simulated."""


def search(fits: Fitting, criteria: Criteria) -> Decision:
    """Visit models until the best has no better neighbour, and decide among finalists that are fitted to their end."""
    for _ in range(ROUNDS):
        best = _grow(fits, criteria)
        if not best:
            break
        other = _around(fits, best, criteria)
        if other == best or same(fits.table, best, other, criteria):
            break
    return _final(fits, criteria)


def propose(fits: Fitting, criteria: Criteria) -> None:
    """Fit what was proposed together before the search: where time is short it comes before all else."""
    fits.fit([Plan(k) for k in fits.proposed(min(ATONCE, criteria.most))], "proposed together", needed=True)


def leading(table: Table, criteria: Criteria) -> list[Key]:
    """Models in the order in which the search goes on from them: density, less what their effects have to bring."""
    rows = [k for k, r in table.rows.items() if admissible(r, criteria)]
    return sorted(rows, key=lambda k: -value(table, k, criteria))


def close(table: Table, criteria: Criteria, most: int) -> list[Key]:
    """The leading model and up to `most` that may be ahead of it once all are polished; none of them with it and more.

    Until it is polished, a fit has start-state columns of the fit that it began at, which may be far from its own.
    """
    best, *others = leading(table, criteria)
    limit = CLOSE * table.rows[best].total
    near = [k for k in others if k and not (best and best < k) and table.rows[k].total < limit]
    return [best, *near[:most]]


def _best(fits: Fitting, criteria: Criteria, most: int) -> Key:
    """The leading model, and those close to it, with their fits brought to their end before they are ranked."""
    fits.fit(_without_off(fits.table, criteria), "dropping", needed=True)
    for _ in range(criteria.beam):
        keys = close(fits.table, criteria, most)
        fits.polish(keys)
        if leading(fits.table, criteria)[0] in keys:
            break
    return leading(fits.table, criteria)[0]


def _without_off(table: Table, criteria: Criteria) -> list[Plan]:
    """What is left of models that would lead but for effects that are off in them.

    What shows in few windows alone (a limit) may promise nothing by itself and is fitted beside another effect only.
    """
    plans = {}
    best = value(table, leading(table, criteria)[0], criteria)
    for key, row in table.rows.items():
        rest = key - off(row, criteria)
        if rest and rest not in table.rows and value(table, key, criteria) > best:
            plans[rest] = Plan(rest, key)
    return list(plans.values())


def _grow(fits: Fitting, criteria: Criteria) -> Key:
    """Add to the models of the beam as long as that brings something worth naming, and the best is above the noise."""
    best = BASE
    if not settled(fits.table, BASE, criteria):
        propose(fits, criteria)
        best = _best(fits, criteria, criteria.finalists)
    for size in range(1, criteria.most):
        if settled(fits.table, best, criteria) or fits.over(TOGETHER):
            break
        table = fits.table
        beam = _going_on(table, best, criteria)
        plans = [p for k in beam for p in _added(fits, k, criteria.width - 2 * (k != best))]
        plans += _added(fits, best, criteria.width, tied=True)
        if size == 1:
            plans += [Plan(k) for k in fits.together(min(ATONCE, criteria.most), criteria.beam)]
            plans += _everywhere(fits, BASE, criteria) if laws(table, best) < 2 else []
        every = _everywhere(fits, best, criteria)
        fits.fit([*plans, *every], f"{len(best) + 1} effects")
        untold = needed(fits.table, [p.key for p in every], criteria)
        fits.fit([Plan(*pair) for pair in untold], "dropping")
        before, best = best, _best(fits, criteria, criteria.beam)
        if best == before or same(fits.table, before, best, criteria):
            break
    return best


def _going_on(table: Table, best: Key, criteria: Criteria) -> list[Key]:
    """Models that may have one law more: the leading ones, but for smaller ones that the best has left far behind."""
    near = CLOSE * table.rows[best].total
    beam = [k for k in leading(table, criteria)[: criteria.beam] if laws(table, k) < criteria.most]
    return [k for k in beam if laws(table, k) >= laws(table, best) or table.rows[k].total < near]


def _added(fits: Fitting, key: Key, count: int, tied: bool = False) -> list[Plan]:
    """The most promising additions; tied: of laws that are the same everywhere.

    These are few, and of many joints each promises more of its own than what all of them have in common.
    """
    table = fits.table
    some = [x for x in fits.additions(key) if not tied or table.laws[x].where == "all"]
    return [Plan(key | {label}, key) for label in some[: max(count, 1)]]


def _in_place(fits: Fitting, rest: Key, best: Key, count: int) -> list[Plan]:
    """Effects on top of what is left of the best model that promise to come close to it, or to what was left out.

    A promise is linear: of an effect a hundred times the noise a share remains that the fit then takes away. How much,
    the one tells whose place it is.
    """
    rows, promised = fits.table.rows, fits.promises(rest)
    own = rows[rest].total - max((promised[k] for k in best - rest if k in promised), default=math.inf)
    near = [k for k, gain in promised.items() if rows[rest].total - gain < CLOSE * max(rows[best].total, own)]
    return [Plan(rest | {label}, rest) for label in near[:count]]


def _everywhere(fits: Fitting, key: Key, criteria: Criteria) -> list[Plan]:
    table = fits.table
    return [Plan(*p) for p in spread(table, key, fits.promises(key)) if laws(table, p[0]) <= criteria.most]


def _around(fits: Fitting, best: Key, criteria: Criteria) -> Key:
    """The best of a model's neighbours: an effect dropped, exchanged, or in its place special cases or one place."""
    if fits.over(TOGETHER):
        return best
    whole = by_law(fits.table, best)
    fewer = dict.fromkeys([*(best - {label} for label in sorted(best)), *(best - own for own in whole)])
    fits.fit([Plan(key, best) for key in fewer], "dropping", needed=True)
    plans = []
    for own in whole:  # a law at several joints is exchanged as one
        rest = best - own
        plans += _in_place(fits, rest, best, criteria.width) if rest else []
        for label in own if len(own) == 1 else ():
            plans += [Plan(rest | other, rest) for other in specialised(fits.table, best, label)]
    fits.fit([p for p in plans if laws(fits.table, p.key) <= criteria.most], "exchanges")
    table = fits.table
    ahead = leading(table, criteria)[: 2 * criteria.beam]  # simpler ones may not have come to their end
    fits.polish([key for key in ahead if table.rows[key].size < table.rows[best].size])
    return _best(fits, criteria, criteria.beam)


def specialised(table: Table, key: Key, label: str) -> list[Key]:
    """What may stand in the place of one effect of a model: its special cases, each and together, or single places."""
    law, rest = table.laws[label], key - {label}
    fits_in = [c for c in table.laws.values() if all(c.beside(table.laws[other]) for other in rest)]
    parts = [c.label for c in fits_in if c.effect in law.special and c.where == law.where]
    places = [c.label for c in fits_in if c.effect == law.effect and law.where == "all" != c.where]
    return [frozenset([p]) for p in parts + places] + ([frozenset(parts)] if len(parts) > 1 else [])


def finalists(found: Decision, most: int) -> list[Key]:
    """The known parameters, the best model, the answer and up to `most` that may stand in its place."""
    told = [a.key for a in found.rivals[:most]]
    return list(dict.fromkeys([BASE, found.best, found.answer, *told]))


def _without_all(table: Table, key: Key, criteria: Criteria) -> Key:
    """A model without all effects that each alone could be left out, where they are several: one round in place of one
    for each; `BASE` where there are none."""
    fitted = [label for label in key if key - {label} in table.rows]
    spare = frozenset(label for label in fitted if same(table, key - {label}, key, criteria))
    return key - spare if len(spare) > 1 else BASE


def _final(fits: Fitting, criteria: Criteria) -> Decision:
    """The decision among finalists whose fits came to their end and whose held-out windows are simulated.

    With each effect of the answer left out: it is named only if it helps there as well. Where no time is left, rivals
    stay as the search left them.
    """
    less = order(fits.table.laws)
    keys: list[Key] = []
    most = 0 if fits.over(FINALISTS) else criteria.finalists
    if most and not settled(fits.table, BASE, criteria):
        _best(fits, criteria, most)
    for _ in range(ROUNDS):
        found = decide(fits.table, less, criteria)
        if set(finalists(found, most)) <= set(keys):
            break
        keys = finalists(found, most)
        fits.polish(keys)
        most = 0 if fits.over(FINALISTS) else most
    searched, table = found, fits.table
    while True:
        smaller = [found.answer - {label} for label in found.answer]
        fits.fit([Plan(k, found.answer) for k in smaller], "dropping", needed=True)
        fits.polish(smaller)
        if rest := _without_all(fits.table, found.answer, criteria):
            fits.fit([Plan(rest, found.answer)], "dropping", needed=True)
            fits.polish([rest])
            smaller.append(rest)
        keys = list(dict.fromkeys([*keys, found.answer, *smaller]))
        found = decide(fits.simulate(keys), less, criteria)
        if all(found.answer - {label} in keys for label in found.answer):
            break
    unseen = () if most else tuple(a for a in searched.rivals if a.key not in keys and not found.answer < a.key)
    steps = (f"simulated: {step}" for step in found.trace)
    return replace(found, rivals=(*found.rivals, *unseen), searched=table, trace=(*searched.trace, *steps))
