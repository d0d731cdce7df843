"""What models that were tried leave and close."""

from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.search_state import SearchState, Settings


def candidate(effect, where):
    return SimpleNamespace(effect=effect, where=where, label=f"{effect}@{where}", coordinates=())


@pytest.mark.parametrize(("rms", "believed", "goes_on"), [(1.2, 1.0, False), (1.4, 1.0, True), (1.2, 0.4, True)])
def test_effects_are_added_until_the_sensors_noise_is_reached(rms, believed, goes_on):
    """Where most of what counts as noise is what the time step may be worth, a model with effects can do better."""
    cost = np.full(8, 50.0 * rms**2)
    bare = SimpleNamespace(effects=(), cost=cost, total=cost.sum())
    model = SimpleNamespace(effects=(candidate("payload", "link"),), cost=cost, total=cost.sum())
    tried = SearchState(SimpleNamespace(size=50.0), [], Settings(believed=believed), None, bare)
    assert tried.above_noise(model) is goes_on
    assert tried.above_noise(bare) is (rms > 1.3)


def test_what_is_closed_is_counted_from_the_noise_not_from_the_best_model_tried():
    fitter = SimpleNamespace(size=50.0)
    base, best, lucky, half = (
        Model((), SimpleNamespace(coordinates=()), np.full(8, 50.0 * t), np.full(8, 50.0 * t), np.zeros((8, 0)), 1e4)
        for t in (5, 1, 0.8, 3)
    )
    pool = SearchState(fitter, [], Settings(), None, base)
    assert pool.gap(best).closed == pool.gap(lucky).closed == 1.0 and pool.gap(base).closed == 0.0
    assert pool.gap(half).closed == pool.gap(half).left == pytest.approx(0.5)
