"""From a table of scores to one answer and its rivals: a pure function.

1. Score: held-out log predictive density of every window, a Student's t as heavy as the window is long, so that neither
   the scale of a misfit nor one bad window decides; its standard error is clustered by operating condition.
2. Same: the better of two models is not better by `errors` standard errors and `nats` plus the logarithm of the number
   of candidates, or what it closes of what the other leaves is not worth naming (`same`).
3. Answer: of the models that are the same as the best, the least: a special case before its general law, one place
   before all of them, fewer numbers. What is the same as that one, and no larger, stands beside it, and the least of
   these is the answer: the best may have an effect more that is not worth naming, which its like lacks. The others that
   are least in their own right are its rivals. Nothing is named only where no model at all is better than the known
   parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.selection.criteria import Criteria
from bayessim_mjx.diagnosis.selection.table import BASE, Key, Law, Row, Table

Array = NDArray[np.float64]
Order = Callable[[Key, Key], bool]  # whether the first model is less than the second


@dataclass(frozen=True)
class Alternative:
    """A model that these logs do not tell from the answer.

    Attributes:
        key: its effects; nats: by how much the answer predicts better; closed: share of the base model's gap.
    """

    key: Key
    nats: float
    closed: float


@dataclass(frozen=True, eq=False)
class Decision:
    """What was decided.

    Attributes:
        answer: the model that is named (`BASE` where nothing is); best: the one that predicts best.
        rivals: the other least models that are the same, most likely first.
        table: what it rests on; trace: the steps in words.
        searched: all models of the search that the table's were chosen from; None where these are all.
    """

    answer: Key
    best: Key
    rivals: tuple[Alternative, ...]
    table: Table
    trace: tuple[str, ...] = ()
    searched: Table | None = None


@dataclass(frozen=True)
class Difference:
    """By how much one model predicts better than another.

    Attributes:
        nats: of held-out log predictive density, and of what data sheets state; deviate: of the former over its
            clustered standard error, as a normal deviate.
        closed: share of what the worse leaves of the squared gap; worst: nats of the condition that gains least, as a
            share of those of all (negative: it loses).
    """

    nats: float
    deviate: float
    closed: float
    worst: float


def compare(table: Table, worse: Key, better: Key) -> Difference:
    """How much `better` predicts better than `worse`."""
    old, new = table.rows[worse], table.rows[better]
    gain = log_gain(old, new, table.noise)
    left, above = table.excess(better), table.excess(worse)
    total = float(gain.sum())
    worst = min(float(gain[table.group == g].sum()) for g in np.unique(table.group)) / max(abs(total), 1e-9)
    deviate = statistics.normal_deviate(gain, table.group)
    return Difference(total + new.belief - old.belief, deviate, 1.0 - left / max(above, 1e-9), worst)


def log_gain(old: Row, new: Row, noise: float) -> Array:
    """`[W]` nats of log predictive density that `new` has more: n log(1 + cost / n), in independent residuals."""
    each = new.samples / len(new.cost)
    return np.asarray(each * (np.log(old.cost + noise) - np.log(new.cost + noise)))


def settled(table: Table, key: Key, criteria: Criteria) -> bool:
    """Whether a model leaves too little to be worth explaining.

    Errors of the time step may be smaller than feared: what has effects has to reach the sensors' noise, or, where that
    is not to be reached either, what another model shows that it can.
    """
    share = min(table.believed, table.reached) if key else 1.0
    return table.excess(key) + 1.0 <= (share * criteria.floor) ** 2


def real(table: Table, worse: Key, better: Key, criteria: Criteria) -> bool:
    """Whether the evidence tells that one model is better: of all conditions, or without harm in any."""
    found = compare(table, worse, better)
    price = criteria.nats + np.log(max(len(table.laws), 2)) * max(1, len(better) - len(worse))
    if worse == BASE and len(table.chance):  # and more than the best candidate gains where nothing is missing
        price = max(price, float(np.quantile(table.chance, 1.0 - criteria.chance)))
    if found.nats <= price:
        return False
    # what acts in few windows only (a limit, drag at speed) helps few of them, but then by much and harms no other
    rare = found.nats > criteria.rare * price and found.worst > -criteria.harm
    return found.deviate > criteria.errors or rare


def relevant(table: Table, worse: Key, better: Key, criteria: Criteria, share: float) -> bool:
    """Whether a better model closes enough of what another leaves, and that one leaves anything."""
    left, above = table.excess(better), table.excess(worse)
    if settled(table, worse, criteria):
        return False
    return above - left > share * above and above - left > _asked(table, worse, criteria)


def _asked(table: Table, worse: Key, criteria: Criteria) -> float:
    """Squared gap that a better model has to close more than this one: more of the whole within the tolerance."""
    least = criteria.least if table.excess(worse) > table.tolerated else criteria.within
    return least * table.excess(BASE)


def same(table: Table, worse: Key, better: Key, criteria: Criteria) -> bool:
    """Whether two models predict the same, for all that these logs tell and all that matters.

    Effects beside the same others have to close enough of what is left; in the place of others, predict as well.
    """
    if not worse < better:
        return _as_good(table, worse, better, criteria) or not real(table, worse, better, criteria)
    return not (relevant(table, worse, better, criteria, criteria.same) and real(table, worse, better, criteria))


def _as_good(table: Table, worse: Key, better: Key, criteria: Criteria) -> bool:
    """By prediction, or within the tolerance by what it leaves of the whole gap; and by what data sheets state."""
    believed = table.rows[better].belief - table.rows[worse].belief < criteria.nats
    left, above = table.excess(better), table.excess(worse)
    enough = above <= table.tolerated and above - left <= _asked(table, worse, criteria)
    return believed and (enough or (1.0 + above) / max(1.0 + left, 1e-9) < 1.0 + criteria.same)


def order(laws: Mapping[str, Law]) -> Order:
    """The partial order of models: subsets, special cases in a law's place, one place instead of all of them."""

    def lesser(a: Law, b: Law) -> bool:
        if a.effect == b.effect:
            return b.where == "all" != a.where
        return a.effect in b.special and a.where == b.where

    def less(a: Key, b: Key) -> bool:
        if a < b:
            return True
        own, other = sorted(a - b), sorted(b - a)
        if not own or not other or len(own) > max(len(other), 1):
            return False
        return all(any(lesser(laws[x], laws[y]) for y in other) for x in own)

    return less


