"""Findings about the place of known missing forces: joint, region, significance, fingerprints, sentences."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.phrases.residual import located as located_in_words
from bayessim_mjx.diagnosis.phrases.residual import places as places_of
from bayessim_mjx.diagnosis.residual import disturbance, motion_inputs, regions, where
from bayessim_mjx.diagnosis.residual.where import fingerprints
from tests.diagnosis.missing_forces import fitted, known, record

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole diagnoses and fits


def located(**case):
    fitter, fit = fitted(record(**case))
    return fitter, fit, disturbance.estimate(fitter, fit)


@pytest.fixture(scope="module")
def elbow():
    return located(joints=2, friction=(0.0, 0.05))


@pytest.fixture(scope="module")
def backward():
    """A force of 0.06 N m against the motion, only below zero rad."""
    logs = record(force=lambda t, d: np.array([-0.06 * np.tanh(d.qvel[0] / 0.02) * (d.qpos[0] < 0)]), wrong=1.0)
    fitter, fit = known(logs)
    return fitter, fit, disturbance.estimate(fitter, fit)


def prints(case, dof):
    fitter, fit, found = case
    windows = fitter.simulator.windows
    inputs = motion_inputs.measured(windows, fitter.simulator.physics.mj_model)
    node = regions.nodes(found, inputs, dof)
    return {f.name: f for f in fingerprints(fitter, fit, inputs, dof, node)}


def test_the_joint_is_found(elbow):
    found = where.locate(*elbow)
    places, sentences = places_of(found), located_in_words(found)
    assert places[0].channel == "elbow"
    assert places[0].share > 0.9
    assert places[0].ci[0] <= places[0].share <= places[0].ci[1]
    assert places[0].ci[0] > 0.7
    assert sum(p.share for p in places) == pytest.approx(1.0)
    assert any("elbow" in s and "against the motion" in s for s in sentences)


def test_friction_shows_as_a_constant_against_the_motion(elbow):
    found = prints(elbow, 1)["odd and even in speed"].numbers
    assert found["constant"].value == pytest.approx(0.05, rel=0.1)  # N m
    assert found["constant"].low > 0.04
    assert abs(found["offset"].value) < 0.005


def test_maps_are_significant_over_direction_and_not_over_time(elbow):
    maps = where.locate(*elbow).maps
    assert {m["joint"] for m in maps} == {"elbow"}
    by_axis = {m["axis"]: m for m in maps}
    assert by_axis["direction"]["significant"] == [True, True]
    assert by_axis["direction"]["mean"][0] > 0.01 > -0.01 > by_axis["direction"]["mean"][1]
    assert sum(by_axis["position"]["significant"]) <= 1
    for m in maps:
        assert len(m["edges"]) == len(m["mean"]) + 1 == len(m["significant"]) + 1
        assert all(low <= mean <= high for low, mean, high in zip(m["low"], m["mean"], m["high"], strict=True))


def test_the_region_of_a_force_is_told(backward):
    sentences = located_in_words(where.locate(*backward))
    assert "position below" in sentences[0] and "against the motion" in sentences[0]
    _, _, found = backward
    inputs = motion_inputs.measured(backward[0].simulator.windows, backward[0].simulator.physics.mj_model)
    leaf = regions.tree(regions.nodes(found, inputs, 0), backward[0].simulator.windows.group).leaves[0]
    axis, above, limit = leaf.where[0]
    assert (axis, above) == ("position", False) and abs(limit) < 0.1  # rad
    assert leaf.mean == pytest.approx(-0.06, rel=0.15)  # N m


def test_a_push_is_the_same_way_everywhere():
    case = located(force=lambda t, d: np.array([0.08]))
    found = where.locate(*case)
    places, sentences = places_of(found), located_in_words(found)
    assert places[0].region == "everywhere"
    assert sentences[0] == ("Without effects, a force is missing at shoulder: +0.08 N m (everywhere).")
    assert prints(case, 0)["odd and even in speed"].numbers["offset"].value == pytest.approx(0.08, rel=0.05)


def test_a_force_that_grows_in_time_shows_a_trend():
    found = prints(located(force=lambda t, d: np.array([0.02 * t])), 0)["time"].numbers["drift"]
    assert found.value == pytest.approx(0.02, rel=0.1)  # N m/s
    assert found.clear


def test_friction_that_grows_with_load_shows_in_its_slope():
    def loaded(t, d):
        weight = 0.53 * 9.81 * 0.2 * np.sin(d.qpos[0])  # N m
        return np.array([-(0.02 + 0.1 * abs(weight)) * np.tanh(d.qvel[0] / 0.02)])

    found = prints(located(force=loaded), 0)["load"].numbers["load"]
    assert found.value == pytest.approx(0.1, rel=0.25)
    assert found.clear


def test_within_the_noise_nothing_is_placed():
    found = where.locate(*located())
    assert (found.spots, found.maps) == ((), ())
    assert "noise" in located_in_words(found)[0] and places_of(found) == []


def test_discoveries_are_those_of_benjamini_and_hochberg():
    p = np.array([0.001, 0.008, 0.039, 0.041, 0.042, 0.06, 0.074, 0.205, 0.212, 0.216])
    assert regions.discoveries(p).tolist() == [True, True] + [False] * 8  # their table, rate 0.05
    assert not regions.discoveries(np.full(20, 0.2)).any()


def test_bins_without_a_pattern_are_rarely_significant():
    rng = np.random.default_rng(1)
    shape, hits = (40, 10), 0
    for _ in range(20):
        values = np.repeat(rng.standard_normal((40, 1)), 10, 1) + 0.3 * rng.standard_normal(shape)
        axes = {a: rng.standard_normal((40, 1)) + 0.3 * rng.standard_normal(shape) for a in regions.AXES}
        one = np.broadcast_to(np.eye(10), (40, 10, 10))
        node = regions.Nodes(values, one, axes, dict.fromkeys(axes, ""), "joint", "N m")
        _, p = regions.force_map(node, "position", statistics.leave_one_out(np.arange(40)))
        hits += regions.discoveries(p).any()
    assert hits <= 4
