"""Where models of more effects begin: over contacts at the measured start states, if a fit has left them."""

from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.selection import search_state
from bayessim_mjx.diagnosis.selection.search_state import SearchState

SPREAD = np.array([0.01, 0.1])


class Begun:
    """A fitter that tells what is asked of it."""

    spread, simulator = SPREAD, SimpleNamespace(physics=None)

    def __init__(self):
        self.asked = []

    def begin(self, coordinates, values):
        self.asked.append(values)
        return fit(values, np.zeros((4, 2)))


def fit(values, offsets):
    none = np.zeros(0)
    return Fit((), np.asarray(values), offsets, none, none, none, np.ones(4), 1.0, spread=SPREAD)


def begun(monkeypatch, offsets, contacts):
    monkeypatch.setattr(search_state, "contacts", lambda physics: contacts)
    fitter, given = Begun(), fit([1.0], offsets)
    own = SearchState(fitter, (), None, None, None, None)
    return own.begun(given), own.begun(given), given, fitter


@pytest.mark.parametrize(("far", "contacts"), [(0.5, True), (3.0, False)])
def test_near_the_measured_starts_or_without_contacts_it_is_the_fit_itself(monkeypatch, far, contacts):
    found, _, given, fitter = begun(monkeypatch, far * np.tile(SPREAD, (4, 1)), contacts)
    assert found is given and not fitter.asked


def test_starts_that_an_effect_was_missing_for_are_left_behind(monkeypatch):
    found, again, given, fitter = begun(monkeypatch, 3.0 * np.tile(SPREAD, (4, 1)), True)
    assert not found.offsets.any() and found.values is given.values
    assert again is found and len(fitter.asked) == 1
