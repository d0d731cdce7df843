"""How much of a disagreement between stretches of time is believed."""

import numpy as np
import pytest

from bayessim_mjx.loop.likelihood_refinement import _grouped, _shrunk


def sampled(rng, sd, count):
    scores = sd * rng.normal(size=(count, len(sd)))
    return scores.T @ scores / count


@pytest.mark.parametrize("d", [2, 13])
def test_chance_is_not_believed(d):
    rng = np.random.default_rng(0)
    widest = [np.linalg.eigvalsh(_shrunk(sampled(rng, np.ones(d), 8), 8)).max() for _ in range(200)]
    raw = [np.linalg.eigvalsh(sampled(rng, np.ones(d), 8)).max() for _ in range(200)]
    assert np.median(widest) < 1.15 and np.median(raw) > 1.3


def test_what_chance_does_not_explain_is_kept():
    rng = np.random.default_rng(1)
    everywhere = [np.linalg.eigvalsh(_shrunk(sampled(rng, np.full(3, 3.0), 8), 8)) for _ in range(200)]
    assert np.mean(everywhere) == pytest.approx(9, rel=0.1)
    one = [_shrunk(sampled(rng, np.array([1, 1, 4.0]), 32), 32) for _ in range(200)]
    assert np.median([s[2, 2] for s in one]) > 10 and np.median([s[0, 0] for s in one]) < 3


def grouped(groups, shared, d=3, each=4, cases=40):
    """Mean covariance [d, d] by `_grouped`, of scores that are white and have `shared` in each group."""
    labels = np.repeat(np.arange(groups), each)
    found = []
    for seed in range(cases):
        rng = np.random.default_rng(seed)
        scores = rng.normal(size=(len(labels), d)) / np.sqrt(len(labels))
        scores += shared * (rng.normal(size=(groups, 1)) * np.eye(d)[0])[labels] / np.sqrt(each * len(labels))
        found.append(_grouped(np.eye(d), scores - scores.mean(0), labels))
    return np.mean(found, axis=0)


def test_what_windows_of_one_log_share_widens():
    """Sums of groups vary by 1 + shared^2 along the first axis, which windows alone show as 1 + shared^2 / 4."""
    found = grouped(16, shared=4.0)
    assert found[0, 0] == pytest.approx(17, rel=0.15)
    np.testing.assert_allclose(np.delete(found, 0, 0)[:, 1:], np.eye(2), atol=0.25)


def test_chance_between_groups_is_not_believed():
    """Where groups share nothing, what they show beyond the stretches of time is mostly left out, of however few."""
    for d in (2, 5, 13):
        for groups in (2, 4, 8, 32):
            scores = [np.random.default_rng(s).normal(size=(groups, d)) / np.sqrt(groups) for s in range(200)]
            found = [_grouped(np.eye(d), x - x.mean(0), np.arange(groups)) for x in scores]
            assert np.mean([np.linalg.eigvalsh(x).max() > 1.1 for x in found]) <= 0.1
    np.testing.assert_array_equal(_grouped(np.eye(2), np.ones((5, 2)), np.zeros(5)), np.eye(2))
