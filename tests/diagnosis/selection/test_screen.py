"""Screening from one simulation per starting point: the true effect first, its gain foretold."""

import importlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting.candidates import Coordinate, _probes
from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.selection.numbers import EFFORT
from bayessim_mjx.diagnosis.selection.screen import screen
from bayessim_mjx.diagnosis.setup import prepare
from bayessim_mjx.effects.speed_torque_limit import SpeedTorqueLimit
from tests.diagnosis.pendulums import FEW, fitted, nominal, recorded, refit

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole diagnoses and fits

SCALE = (1.1, 1.08, 0.95)
TRUTHS: dict[str, dict[str, Any]] = {"coulomb_friction": {"friction": 0.03}, "actuator_delay": {"delay": 0.008}}


@pytest.fixture(scope="module")
def setup(tmp_path_factory):
    return prepare(nominal(tmp_path_factory.mktemp("screen")), recorded(scale=SCALE), Request(FEW))


@pytest.fixture(scope="module", params=TRUTHS)
def screened(request, setup):
    fitter, fit = refit(setup, recorded(scale=SCALE, **TRUTHS[request.param]))
    return request.param, setup, fitter, fit, screen(fitter, fit, setup.candidates)


def test_the_true_effect_gains_most(screened):
    truth, setup, _, _, found = screened
    assert {s.candidate.label for s in found} == {c.label for c in setup.candidates}
    assert found[0].candidate.effect == truth
    assert [s.gain for s in found] == sorted((s.gain for s in found), reverse=True)


def test_predicted_gains_are_realised(screened):
    _, _, fitter, fit, found = screened
    best = found[0]
    new = fitter.derive(fit, best.candidate.coordinates, best.start)
    (new,) = fitter.iterate([new], 10, lambda f: range(len(f.coordinates)))
    assert 0.5 < best.gain / (fit.cost - new.cost) < 2.0


def test_starts_lie_within_their_ranges_and_shares_are_shares(screened):
    *_, found = screened
    for s in found:
        bounds = [(c.low, c.high) for c in s.candidate.coordinates]
        assert all(low <= v <= high for v, (low, high) in zip(s.start, bounds, strict=True))
        assert s.gain >= 0 and -1e-6 <= s.absorbed <= 1 + 1e-6 and np.isfinite(s.column).all()


def test_what_the_known_parameters_already_do_is_absorbed(setup):
    fitter, fit = fitted(setup)
    found = {s.candidate.effect: s for s in screen(fitter, fit, setup.candidates)}
    assert found["viscous_friction"].absorbed > 0.95  # the same column as damping
    assert found["viscous_friction"].absorbed > found["coulomb_friction"].absorbed
    assert fitter.simulator.programs == 1


def test_the_point_that_explains_most_as_simulated_is_among_the_starts(screened):
    """A secant, scaled down, ends below a limit's threshold: what was really simulated has to be tried as it is."""
    _, _, fitter, fit, found = screened

    def reached(s, point):
        start = fitter.derive(fit, s.candidate.coordinates, point)
        (end,) = fitter.iterate([start], 4, lambda f: range(len(f.coordinates) - len(point)))  # the effect stays
        return end.cost

    true = found[0]
    best = min(reached(true, point) for point in true.candidate.probes)
    assert min(reached(true, point) for point in true.others) < 1.05 * best


def test_amplitudes_that_act_together_alone_are_tried_in_all_combinations():
    scales = {"force": 2.0, "speed": 10.0}
    first, second = (np.array(q.grid) * q.reach[1] for q in SpeedTorqueLimit.quantities)
    coordinates = [
        Coordinate(q.name, (i,), 0.0, 0.0, q.reach[1] / s)
        for i, (q, s) in enumerate(zip(SpeedTorqueLimit.quantities, scales.values(), strict=True))
    ]
    points = _probes(SpeedTorqueLimit("motor"), coordinates)
    pairs = {(round(a, 6), round(b, 6)) for a, b in points}
    assert pairs >= {(round(a / 2.0, 6), round(b / 10.0, 6)) for a in (0, *first) for b in (0, *second)} - {(0, 0)}


def test_no_candidates_no_answers(screened):
    _, _, fitter, fit, _ = screened
    assert screen(fitter, fit, []) == []


def test_where_time_ends_first_every_candidate_was_looked_at_before_any_a_second_time(screened, monkeypatch):
    """The middle of each grid comes first, then points far from it; with time for all the result is the same."""
    truth, setup, fitter, fit, whole = screened
    module = importlib.import_module("bayessim_mjx.diagnosis.selection.screen")
    each = max(fitter.simulator.lanes // len(fit.r), 1)
    count = len(setup.candidates)
    looks = -(-count // each) + 1  # parts, of which the last ones begin the second round
    for wanted in (looks, None):
        few = replace(EFFORT, sets=(1,)) if wanted else EFFORT  # of which one call simulates few
        monkeypatch.setattr(module, "EFFORT", few)
        secants, left = module.Secants(), iter(range(wanted or 10**6))
        found = screen(fitter, fit, setup.candidates, secants=secants, over=lambda left=left: next(left, None) is None)
        sizes = [len(secants.columns[c.label]) for c in setup.candidates]
        if wanted is None:
            assert sizes == [len(c.probes) for c in setup.candidates]
            assert [s.candidate.label for s in found] == [s.candidate.label for s in whole]
            assert found[0].gain == pytest.approx(whole[0].gain)
            continue
        assert min(sizes) == 1 and max(sizes) == 2 and len(found) == count
        for candidate in setup.candidates:
            first = secants.columns[candidate.label][0].point
            np.testing.assert_array_equal(first, candidate.probes[len(candidate.probes) // 2])


def test_candidates_are_simulated_at_all_points_only_at_the_places_that_gain_most(screened, monkeypatch):
    """With room for one place it is that of the truth, or one that does the same."""
    truth, setup, fitter, fit, whole = screened
    module = importlib.import_module("bayessim_mjx.diagnosis.selection.screen")
    monkeypatch.setattr(module, "EFFORT", replace(EFFORT, sets=(1,)))
    secants = module.Secants()
    found = screen(fitter, fit, setup.candidates, secants=secants)
    deep = {c.where for c in setup.candidates if len(secants.columns[c.label]) > 1}
    assert deep == {found[0].candidate.where} == {whole[0].candidate.where}
    assert len(found) == len(whole)


def test_what_was_simulated_on_one_fit_is_projected_on_another_without_a_simulation(screened):
    """On the fit that it was simulated on it tells the same."""
    truth, setup, fitter, fit, whole = screened
    module = importlib.import_module("bayessim_mjx.diagnosis.selection.screen")
    secants = module.Secants()
    first = screen(fitter, fit, setup.candidates, 96, secants=secants)
    assert [s.candidate.label for s in first] == [s.candidate.label for s in whole]
    assert {label: len(pairs) for label, pairs in secants.columns.items()} == {
        c.label: len(c.probes) for c in setup.candidates
    }
    before = fitter.simulator.rollouts
    found = screen(fitter, fit, setup.candidates, 24, secants=secants)
    assert fitter.simulator.rollouts == before
    assert [(s.candidate.label, s.gain) for s in found] == [(s.candidate.label, s.gain) for s in first]