def off(row: Row, criteria: Criteria) -> Key:
    """Effects of a model that hardly are there."""
    return frozenset(label for label, z in row.distance.items() if not z > criteria.far)


def admissible(row: Row, criteria: Criteria) -> bool:
    """Whether all effects of a model are there: by one that hardly is a fit may only have come further."""
    return not off(row, criteria)


def value(table: Table, key: Key, criteria: Criteria) -> float:
    """Nats of evidence over the known parameters alone, less the price of the model's effects."""
    return evidence(table, key) - len(key) * (criteria.nats + float(np.log(max(len(table.laws), 2))))


def evidence(table: Table, key: Key) -> float:
    """Nats of log predictive density over the known parameters alone, and of what data sheets state of the effects.

    All models have as many independent residuals as the one of least error: by counts of their own, of two that close a
    large gap the worse may lead.
    """
    gain = float(log_gain(table.rows[BASE], replace(table.rows[key], samples=table.samples), table.noise).sum())
    return gain + table.rows[key].belief


def decide(table: Table, less: Order, criteria: Criteria) -> Decision:
    """The answer that a table gives; pure."""
    rows = {k: r for k, r in table.rows.items() if admissible(r, criteria)}
    best = max(rows, key=lambda k: value(table, k, criteria))
    trace = [f"best: {_told(best)}, leaves {table.excess(best):.3g}"]
    # also where no amplitude is told, as of one that another number makes up for
    alike = [k for k in table.rows if same(table, k, best, criteria)]
    if BASE in alike:  # one effect may show what it and a doubtful one together blur
        shown = {k for k in table.rows if not same(table, BASE, k, criteria)}
        alike = [k for k in alike if k in shown] if shown & rows.keys() else alike
    equal = [k for k in alike if k in rows] or [best]
    answer = least(table, equal, less, criteria)
    alike = [*alike, *(k for k in table.rows if k not in alike and _beside(table, k, answer, criteria))]
    answer = least(table, [answer, *(k for k in alike if k in rows and k not in equal)], less, criteria)
    trace.append(f"the same as the best: {len(equal)}; least: {_told(answer)}, leaves {table.excess(answer):.3g}")
    return Decision(answer, best, rivals(table, alike, answer, less), table, tuple(trace))


def _beside(table: Table, key: Key, answer: Key, criteria: Criteria) -> bool:
    """Whether a model no larger than the answer, and no part of it, predicts as well as the answer does."""
    return bool(key) and len(key) <= len(answer) and not key <= answer and _as_good(table, key, answer, criteria)


def least(table: Table, equal: Iterable[Key], less: Order, criteria: Criteria) -> Key:
    """Of models that are the same, one that no other is less than: fewest effects, then numbers, then most evidence.

    Above the noise one with more numbers, but no more effects, goes before it where the evidence tells that it is
    better (`real`): what it closes more is not worth another effect, but tells which one it is.
    """
    equal = list(equal)
    lowest = [k for k in equal if not any(less(other, k) for other in equal)]
    first = min(lowest, key=lambda k: (len(k), table.rows[k].size, -evidence(table, k), sorted(k)))
    if settled(table, first, criteria):
        return first
    better = [k for k in lowest if len(k) == len(first) and k != first and real(table, first, k, criteria)]
    return max([first, *better], key=lambda k: (evidence(table, k), sorted(k)))


def rivals(table: Table, equal: Iterable[Key], answer: Key, less: Order) -> tuple[Alternative, ...]:
    """The other least ones, the fewest effects and the best first; what is the answer and more is none."""
    others = [k for k in equal if k and k != answer and not answer < k]
    others = [k for k in others if not any(less(other, k) for other in others)]
    found = [Alternative(k, compare(table, k, answer).nats, table.closed(k)) for k in others]
    return tuple(sorted(found, key=lambda a: (len(a.key), a.nats, sorted(a.key))))


def _told(key: Key) -> str:
    return " + ".join(sorted(key)) or "known parameters"


def chosen_elsewhere(table: Table, less: Order, criteria: Criteria) -> dict[int, Key]:
    """{operating condition: what is named by all others}; {} of one condition.

    The search saw all conditions: only the choice among what it tried is taken anew.
    """
    names = np.unique(table.group)
    return {int(g): decide(table.without(g), less, criteria).answer for g in names} if len(names) > 1 else {}


def closed_elsewhere(table: Table, chosen: Mapping[int, Key]) -> float:
    """Share of the squared gap closed on operating conditions that the decision was made without, at most 1.

    What the other conditions choose (`chosen_elsewhere`) is scored on each; the costs that they choose by are of fits
    that had seen it, so the share is a little too high. A share much below that of the answer means
    that the answer was chosen for what it does by chance. NaN of one condition, and where there is no gap.
    """
    above = table.rows[BASE].total - table.noise * len(table.group)
    if not chosen or above <= 0:
        return float("nan")
    own = {name: table.group == name for name in chosen}
    drop = [np.sum(table.rows[BASE].cost[w] - table.rows[chosen[g]].cost[w]) for g, w in own.items()]
    return min(float(sum(drop)) / above, 1.0)
