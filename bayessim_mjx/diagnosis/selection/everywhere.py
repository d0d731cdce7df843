"""One law at all of its joints, with numbers of its own at each: a real robot has friction in every joint.

Such a model has as many effects as joints. Grown joint by joint, each step would have to show beside all that is still
missing elsewhere; as one step of the search it is there at once, and what a joint does not need is dropped again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from bayessim_mjx.diagnosis.selection.criteria import Criteria
from bayessim_mjx.diagnosis.selection.decide import admissible
from bayessim_mjx.diagnosis.selection.table import BASE, Key, Table

# further laws that are spread over the joints beside a model's own, those that promise most at all of them in sum: a
# bound on the cost, not counted
LAWS = 3


def places(table: Table, effect: str) -> Key:
    """The labels of a law at all of its joints, one by one; none where it has a single one, or is of another kind."""
    own = [c for c in table.laws.values() if c.effect == effect and c.spread and c.where != "all"]
    return frozenset(c.label for c in own) if len(own) > 1 else BASE


def laws(table: Table, key: Key) -> int:
    """How many laws a model has: at several joints it is one."""
    return len({table.laws[label].effect for label in key})


def by_law(table: Table, key: Key) -> list[Key]:
    """The labels of a model, those of one law together."""
    effects = sorted({table.laws[label].effect for label in key})
    return [frozenset(label for label in key if table.laws[label].effect == e) for e in effects]


def spread(table: Table, key: Key, promises: Mapping[str, float]) -> list[tuple[Key, Key]]:
    """(model, fitted model to start from) for one more law, or one of the model's own, at all of its joints.

    It stands in the place of its special cases: beside them its numbers would be there twice.

    Args:
        key: a fitted model; promises: {label: predicted drop of the cost} of what may be added to it.
    """
    own = sorted({table.laws[label].effect for label in key})
    total = {c.effect: 0.0 for c in table.laws.values() if c.effect not in own and places(table, c.effect)}
    for effect in total:
        total[effect] = sum(promises.get(label, 0.0) for label in places(table, effect))
    more = sorted((e for e, gain in total.items() if gain > 0), key=lambda e: -total[e])[:LAWS]
    found = []
    for effect in [*(e for e in own if places(table, e)), *more]:
        every = places(table, effect)
        instead = {effect, *(s for label in every for s in table.laws[label].special)}
        rest = frozenset(label for label in key if table.laws[label].effect not in instead)
        if every <= key or not _together(table, every | rest):
            continue
        starts = [k for k in (key, rest, BASE) if k in table.rows and k <= every | rest]
        found.append((every | rest, starts[0]))
    return found


def needed(table: Table, keys: Sequence[Key], criteria: Criteria) -> list[tuple[Key, Key]]:
    """Of spread models, those with places whose numbers are not told: (without these places, the model)."""
    out = []
    for key in (k for k in keys if k in table.rows and not admissible(table.rows[k], criteria)):
        told = frozenset(label for label in key if table.rows[key].distance.get(label, 0.0) > criteria.far)
        out += [(told, key)] if told else []
    return out


def _together(table: Table, key: Key) -> bool:
    own = [table.laws[label] for label in sorted(key)]
    return all(a.beside(b) for i, a in enumerate(own) for b in own[:i])
