"""Multiple shooting recovers what MuJoCo C at a tenth of the step was given."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting.fitter import weights
from bayessim_mjx.diagnosis.selection.models import scored
from bayessim_mjx.diagnosis.selection.uncertainty import deviations
from bayessim_mjx.diagnosis.setup import prepare
from tests.diagnosis.pendulums import NAMES, fitted, nominal, recorded

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole diagnoses and fits

SCALE = (1.12, 0.9, 1.07)
FRICTION = 0.04


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    logs = recorded(scale=SCALE, sigma=1e-4)
    return fitted(prepare(nominal(tmp_path_factory.mktemp("clean")), logs, ["actuator_delay"]))


@pytest.fixture(scope="module")
def rubbing(tmp_path_factory):
    setup = prepare(nominal(tmp_path_factory.mktemp("dry")), recorded(friction=FRICTION), ["coulomb_friction"])
    fitter, job = fitted(setup)
    (candidate,) = setup.candidates
    new = fitter.derive(job, candidate.coordinates, np.array([0.01]))
    fitter.iterate([new], 12, lambda j: range(len(j.coordinates)))
    return fitter, job, fitter.refresh(new), candidate


def test_known_parameters_are_recovered(clean):
    _, job = clean
    assert job.names == tuple(n for n in job.names if n.endswith(NAMES)) and len(job.names) == 3
    found = {n: v for n, v in zip(job.names, job.values, strict=True)}
    for name, true in zip(NAMES, SCALE, strict=True):
        (value,) = [v for n, v in found.items() if n.endswith(name)]
        assert value == pytest.approx(true, rel=0.02), name


def test_the_right_model_is_left_with_noise(clean):
    fitter, job = clean
    cost = np.mean(job.r**2)
    assert 0.7 < cost < 1.1  # start states take some of it
    held, moves = fitter.scores(job)
    assert held.shape == (len(job.r),) and moves.shape == (8, 3)
    assert held.mean() / fitter.size == pytest.approx(1.0, abs=0.2)


def test_costs_of_accepted_steps_never_rise(clean):
    fitter, _ = clean
    job = fitter.begin(fitter.base)
    first = fitter.cost(job, job.r, job.offsets, job.values)
    fitter.iterate([job], 3, lambda j: range(3))
    assert job.cost <= min(job.history) * (1 + 1e-12) and job.cost < 0.1 * first


def test_columns_are_derivatives_of_the_residual(clean):
    """A step of 1 % moves the residual by minus column times step."""
    fitter, job = clean
    moved = job.values.copy()
    moved[0] += 0.01
    r = fitter.whiten(fitter.simulator.run(fitter.vector(job.coordinates, moved)[None], job.offsets[None]))[0]
    predicted = job.r - 0.01 * job.A[..., 0]
    assert np.linalg.norm(r - predicted) < 0.1 * np.linalg.norm(r - job.r)


def test_a_level_of_dry_friction_is_recovered(rubbing):
    fitter, base, job, candidate = rubbing
    assert job.values[-1] == pytest.approx(FRICTION, rel=0.05)
    assert job.values[:3] == pytest.approx([1, 1, 1], rel=0.1)
    assert job.cost < 0.5 * base.cost
    model = scored(fitter, job, (candidate,))
    assert model.total < 0.5 * scored(fitter, base, ()).total
    assert abs(job.values[-1] - FRICTION) < 4 * deviations(fitter, model)[-1] + 0.02 * FRICTION
    assert model.values_of(candidate) == pytest.approx([job.values[-1]])


def test_windows_far_worse_than_the_rest_count_less(rubbing):
    fitter, _, job, _ = rubbing
    job = fitter.derive(job, (), np.zeros(0))
    job.r = job.r / np.sqrt(np.mean(job.r**2, 1, keepdims=True))
    assert weights(job) == pytest.approx(np.ones(len(job.r)))
    job.r[3] *= 40.0
    found = weights(job)
    assert found[3] == pytest.approx(0.1, rel=1e-6) and np.delete(found, 3) == pytest.approx(np.ones(len(job.r) - 1))
