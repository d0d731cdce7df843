"""Parts of what a fitted model leaves, against closed forms: no simulation."""

from types import SimpleNamespace

import numpy as np

from bayessim_mjx.diagnosis.fitting.quadratic import Quadratic
from bayessim_mjx.diagnosis.residual.disturbance import _white
from bayessim_mjx.diagnosis.residual.where import explained


def test_joints_shares_add_up_to_what_all_forces_together_close() -> None:
    """The cost c - 2 g'p + p'S p without the forces, less the cost with them, at the parameters found with them."""
    rng = np.random.default_rng(0)
    windows, known, joints, nodes = 5, 2, 3, 4
    size = known + joints * nodes
    root = rng.normal(size=(windows, size, size))
    q = Quadratic(rng.uniform(50, 60, windows), rng.normal(size=(windows, size)), root @ root.mT)
    values, start = rng.normal(size=known), rng.normal(size=known)
    flat, weight = rng.normal(size=(windows, joints * nodes)), rng.uniform(0.5, 1.0, windows)
    fit = SimpleNamespace(A=np.zeros((windows, 1, known)), values=start, weight=weight)
    force = SimpleNamespace(shape=(windows, nodes, joints))
    found = explained(fit, SimpleNamespace(linear=SimpleNamespace(quadratic=q), values=values, flat=flat, force=force))
    step = np.tile(values - start, (windows, 1))
    without, by = q.at(np.hstack([step, 0 * flat])), q.at(np.hstack([step, flat]))
    assert found.shape == (windows, joints)
    np.testing.assert_allclose(found.sum(1), weight * (without - by), rtol=1e-9)


def test_white_noise_has_the_variance_that_it_has() -> None:
    """Second differences of white noise have six times its variance."""
    sd = np.array([1.0, 3.0])
    r = sd * np.random.default_rng(0).normal(size=(200, 60, 2))
    even, clock = _white(r, np.zeros_like(r))
    np.testing.assert_allclose(even, sd**2, rtol=0.05)
    np.testing.assert_array_equal(clock, 0 * r)
