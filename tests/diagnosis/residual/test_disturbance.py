"""The missing force is recovered where it is known: a push, friction, nothing; columns against the simulator itself."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis.evidence.gaussian import node_basis
from bayessim_mjx.diagnosis.residual import disturbance as d
from tests.diagnosis.missing_forces import fitted, known, record

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole diagnoses and fits


@pytest.fixture(scope="module")
def pushed():
    fitter, fit = fitted(record(force=lambda t, data: np.array([0.08])))
    return fitter, fit, d.estimate(fitter, fit)


def test_nodes_share_out_every_step():
    for steps, nodes in ((25, 25), (25, 6), (50, 12)):
        basis = node_basis(steps, nodes)
        np.testing.assert_allclose(basis.sum(1), 1.0)
        assert basis.shape == (steps, nodes) and basis.min() >= 0
    np.testing.assert_allclose(node_basis(4, 4), np.eye(4))


def test_columns_predict_what_the_simulator_does_under_a_force(pushed):
    fitter, fit, found = pushed
    rng = np.random.default_rng(0)
    small = 0.02 * rng.standard_normal(found.flat.shape)
    nodes = np.swapaxes(small.reshape(len(small), 1, -1), 1, 2)
    force = np.einsum("hm,wmv->whv", found.linear.basis, nodes)
    theta = fitter.vector(fit.coordinates, fit.values)
    moved = fit.r - fitter.whiten(fitter.simulator.run(theta[None], fit.offsets[None], force=force[None]))[0]
    predicted = np.einsum("wnd,wd->wn", found.linear.D, small)
    assert np.sqrt(np.mean((moved - predicted) ** 2)) < 0.02 * np.sqrt(np.mean(moved**2))


def test_a_constant_push_is_recovered(pushed):
    _, _, found = pushed
    # N m, constant in time: the mean force and the mean of what each window shows
    assert d.pooled(found.force[..., 0], found.reliability[..., 0]) == pytest.approx(0.08, rel=0.05)


def test_the_parameters_are_right_once_the_force_is_there(pushed):
    fitter, fit, found = pushed
    # damping, armature, mass: truth 1.06, 1, 1.06 times nominal; the fit without the force is further off
    truth = np.array([1.06, 1.0, 1.06])
    assert np.abs(found.values - truth).max() < 0.02
    assert np.abs(found.values - truth).max() < np.abs(fit.values - truth).max()


def test_friction_is_recovered_as_a_force_against_the_motion():
    fitter, fit = known(record(friction=(0.05, 0.0), wrong=1.0))
    found = d.estimate(fitter, fit)
    speed = np.asarray(fitter.simulator.windows.batch.qvel)[..., 0]
    fast = np.abs(speed) > 0.5  # rad/s
    against = -found.force[..., 0] * np.sign(speed)
    assert d.pooled(against[fast], found.reliability[..., 0][fast]) == pytest.approx(0.05, rel=0.1)


def test_nothing_is_found_where_nothing_is_missing():
    fitter, fit = fitted(record())
    found = d.estimate(fitter, fit)
    # N m; the drive's efforts are a few N m
    assert np.sqrt(np.mean(found.force**2)) < 2e-3


def test_a_force_is_found_at_the_joint_where_it_acts():
    fitter, fit = fitted(record(joints=2, friction=(0.0, 0.05)))
    found = d.estimate(fitter, fit, d.linearise(fitter, fit, knots=12))
    assert found.force.shape == (len(fitter.simulator.windows), 12, 2)
    power = np.mean((found.force / found.linear.scale) ** 2, axis=(0, 1))
    assert power[1] > 4 * power[0]
