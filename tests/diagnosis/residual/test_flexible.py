"""The flexible force finds what no effect names, says what it depends on, and nothing where nothing is missing."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis.phrases.residual import flexible, flexible_of
from bayessim_mjx.diagnosis.residual import black_boxes as f
from tests.diagnosis.missing_forces import fitted, record

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole diagnoses and fits


def hysteresis(t, data):
    """Friction that grows with the angle; not in the library."""
    return np.array([-0.06 * (1 + 0.9 * np.cos(3 * data.qpos[0])) * np.tanh(data.qvel[0] / 0.02)])


def coupling(t, data):
    """The elbow's drive leaks into the shoulder."""
    return np.array([0.15 * np.tanh(data.ctrl[1]), 0.0])


def solved(**case):
    fitter, fit = fitted(record(**case))
    return fitter, fit, f.flexible(fitter, fit)


@pytest.fixture(scope="module")
def outside():
    return solved(force=hysteresis)


def test_an_effect_outside_of_the_library_is_found_on_other_conditions(outside):
    fitter, fit, found = outside
    for held in (found.condition, found.interpolation):
        assert held.significant
        assert held.cost.shape == held.base.shape == (len(fitter.simulator.windows),)
        # the gap above the noise, squared
        assert held.cost.sum() - fit.r.size < 0.05 * (held.base.sum() - fit.r.size)


def test_all_seeds_and_ridges_are_reported(outside):
    _, _, found = outside
    assert found.condition.totals.shape == (5, len(f.RIDGES))
    assert len(found.condition.totals) == 5
    assert found.condition.cost.sum() == pytest.approx(np.median(found.condition.totals.min(1)), rel=0.5)


def test_it_says_that_it_depends_on_the_direction_of_motion(outside):
    _, _, found = outside
    assert {d["quantity"] for d in found.depends_on[:2]} == {"direction", "speed"}
    assert "direction of motion" in " ".join(flexible(flexible_of(found, "recalibrated")))
    assert found.where["shoulder"] > 0.8  # the rest is gained by parameters that are better with the force


def test_nothing_more_than_noise_where_nothing_is_missing():
    _, fit, found = solved()
    for held in (found.condition, found.interpolation):
        assert held.base.sum() < 1.15 * fit.r.size  # noise alone, to begin with
        assert held.cost.sum() > 0.85 * fit.r.size  # noise is not explained
        assert abs(held.gain) < 0.2 * fit.r.size
    first, *_ = flexible(flexible_of(found, "recalibrated"))
    assert "noise" in first or "nothing" in first


def test_irreproducible_pushes_are_not_explained():
    rng = np.random.default_rng(3)
    pushes = 0.1 * rng.standard_normal(10_000)

    def random(t, data):
        random.calls += 1
        return np.array([pushes[random.calls // 1000]])  # changes every 0.2 s, never the same again

    random.calls = 0
    _, fit, found = solved(force=random)
    assert found.condition.base.sum() > 20 * fit.r.size
    assert not found.condition.significant
    assert found.condition.gain < 0.2 * found.condition.base.sum()


def test_a_coupling_between_joints_is_found_where_it_acts():
    _, _, found = solved(joints=2, force=coupling)
    assert found.condition.significant
    assert found.where["shoulder"] > found.where["elbow"]
    assert found.condition.cost.sum() < 0.6 * found.condition.base.sum()
    assert "elbow effort" in [d["input"] for d in found.depends_on[:6]]


def test_blocks_hold_out_times_within_every_log():
    log = np.repeat([0, 1], 8)
    start = np.tile(np.arange(8) * 25, 2)
    fold = f.blocks(log, start, 25)
    assert [len(set(fold[own])) for own in (slice(8), slice(8, 16))] == [4, 4]
    assert fold[0] == fold[1] != fold[2] and fold[0] != fold[8]
