"""The search on planted sums of effects: two and three of them, hidden behind each other and behind stand-ins."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.selection import beam
from bayessim_mjx.diagnosis.selection.criteria import Criteria
from tests.diagnosis.selection.planted import Linear, columns, law, table

A, B, C, D = "a@hinge", "b@hinge", "c@hinge", "d@hinge"


def found(laws, amounts, seed=0, **criteria):
    fits = Linear(laws, amounts, seed)
    selection = beam.search(fits, Criteria(**criteria))
    return set(selection.answer), fits


@pytest.mark.parametrize("seed", range(3))
def test_where_nothing_is_planted_nothing_is_named_and_nothing_more_is_fitted(seed):
    answer, fits = found(columns(20, seed), {}, seed)
    assert answer == set() and fits.fitted == 1 + 20


@pytest.mark.parametrize("amounts", [{A: 3.0}, {A: 3.0, B: -3.0}, {A: 4.0, B: 2.0, C: -3.0}, {A: 10.0, B: 1.0}])
def test_planted_effects_are_named_and_no_others(amounts):
    answer, fits = found(columns(20), amounts)
    assert answer == set(amounts)
    assert fits.fitted < 21 + 80  # of 1350 models of two or three


@pytest.mark.parametrize("seed", range(3))
def test_two_effects_that_hide_each_other_behind_a_stand_in_for_both(seed):
    """Neither a nor b shows in a fit of its own; c explains a third of what both do."""
    laws = columns(20, seed)
    left = np.random.default_rng(9).normal(size=len(laws[A]))
    laws[B] = -laws[A] + 0.3 * left
    laws[C] = 0.6 * left + 0.8 * laws[C]
    answer, fits = found(laws, {A: 10.0, B: 10.0}, seed)
    singles = [fits.table.excess(frozenset([x])) / fits.table.excess(frozenset()) for x in (A, B, C)]
    assert min(singles[:2]) > 0.85 and singles[2] < 0.75
    assert answer == {A, B}


@pytest.mark.parametrize("seed", range(3))
def test_three_effects_of_which_no_two_show(seed):
    laws = columns(12, seed)
    left = np.random.default_rng(9).normal(size=len(laws[A]))
    laws[C] = -laws[A] - laws[B] + 0.5 * left
    answer, fits = found(laws, {A: 6.0, B: 6.0, C: 6.0}, seed)
    pairs = [frozenset(p) for p in ((A, B), (A, C), (B, C))]
    assert all(fits.table.excess(frozenset([x])) > 0.8 * fits.table.excess(frozenset()) for x in (A, B, C))
    assert all(p not in fits.rows or fits.table.excess(p) > 0.5 * fits.table.excess(frozenset()) for p in pairs)
    assert answer == {A, B, C}


def test_a_first_effect_that_later_ones_make_superfluous_is_dropped():
    """d is nearly the sum of a and b: the best single, and idle beside both."""
    laws = columns(15)
    laws[D] = laws[A] + laws[B] + 0.5 * laws[D]
    assert found(laws, {A: 4.0, B: 4.0})[0] == {A, B}


def test_no_more_effects_than_allowed():
    answer, _ = found(columns(12), {A: 6.0, B: 5.0, C: 4.0, D: 3.0}, most=2)
    assert answer == {A, B}


def test_an_effect_whose_help_was_only_linearised_is_not_named():
    class Optimist(Linear):
        """Simulated, b helps nothing."""

        def simulate(self, keys):
            seen = super().simulate(keys)
            rows = {k: seen.rows[frozenset([A])] if k == frozenset([A, B]) else r for k, r in seen.rows.items()}
            return type(seen)(rows, seen.laws, seen.group, seen.noise)

    fits = Optimist(columns(10), {A: 5.0, B: 2.0})
    selection = beam.search(fits, Criteria())
    assert set(selection.answer) == {A} and selection.trace[-1].startswith("simulated: ")
    assert frozenset([A, B]) in selection.table.rows and len(selection.searched.rows) > len(selection.table.rows)


def test_a_rival_that_only_polishing_brings_ahead_is_named():
    """Before it is polished, the cost of a, which is the truth, is three times what it is; c explains two thirds."""

    class Rough(Linear):
        def __init__(self, *args):
            super().__init__(*args)
            self.polished = set()

        @property
        def table(self):
            known = super().table
            key = frozenset([A])
            own = known.rows[key]
            raw = dataclasses.replace(own, cost=own.cost + 0.6 * known.rows[frozenset()].cost)
            return known if key in self.polished else dataclasses.replace(known, rows=known.rows | {key: raw})

        def polish(self, keys):
            self.polished |= set(keys)

    laws = columns(10)
    laws[C] = 2.0 * laws[A] + laws[C]
    fits = Rough(laws, {A: 3.0})
    assert beam.leading(fits.table, Criteria())[0] == {C}  # as it was fitted
    selection = beam.search(fits, Criteria())
    assert set(selection.answer) == {A} and frozenset([C]) in fits.polished


def test_what_was_only_tried_beside_an_effect_that_is_off_is_fitted_by_itself():
    """The truth, a, promises nothing by itself; beside b it is found, and b is off there."""

    class Shy(Linear):
        def __init__(self, *args):
            super().__init__(*args)
            del self.rows[frozenset([A])]

        def _fit(self, key):
            super()._fit(key)
            if key == {A, B}:
                row = self.rows[key]
                self.rows[key] = dataclasses.replace(row, distance={**row.distance, B: 0.2})

        def additions(self, key):
            return [B] if key == {A} else [A] if key == {B} else []

        def together(self, most, count):
            return [frozenset([A, B])]

    fits = Shy(columns(6), {A: 3.0})
    assert set(beam.search(fits, Criteria()).answer) == {A}
    assert not beam._without_off(fits.table, Criteria())


def test_where_no_time_is_left_nothing_is_added_and_rivals_stay_as_they_were():
    class Late(Linear):
        def over(self, part):
            return True

    fits = Late(columns(20), {A: 4.0, B: 3.0})
    selection = beam.search(fits, Criteria())
    assert set(selection.answer) == {A} and fits.fitted == 1 + 20
    laws = columns(6)
    laws[B] = laws[A] + 0.001 * laws[B]
    late, whole = Late(laws, {A: 4.0}), Linear(laws, {A: 4.0})
    told = [{r.key for r in beam.search(fits, Criteria()).rivals} for fits in (late, whole)]
    assert told[0] == told[1] != set()


def test_what_there_was_no_time_to_leave_out_stays_in_the_answer():
    class Late(Linear):
        def proposed(self, most):
            return [frozenset([A, B, C])]

        def over(self, part):
            return True

        def fit(self, plans, label, needed=False):
            super().fit([plan for plan in plans if not needed or not plan.parent], label)

        def polish(self, keys):
            super().polish([key for key in keys if key in self.rows])

        def simulate(self, keys):
            return super().simulate([key for key in keys if key in self.rows])

    fits = Late(columns(20), {A: 4.0, B: 3.0, C: 2.0})
    assert set(beam.search(fits, Criteria()).answer) == {A, B, C} and fits.fitted == 1 + 20 + 1


def test_what_may_stand_in_the_place_of_an_effect():
    dry, viscous = law("coulomb_friction"), law("viscous_friction")
    both = law("asymmetric_friction", numbers=2, special=("coulomb_friction", "viscous_friction"))
    tied, one = law("armature", "all", places=("hinge", "wrist")), law("armature", "wrist")
    known = table({(): 9, (dry,): 9, (viscous,): 9, (both,): 9, (tied,): 9, (one,): 9})
    parts = beam.specialised(known, frozenset([both.label]), both.label)
    assert parts == [{dry.label}, {viscous.label}, {dry.label, viscous.label}]
    assert beam.specialised(known, frozenset([tied.label]), tied.label) == [{one.label}]
    beside = frozenset([both.label, dry.label])  # what is there already cannot come again
    assert beam.specialised(known, beside, both.label) == [{viscous.label}]


def test_effects_that_can_each_be_left_out_are_left_out_together():
    a, b, c, d = (law(n) for n in "abcd")
    whole = {(): 100.0, (a, b, c, d): 1.0, (b, c, d): 60.0, (a, c, d): 50.0}
    label = frozenset(x.label for x in (a, b, c, d))
    both = table(whole | {(a, b, d): 1.01, (a, b, c): 1.02})
    assert beam._without_all(both, label, Criteria()) == {a.label, b.label}
    one = table(whole | {(a, b, d): 1.01, (a, b, c): 30.0})
    assert beam._without_all(one, label, Criteria()) == frozenset()


def test_what_stands_in_an_effects_place_is_measured_by_what_that_effect_promised():
    """Promises of strong effects fall short: here a leaves 200 of 1000 by its promise and 10 as fitted; so may b."""
    rows = {frozenset(): 1000.0, frozenset([A]): 10.0}
    rows = {key: SimpleNamespace(total=total) for key, total in rows.items()}
    fits = SimpleNamespace(table=SimpleNamespace(rows=rows), promises=lambda key: {A: 800.0, B: 700.0, C: 150.0})
    (plan, other) = beam._in_place(fits, frozenset(), frozenset([A]), 5)
    assert plan.key == {A} and other.key == {B}
    rows[frozenset([A])] = SimpleNamespace(total=60.0)
    fits.promises = lambda key: {A: 990.0, B: 761.0, C: 759.0}
    assert [p.key for p in beam._in_place(fits, frozenset(), frozenset([A]), 5)] == [{A}, {B}]
