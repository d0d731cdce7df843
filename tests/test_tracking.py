"""Prediction errors of a filter along a record: free simulation, textbook gains, and motion that is followed."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.kalman import Force, innovations, riccati
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.physics import Physics
from bayessim_mjx.rollout import replay
from bayessim_mjx.tracking import Record, close, errors, free, transitions

SLIDER = """<mujoco><option timestep=".01" gravity="0 0 0"/><worldbody><body name="cart">
  <joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="2"/></body></worldbody>
  <actuator><motor name="push" joint="x"/></actuator></mujoco>"""
STEPS, DT = 16, 0.02


@pytest.fixture(scope="module")
def slider():
    space = ParameterSpace(
        [Parameter("mass", 1.0, 0.5, 2.0, operation="scaling", attribute="mass", target="cart", kind="body")]
    )
    return Physics(mujoco.MjModel.from_xml_string(SLIDER), DT, space)


@pytest.fixture(scope="module")
def record():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(2, STEPS + 1, 1)), rng.normal(size=(2, STEPS + 1, 1)), rng.normal(size=(2, STEPS, 1))
    return Record(*(jnp.asarray(x, jnp.float32) for x in rows))


def test_without_gains_it_is_the_free_simulation(slider, record):
    thetas = np.array([[0.8], [1.0], [1.7]], np.float32)
    found = np.asarray(errors(slider, thetas, record, free(record, 1)))
    assert found.shape == (3, 2, 8)
    for m, theta in enumerate(thetas):
        motion = replay(slider, record.qpos[:, 0], record.qvel[:, 0], record.command, np.tile(theta, (2, 1)))
        gap = (record.qpos - motion["qpos"]) ** 2 + (record.qvel - motion["qvel"]) ** 2
        np.testing.assert_allclose(found[m].sum(-1), gap[:, 1:].sum((1, 2)), rtol=1e-4)


def test_error_dynamics_of_a_free_mass(slider, record):
    ways, gaps = transitions(slider, np.array([1.0]), record, close(record, 1), np.ones(2))
    np.testing.assert_allclose(ways, np.broadcast_to([[1.0, DT], [0.0, 1.0]], ways.shape), atol=2e-4)
    # semi-implicit Euler of two sub-steps from the measured state: v += dt u / m, x += h (v1 + v2)
    q, v, u = (np.asarray(x)[..., 0] for x in (record.qpos, record.qvel, record.command))
    pushed = u / 2.0 * DT
    np.testing.assert_allclose(gaps[..., 1], v[:, 1:] - v[:, :-1] - pushed, atol=2e-5)
    np.testing.assert_allclose(gaps[..., 0], q[:, 1:] - q[:, :-1] - DT * v[:, :-1] - 0.75 * DT * pushed, atol=2e-5)


def test_gains_of_a_random_walk_become_the_textbook_ones():
    # x a random walk of q, measured with r = 1: steady P- solves P-^2 = q^2 (P- + r^2), K = P- / (P- + r^2)
    q, count = 0.5, 60
    gains = riccati(np.eye(2)[None, None].repeat(count, 1), np.ones(2), np.full(2, q), np.ones(2))
    ahead = (q**2 + np.sqrt(q**4 + 4 * q**2)) / 2
    assert float(gains.gain[0, -1, 0, 0]) == pytest.approx(ahead / (ahead + 1), rel=1e-5)
    assert float(gains.whitener[0, -1, 0, 0]) == pytest.approx((ahead + 1) ** -0.5, rel=1e-5)
    assert float(gains.log_size[0, -1]) == pytest.approx(-np.log(ahead + 1), rel=1e-5)
    still = riccati(np.eye(2)[None, None].repeat(count, 1), np.ones(2), np.zeros(2), np.ones(2))
    np.testing.assert_allclose(still.gain[0, :, 0, 0], 1 / (2 + np.arange(count)), rtol=1e-5)  # the mean so far


def test_a_force_that_lasts_is_followed():
    """A constant force: the filter's estimate becomes the velocity that it gives in a step, and no error is left."""
    ways = np.broadcast_to([[1.0, 0.1], [0.0, 1.0]], (1, 200, 2, 2))
    gains = riccati(ways, np.full(2, 0.01), np.zeros(2), np.full(2, 0.01), Force(np.array([0.5]), 0.99, 0.1))
    state, known, force = np.zeros(2), np.zeros(2), 0.0
    for t in range(200):
        state = ways[0, 0] @ state + np.array([0.5 * 0.1, 1.0]) * 0.2
        known = ways[0, 0] @ known + np.array([0.5 * 0.1, 1.0]) * force
        gap = state - known
        by = np.asarray(gains.gain[0, t], float) @ gap
        known, force = known + by[:2], 0.99 * force + by[2]
    assert force == pytest.approx(0.2, rel=0.03) and np.abs(gap).max() < 0.01


def test_where_motion_is_linear_the_path_does_not_matter(slider, record):
    theta, scale = np.array([1.0]), np.ones(2)
    near = close(record, 1)
    ways, gaps = transitions(slider, theta, record, near, scale)
    lasting = riccati(ways, np.full(2, 0.5), np.zeros(2), np.full(2, 0.5), Force(np.array([0.3]), 0.9, DT))
    along, own = transitions(slider, theta, record, lasting, scale)
    expected = np.einsum("ntij,ntj->nti", np.asarray(lasting.whitener, float), own)
    np.testing.assert_allclose(innovations(ways, gaps, near, lasting, DT), expected, atol=2e-3)
    np.testing.assert_allclose(innovations(along, own, lasting, lasting, DT), expected, atol=2e-3)
    free_ = free(record, 1)
    np.testing.assert_allclose(
        innovations(along, own, lasting, free_, DT), innovations(ways, gaps, near, free_, DT), atol=5e-3
    )


def test_what_is_not_measured_is_not_used():
    ways = np.broadcast_to([[1.0, 0.1], [0.0, 1.0]], (1, 50, 2, 2))
    gains = riccati(ways, np.array([0.1, np.inf]), np.array([0.0, 0.3]), np.array([0.1, 5.0]))
    assert gains.gain.shape == (1, 50, 3, 2)
    assert not np.asarray(gains.gain)[..., 1].any() and not np.asarray(gains.whitener)[..., 1, :].any()
    assert float(gains.gain[0, -1, 1, 0]) > 0.5  # the speed is learnt from positions
