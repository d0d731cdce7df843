"""Start states drawn to their mean by the share of the noise in their spread."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.loop.likelihood import Likelihood
from bayessim_mjx.loop.noise import Starts
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.physics import Physics
from bayessim_mjx.rollout import replay
from bayessim_mjx.tracking import Record

CART = """<mujoco><option timestep=".05" gravity="0 0 0"/><worldbody><body name="cart">
  <joint name="x" type="slide" axis="1 0 0" damping="1"/><geom size=".1" mass="1"/></body></worldbody></mujoco>"""
FREE = """<mujoco><worldbody><body name="b"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""
MODEL = mujoco.MjModel.from_xml_string(CART)
NOISE = 0.1


def measured(spread, count, seed=0):
    """True starts [count, 2] and their records."""
    rng = np.random.default_rng(seed)
    true = np.array([1.0, -2.0]) + spread * rng.normal(size=(count, 2))
    seen = true + NOISE * rng.normal(size=(count, 2))
    return true, record(seen[:, :1], seen[:, 1:])


def record(qpos, qvel):
    rows = (jnp.asarray(np.repeat(x[:, None], 3, axis=1), jnp.float32) for x in (qpos, qvel))
    return Record(*rows, jnp.zeros((len(qpos), 2, 0)))


def states(r):
    return np.concatenate([np.asarray(r.qpos[:, 0]), np.asarray(r.qvel[:, 0])], axis=1)


def test_the_share_of_noise_by_hand():
    starts = Starts(record(np.array([[0.0], [2.0], [4.0], [2.0]]), np.zeros((4, 1))), MODEL)
    # squares about the mean: 4 + 0 + 4 + 0; one start more than tells nothing: 1 * .5^2 / 8
    np.testing.assert_allclose(starts.share(np.array([0.5, 0.5])), [0.03125, 1.0])
    np.testing.assert_allclose(states(starts.shrunk(np.array([0.5, 0.5])))[:, 0], [0.0625, 2.0, 3.9375, 2.0])
    # Morris: 1 - B (N - 1) / N, and 2 B / N for B that is estimated
    np.testing.assert_allclose(
        starts.sd(np.array([0.5, np.inf]))[0], 0.5 * np.sqrt(1 - 0.03125 * 3 / 4 + 2 * 0.03125 / 4)
    )


@pytest.mark.parametrize("spread", [0.0, 0.1, 0.5])
def test_starts_are_known_as_well_as_is_said(spread):
    errors, told = [], []
    for seed in range(200):
        true, seen = measured(spread, 16, seed)
        starts = Starts(seen, MODEL)
        errors.append(states(starts.shrunk(np.full(2, NOISE))) - true)
        told.append(starts.sd(np.full(2, NOISE)))
    error, said = np.sqrt(np.mean(np.square(errors))), np.sqrt(np.mean(np.square(told)))
    best = NOISE * spread / np.hypot(NOISE, spread)
    assert 0.9 < said / error < (1.1 if spread else 1.6)  # wary where all of the spread is noise
    assert 0.97 * best < error < NOISE and error < np.hypot(best, 0.5 * NOISE)


def test_what_is_left_unknown_of_a_start_has_nothing_to_do_with_where_it_is():
    """Else it would pass for damping. As measured the two go together by the variance of the noise."""
    true, seen = measured(0.2, 20_000)
    here, error = states(Starts(seen, MODEL).shrunk(np.full(2, NOISE))), states(seen) - true
    as_measured = np.mean(error * (states(seen) - states(seen).mean(0)), axis=0)
    np.testing.assert_allclose(as_measured, NOISE**2, rtol=0.1)
    np.testing.assert_allclose(np.mean((here - true) * (here - here.mean(0)), axis=0), 0, atol=5e-4)


def test_few_starts_and_channels_that_are_not_measured_stay_as_they_are():
    few = measured(0.1, 3)[1]
    np.testing.assert_array_equal(states(Starts(few, MODEL).shrunk(np.full(2, 9.0))), states(few))
    np.testing.assert_array_equal(Starts(few, MODEL).sd(np.full(2, 9.0)), 9.0)
    many = measured(0.1, 30)[1]
    shrunk = states(Starts(many, MODEL).shrunk(np.array([NOISE, np.inf])))
    np.testing.assert_array_equal(shrunk[:, 1], states(many)[:, 1])
    assert (shrunk[:, 0] != states(many)[:, 0]).all()


def test_rotations_are_drawn_along_their_tangents():
    angles = np.array([0.1, -0.1, 0.2, -0.2, 0.3, -0.3])
    quats = np.stack([np.cos(angles / 2), np.sin(angles / 2), 0 * angles, 0 * angles], axis=1)
    qpos = np.concatenate([np.arange(18.0).reshape(6, 3), quats], axis=1)
    sensor = np.concatenate([np.full(3, 1e-6), np.full(3, 1e3), np.full(6, np.inf)])
    starts = Starts(record(qpos, np.zeros((6, 6))), mujoco.MjModel.from_xml_string(FREE))
    shrunk = np.asarray(starts.shrunk(sensor).qpos[:, 0])
    np.testing.assert_allclose(shrunk[:, :3], qpos[:, :3], atol=1e-6)
    np.testing.assert_allclose(shrunk[:, 3:], [[1, 0, 0, 0]] * 6, atol=2e-3)  # all noise: everyone has the mean


@pytest.mark.slow
@pytest.mark.parametrize(("drawn", "t"), [(True, (-3, 3)), (False, (4, 99))])
def test_many_trajectories_that_fade_from_noisy_starts_do_not_lean(drawn, t):
    """The score of damping at the truth: nothing on the mean; from starts as measured it pulls to more damping."""
    space = ParameterSpace(
        [Parameter("damping", 1.0, 0.2, 3.0, operation="scaling", attribute="damping", target="x", kind="joint")]
    )
    physics, count, steps, sd = Physics(MODEL, 0.05, space), 2048, 20, 0.1
    rng = np.random.default_rng(3)
    start = rng.uniform(-0.3, 0.3, (2, count, 1))
    motion = replay(physics, *start, np.zeros((count, steps, 0)), np.ones((count, 1)))
    rows = [np.asarray(motion[k]) + sd * rng.normal(size=motion[k].shape) for k in ("qpos", "qvel")]
    found = Likelihood(
        physics, Record(*(jnp.asarray(x, jnp.float32) for x in (*rows, np.zeros((count, steps, 0))))),
        np.ones((count, steps)), np.full(2, sd), 256,
    )  # fmt: skip
    if not drawn:
        found.starts.count = 3
    found.settle(np.ones(1))
    less, more = found.squares(np.array([[0.98], [1.02]])).sum(2)
    score = (less - more) / (2 * 0.04)
    low, high = t
    assert low < score.mean() / score.std() * np.sqrt(count) < high
