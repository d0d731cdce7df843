"""How much of a disagreement between stretches of time is believed."""

import numpy as np
import pytest

from bayessim_mjx.loop.refinement import _shrunk


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
