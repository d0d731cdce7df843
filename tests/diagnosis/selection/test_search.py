"""Which models the race ends at, where how well each predicts is known: pairs, steps, ways round, special cases."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from bayessim_mjx.diagnosis.selection import search
from bayessim_mjx.diagnosis.selection.race import Settings
from tests.diagnosis.tables import Table, law

A, B, C, X = (law(name) for name in "abcx")


@dataclass
class Point:
    A: np.ndarray = field(default_factory=lambda: np.zeros(0))
    coordinates: tuple = ()


def silent(*_):
    pass


def winner(monkeypatch, errors, **settings):
    """The laws of the model that the whole search ends at."""
    table = Table(monkeypatch, errors, Settings(**settings))
    fitter = table.race.fitter
    fitter.base, fitter.begin, fitter.refresh = (), lambda base: Point(), lambda fit: fit
    fitter.iterate = lambda fits, *args: fits
    monkeypatch.setattr(search, "scored", lambda fitter, fit, effects: table.model(effects))
    monkeypatch.setattr(search, "widen_leading", silent)
    race = search.run(fitter, table.laws, table.race.settings)
    assert race.base.effects == ()
    return set(race.winner.effects), race


def test_where_nothing_is_wrong_nothing_is_named_and_a_few_are_told(monkeypatch):
    found, race = winner(monkeypatch, {(): 1.2, (A,): 0.5, (B,): 1.1})
    assert found == set() and {len(m.effects) for m in race.models.values()} == {0, 1}


def test_one_law_that_explains_all_stays_alone(monkeypatch):
    assert winner(monkeypatch, {(): 100, (A,): 1.0, (B,): 60})[0] == {A}


def test_of_two_that_explain_alike_the_one_with_fewer_numbers(monkeypatch):
    two = law("two", numbers=2)
    assert winner(monkeypatch, {(): 100, (two,): 0.9, (A,): 0.95})[0] == {A}


def test_a_law_that_closes_too_little_is_not_named(monkeypatch):
    """5 % of the gap for the first, 15 % of what is left for a further one."""
    assert winner(monkeypatch, {(): 100, (A,): 96})[0] == set()
    assert winner(monkeypatch, {(): 100, (A,): 50, (A, B): 44})[0] == {A}
    assert winner(monkeypatch, {(): 100, (A,): 50, (A, B): 30})[0] == {A, B}


def test_laws_that_help_only_together_are_found_by_pairs(monkeypatch):
    assert winner(monkeypatch, {(): 100, (A,): 90, (B,): 95, (C,): 40, (A, B): 1.0})[0] == {A, B}


def test_what_a_later_law_makes_superfluous_is_dropped(monkeypatch):
    """Only the two best singles are paired: c comes last, and then a is idle."""
    errors = {(): 100, (A,): 40, (B,): 60, (C,): 70, (A, B): 20, (B, C): 1.0}
    assert winner(monkeypatch, errors, pairs=2)[0] == {B, C}


def test_far_above_the_noise_a_law_that_stands_in_for_two_is_left_out(monkeypatch):
    errors = {(): 100, (X,): 30, (A,): 60, (B,): 95, (A, B): 1.0}
    assert winner(monkeypatch, errors, pairs=2)[0] == {A, B}


def test_no_more_laws_than_allowed(monkeypatch):
    errors = {(): 100, (A,): 60, (A, B): 30, (A, B, C): 10}
    assert winner(monkeypatch, errors)[0] == {A, B, C}
    assert winner(monkeypatch, errors, most=2)[0] == {A, B}


@pytest.mark.parametrize(
    ("bare", "special", "named"),
    [(100, 1.05, "coulomb_friction"), (100, 10.0, "asymmetric_friction"), (20, 2.8, "asymmetric_friction")],
)
def test_a_law_gives_way_to_its_special_case_where_that_closes_nearly_as_much(monkeypatch, bare, special, named):
    general, case = law("asymmetric_friction", numbers=2), law("coulomb_friction")
    table = Table(monkeypatch, {(): bare, (general,): 1.0, (case,): special})
    race = table.tried()
    found = search.simplest(race, table.model((general,)), silent)
    assert [e.effect for e in found.effects] == [named]


def test_special_cases_lie_at_the_same_place_and_fit_beside_the_others(monkeypatch):
    general, case, elsewhere = law("asymmetric_friction"), law("coulomb_friction"), law("coulomb_friction", "wrist")
    table = Table(monkeypatch, {(): 100, (general,): 1.0, (case,): 1.0, (elsewhere,): 1.0})
    assert search.parts_of(table.race, table.model((general,)), general) == [case]
    tied = law("coulomb_friction", "all", places=("hinge", "wrist"))
    assert search.parts_of(table.race, table.model((general, tied)), general) == []
