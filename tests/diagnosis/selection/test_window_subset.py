"""Candidates are ranked on some windows; those that are close go on with all of them, to the same values."""

import dataclasses

import numpy as np
import pytest

from bayessim_mjx.diagnosis.selection import successive_halving as fitting
from bayessim_mjx.diagnosis.selection.models import scored
from tests.diagnosis.selection.test_bounds import pool_of, silent


def fitted(true=0.4, starts=(0.9, 0.1, 0.6)):
    """(the pool's toy effect fitted from several starts, windows simulated for it)."""
    pool, model = pool_of(true)
    effect, simulator = model.effects[0], pool.fitter.simulator
    simulator.physics.template = None
    fits = [pool.fitter.derive(pool.base.fit, effect.coordinates, np.array([s])) for s in starts]
    before = simulator.rollouts
    fitting.fit_entries(pool, {frozenset([effect.label]): (fits, (effect,))}, "single effects", silent)
    return pool.models[frozenset([effect.label])], simulator.rollouts - before


def test_fits_on_some_windows_come_to_those_on_all_of_them(monkeypatch):
    whole, many = fitted()
    monkeypatch.setattr(fitting, "EFFORT", dataclasses.replace(fitting.EFFORT, windows=4))
    some, fewer = fitted()
    assert fewer < 0.8 * many
    assert some.fit.values == pytest.approx(whole.fit.values, abs=1e-4)
    assert some.total == pytest.approx(whole.total, rel=1e-3) and some.fit.r.shape == whole.fit.r.shape


def test_what_gains_less_than_its_prior_odds_on_some_windows_is_no_model(monkeypatch):
    monkeypatch.setattr(fitting, "EFFORT", dataclasses.replace(fitting.EFFORT, windows=4))
    kept = {}
    for true in (0.0, 0.4):  # without the effect, and with it
        pool, model = pool_of(true)
        effect, pool.fitter.simulator.physics.template = model.effects[0], None
        (base,) = pool.fitter.iterate([pool.base.fit], 10, lambda fit: ())
        pool.base, pool.candidates = scored(pool.fitter, base, ()), 100 * [effect]  # one of a hundred effects
        key, pool.models = frozenset([effect.label]), {frozenset(): pool.base}
        starts = [pool.fitter.derive(pool.base.fit, effect.coordinates, np.array([0.2]))]
        fitting.fit_entries(pool, {key: (starts, (effect,))}, "", silent, parents={key: pool.base})
        kept[true] = key in pool.models, key in pool.vain
    assert kept == {0.0: (False, True), 0.4: (True, False)}


def test_a_part_of_a_fit_and_back():
    pool, model = pool_of(0.4)
    own = np.array([1, 4])
    part = fitting.cut(model.fit, own)
    assert part.r.shape == (2, 20) and part.A.shape == (2, 20, 1) and part.offsets.shape == (2, 2)
    moved = dataclasses.replace(part, values=np.array([0.3]), offsets=np.ones((2, 2)))
    fit = fitting.back(model.fit, moved, own)
    assert fit.values[0] == 0.3 and fit.offsets[own].min() == 1.0 and len(fit.r) == 8
    assert np.array_equal(np.delete(fit.offsets, own, 0), np.delete(model.fit.offsets, own, 0))
    assert fitting.fitter_on(pool.fitter, own).whiten(np.zeros((2, 20, 2))).shape == (2, 20)
