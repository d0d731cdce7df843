"""A set of effects is no worse than its subsets: with the further effects neutral it is each of them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.evidence.selecting import none_worse
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.selection import search_state
from bayessim_mjx.diagnosis.selection.models import BASE, scored
from bayessim_mjx.diagnosis.selection.numbers import Budget
from bayessim_mjx.diagnosis.selection.search_state import SearchState, Settings
from bayessim_mjx.diagnosis.statistics import shapley
from tests.diagnosis.rigid import Rigid
from tests.diagnosis.selection.test_refitted import GROUP, Windows

A, B = frozenset({"a"}), frozenset({"b"})
MOTIONS = np.random.default_rng(1).normal(size=(3, 8, 20))  # of the known parameter and of two effects
TRUE = np.array([0.5, 0.4, 0.3])


class Straight(Rigid):
    """Windows whose error is linear in a known parameter and in two effects."""

    def __init__(self):
        self.physics, self.windows, self.rollouts = None, Windows(), 0
        self.noise = 0.01 * np.random.default_rng(0).normal(size=(len(GROUP), 20))

    def run(self, thetas, offsets, own=None):
        own = np.arange(len(GROUP)) if own is None else own
        error = np.einsum("tk,kwn->twn", TRUE - np.asarray(thetas)[:, :3], MOTIONS[:, own]) + self.noise[own]
        error = error - offsets[..., 0, None]
        return np.stack([error, np.zeros_like(error)], -1)


def coordinate(i, name):
    return Coordinate(name, (i,), 0.0, -5.0, 5.0, unit="N m")


def effect(i, label):
    return SimpleNamespace(label=label, coordinates=(coordinate(i, f"{label}.amount"),))


@pytest.fixture
def state(monkeypatch):
    """Fits with an effect rest far off in the known parameter, and have three times the error of those without."""
    monkeypatch.setattr(search_state, "contacts", lambda physics: False)
    fitter = Fitter(Straight(), (coordinate(0, "known"),), np.zeros(3))

    def at(*values, effects=()):
        coordinates = (*fitter.base, *(c for e in effects for c in e.coordinates))
        return scored(fitter, fitter.begin(coordinates, np.array(values)), effects)

    base = at(TRUE[0])
    effects = effect(1, "a"), effect(2, "b")
    out = SearchState(fitter, effects, Settings(), base.fit, base)
    out.models[BASE] = base
    for own in effects:
        out.models[frozenset({own.label})] = replace(at(-3.0, 0.1, effects=(own,)), cost=3.0 * base.cost)
    return out


def shares(found):
    """Of the gap that both effects close together; together they close all of it."""
    cost = {0: found[BASE].cost, 1: found[A].cost, 2: found[B].cost, 3: 0.0 * found[BASE].cost}
    return shapley(2, lambda some: cost[0] - cost[sum(i + 1 for i in some)]).sum(1) / cost[0].sum()


def test_a_set_with_a_larger_error_than_a_subset_is_fitted_again_from_there(state):
    found = none_worse(state, [BASE, A, B], lambda *progress: None)
    assert found[BASE] is state.base
    for key, true in ((A, TRUE[1]), (B, TRUE[2])):
        assert found[key] is state.models[key] and found[key].total < 0.9 * state.base.total
        assert found[key].fit.values == pytest.approx([TRUE[0], true], abs=0.1)
    assert shares(found).min() > 0.2


def test_no_share_is_below_none_where_one_set_alone_has_a_larger_error(state):
    """Of two effects that together close everything, one alone trebled the error: its share was less than nothing."""
    state.models[B] = replace(state.models[B], cost=0.3 * state.base.cost)
    assert shares(state.models)[0] < -0.5
    assert shares(none_worse(state, [BASE, A, B], lambda *progress: None)).min() > 0.1


def test_without_time_for_another_fit_the_subset_stands_for_it(state):
    state.settings = Settings(budget=Budget(10.0, 0.0, lambda: 100.0))
    found = none_worse(state, [BASE, A, B], lambda *progress: None)
    assert found[A] is state.base and found[B] is state.base
