"""Multiple shooting recovers what MuJoCo C at a tenth of the step was given."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting.fitter import weights
from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.selection.models import of_noise, scored
from bayessim_mjx.diagnosis.setup import prepare
from tests.diagnosis.pendulums import NAMES, fitted, nominal, recorded

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole diagnoses and fits

SCALE = (1.12, 0.9, 1.07)
FRICTION = 0.04


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    logs = recorded(scale=SCALE, sigma=1e-4)
    return fitted(prepare(nominal(tmp_path_factory.mktemp("clean")), logs, Request(["actuator_delay"])))


@pytest.fixture(scope="module")
def rubbing(tmp_path_factory):
    setup = prepare(nominal(tmp_path_factory.mktemp("dry")), recorded(friction=FRICTION), Request(["coulomb_friction"]))
    fitter, fit = fitted(setup)
    (candidate,) = setup.candidates
    new = fitter.derive(fit, candidate.coordinates, np.array([0.01, 0.0]))  # level, relaxation
    (new,) = fitter.iterate([new], 12, lambda f: range(len(f.coordinates)))
    return fitter, fit, fitter.refresh(new), candidate


def test_known_parameters_are_recovered(clean):
    _, fit = clean
    assert fit.names == tuple(n for n in fit.names if n.endswith(NAMES)) and len(fit.names) == 3
    found = {n: v for n, v in zip(fit.names, fit.values, strict=True)}
    for name, true in zip(NAMES, SCALE, strict=True):
        (value,) = [v for n, v in found.items() if n.endswith(name)]
        assert value == pytest.approx(true, rel=0.02), name


def test_the_right_model_is_left_with_noise(clean):
    fitter, fit = clean
    cost = np.mean(fit.r**2)
    assert 0.7 < cost < 1.1  # start states take some of it
    held, moves = fitter.scores(fit)
    assert held.shape == (len(fit.r),) and moves.shape == (8, 3)
    assert held.mean() / fitter.size == pytest.approx(1.0, abs=0.2)


def test_costs_of_accepted_steps_never_rise(clean):
    fitter, _ = clean
    start = fitter.begin(fitter.base)
    first = fitter.cost(start, start.r, start.offsets, start.values)
    (fit,) = fitter.iterate([start], 3, lambda f: range(3))
    assert start.history == () and np.array_equal(start.values, [c.neutral for c in fitter.base])  # a value: unchanged
    assert fit.cost <= min(fit.history) * (1 + 1e-12) and fit.cost < 0.1 * first


def test_columns_are_derivatives_of_the_residual(clean):
    """A step of 1 % moves the residual by minus column times step."""
    fitter, fit = clean
    moved = fit.values.copy()
    moved[0] += 0.01
    r = fitter.whiten(fitter.simulator.run(fitter.vector(fit.coordinates, moved)[None], fit.offsets[None]))[0]
    predicted = fit.r - 0.01 * fit.A[..., 0]
    assert np.linalg.norm(r - predicted) < 0.1 * np.linalg.norm(r - fit.r)


def test_a_level_of_dry_friction_is_recovered(rubbing):
    fitter, base, fit, candidate = rubbing
    level = fit.values[-2]
    assert level == pytest.approx(FRICTION, rel=0.05)
    assert fit.values[:3] == pytest.approx([1, 1, 1], rel=0.1)
    assert fit.cost < 0.5 * base.cost
    model = scored(fitter, fit, (candidate,))
    assert model.total < 0.5 * scored(fitter, base, ()).total
    assert abs(level - FRICTION) < 4 * of_noise(fitter, model)[-2, -2] ** 0.5 + 0.02 * FRICTION
    assert model.values_of(candidate) == pytest.approx(fit.values[-2:])


def test_windows_far_worse_than_the_rest_count_less(rubbing):
    r = rubbing[2].r / np.sqrt(np.mean(rubbing[2].r ** 2, 1, keepdims=True))
    assert weights(r) == pytest.approx(np.ones(len(r)))
    r[3] *= 40.0
    found = weights(r)
    assert found[3] == pytest.approx(0.1, rel=1e-6) and np.delete(found, 3) == pytest.approx(np.ones(len(r) - 1))


def test_columns_of_steps_that_are_refused_are_not_simulated_on_a_cpu(rubbing, monkeypatch):
    """An accelerator simulates them in one call with the trial; the fits are the same."""
    fitter, base, _, candidate = rubbing
    start = fitter.derive(base, candidate.coordinates, np.array([0.4, 0.0]))
    fits, spent = [], []
    for apart in (False, True):
        monkeypatch.setattr(fitter.simulator, "apart", apart)
        before = fitter.simulator.rollouts
        fits += fitter.iterate([start], 12, lambda f: [len(f.coordinates) - 2])
        spent.append(fitter.simulator.rollouts - before)
    together, one_by_one = fits
    assert one_by_one.history == together.history and len(set(together.history)) < len(together.history)  # some refused
    np.testing.assert_array_equal(one_by_one.values, together.values)
    np.testing.assert_array_equal(one_by_one.A, together.A)
    assert spent[1] < spent[0]


def test_numbers_that_do_the_same_have_the_same_column(tmp_path):
    """A joint's damping and viscous friction, near friction that sticks: steps of one change tell nothing apart."""
    effects = ["coulomb_friction", "viscous_friction"]
    setup = prepare(nominal(tmp_path), recorded(friction=FRICTION, count=4), Request(effects))
    fitter, fit = fitted(setup)

    def apart(fit):
        A, names = fit.A, fit.names
        own, other = next(i for i, n in enumerate(names) if n.endswith(NAMES[0])), len(names) - 1
        a, b = A[..., own].ravel(), A[..., other].ravel()
        return float(np.linalg.norm(a - b * (a @ b) / (b @ b)) / np.linalg.norm(a))

    sizes = []
    for level in (0.02, 0.03, 0.04, 0.05):  # friction is rough: near another point a column differs by as much again
        at = fit
        for candidate, value in zip(setup.candidates, (level, 0.01), strict=True):
            at = fitter.derive(at, candidate.coordinates, np.array([value, 0.0])[: len(candidate.coordinates)])
        first = fitter.refresh(at)  # at steps by their ranges
        sizes.append((apart(first), apart(fitter.refresh(first))))
    by_range, by_change = np.median(sizes, axis=0)
    assert by_change < min(0.015, by_range / 2), sizes
