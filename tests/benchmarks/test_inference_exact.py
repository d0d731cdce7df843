"""Exact posteriors of recorded motion: against the closed form of linear dynamics, and of a valley by counting."""

import numpy as np
import pytest
import refinement
from exact_posteriors import Recorded, exact
from scipy.stats import chi2, multivariate_normal

from bayessim_mjx.rollout import replay
from bayessim_mjx.tracking import Record

pytestmark = pytest.mark.slow


def first(record, n):
    return Record(*(x[:n] for x in (record.qpos, record.qvel, record.command)))


def closed_form(at, rows, theta):
    """(gain, level) where motion is linear in theta [d] and in starts that may be anything."""
    n, d = len(rows.command), len(theta)
    low, high = at.space.low, at.space.high
    zero = np.zeros((n, 1))

    def motion(q, v, gains, command):
        found = replay(at.physics, q, v, command, np.tile(gains, (n, 1)))
        return np.concatenate([np.asarray(found[k], float)[:, :, 0] for k in ("qpos", "qvel")], axis=1)

    command = np.asarray(rows.command)
    design = np.stack([motion(zero, zero, e, command) for e in np.eye(d)], axis=-1)
    starts = np.stack([motion(q, v, 0 * theta, 0 * command) for q, v in ((zero + 1, zero), (zero, zero + 1))], axis=-1)
    y = np.concatenate([np.asarray(x, float)[:, :, 0] for x in (rows.qpos, rows.qvel)], axis=1)
    precision, pull = np.zeros((d, d)), np.zeros(d)
    for own, slope, seen in zip(starts, design, y, strict=True):
        rest = np.eye(len(own)) - own @ np.linalg.pinv(own)
        precision += slope.T @ rest @ slope / at.sd**2
        pull += slope.T @ rest @ seen / at.sd**2
    mean, covariance = np.linalg.solve(precision, pull), np.linalg.inv(precision)
    level = chi2.cdf((theta - mean) @ precision @ (theta - mean), d)
    return multivariate_normal.logpdf(theta, mean, covariance) + np.log(high - low).sum(), level


def test_linear_dynamics_have_a_closed_form():
    at = refinement.system("linear")
    for seed in range(3):
        theta, record, _ = refinement.recorded(at, seed, "none")
        rows = first(record, 4)
        found = exact(Recorded(at.physics, rows, at.sd, ratios=False), theta)
        np.testing.assert_allclose([found.gain, found.level], closed_form(at, rows, theta), atol=0.06)


def test_a_number_that_motion_cannot_tell_leaves_the_prior_of_the_ratios():
    """By counting: how many draws of the prior have their ratios in a cell."""
    at = refinement.system("damped")
    rng, space = np.random.default_rng(0), at.space
    theta = rng.uniform(space.low, space.high, (1_000_000, 3))
    ratios = theta[:, 1:] / theta[:, :1]
    centres, half = np.array([[1.0, 1.0], [0.4, 0.6], [2.5, 1.5]]), 0.05
    counted = [(np.abs(ratios - c) < half).all(1).mean() / (2 * half) ** 2 for c in centres]
    _, record, _ = refinement.recorded(at, 0, "none")
    prior = Recorded(at.physics, first(record, 1), at.sd, ratios=True).prior
    np.testing.assert_allclose(prior(centres), counted, rtol=0.08)
    assert (prior(np.array([[7.0, 1.0], [1.0, 5.0], [-1.0, 1.0]])) == 0).all()  # beyond all of the box


def test_motion_knows_the_ratios_alone():
    """Three parameters times one number move alike, and the exact gain counts that number as unknown."""
    at = refinement.system("damped")
    theta, record, _ = refinement.recorded(at, 3, "none")
    rows = Recorded(at.physics, first(record, 2), at.sd, ratios=True)
    starts = np.zeros((1, 2, 2))
    moved = rows.gaps((theta[1:] / theta[0])[None], starts)
    start = np.zeros((2, 1), np.float32)
    own = replay(at.physics, start, start, record.command[:2], np.tile(theta, (2, 1)))
    own = np.concatenate([np.asarray(own[k], float)[:, :, 0] for k in ("qpos", "qvel")], axis=1)
    np.testing.assert_allclose(moved[0] * at.sd + rows.seen(), own, atol=1e-4)
    found = exact(rows, theta)
    assert found.gain == pytest.approx(exact(rows, theta * 0.95).gain, abs=0.02)  # as likely, and as dense a prior
    assert 0 <= found.level <= 1
    inside = (found.draws > at.space.low - 1e-6) & (found.draws < at.space.high + 1e-6)
    assert inside.all() and found.draws.std(0).min() > 0.02  # along the valley
