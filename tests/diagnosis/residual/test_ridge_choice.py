"""The ridge of a flexible force is chosen on other folds than it is scored on."""

from types import SimpleNamespace

import numpy as np

from bayessim_mjx.diagnosis.residual import black_boxes


def test_a_choice_among_ridges_that_do_nothing_gains_nothing():
    """Costs that differ from the base by chance alone: the best of five seems to gain, the choice must not."""
    rng, fold = np.random.default_rng(0), np.repeat(np.arange(6), 4)
    gains, same = [], []
    for _ in range(400):
        costs = 10.0 + np.repeat(rng.normal(size=(1, 5, 6)), 4, axis=2)  # [seeds, ridges, W]
        run = SimpleNamespace(without=lambda fold, ridges: range(5), costs=lambda fold, k, costs=costs: costs[0, k])
        problem = SimpleNamespace(base=lambda fold: np.full(24, 10.0), fitter=SimpleNamespace(size=10))
        held = black_boxes.held_out(problem, [run], fold)
        gains.append(held.gain)
        same.append(240.0 - held.totals.min())
    error = np.std(gains) / np.sqrt(len(gains))
    assert abs(np.mean(gains)) < 3 * error
    assert np.mean(same) > 10 * error  # what the same folds would have promised
