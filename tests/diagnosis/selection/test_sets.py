"""The posterior over sets of effects, from planted evidence."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis.selection import sets
from bayessim_mjx.diagnosis.selection.sets import RELEVANCE, log_prior, relevant

A, B, AB, NONE = frozenset("a"), frozenset("b"), frozenset("ab"), frozenset()


def weighed(evidence, numbers=None):
    return sets.weighed(evidence, numbers or {k: len(k) for k in evidence}, 30)


def test_the_prior_expects_one_effect():
    """Over all sets of 30 candidates its mean number is one, and none is about as likely as one."""
    n = 30
    odds = np.exp(log_prior(A, n))
    assert n * odds / (1 + odds) == pytest.approx(1.0)


def test_weights_are_posterior_probabilities():
    found = weighed({NONE: 0.0, A: 10.0, B: 9.0})
    prior = np.exp(log_prior(A, 30))
    each = np.array([1.0, prior * np.exp(10.0), prior * np.exp(9.0)])
    assert [found.weight[k] for k in (NONE, A, B)] == pytest.approx(each / each.sum())
    assert found.answer == A and list(found.weight)[1] == B
    assert found.nats[A] - found.nats[B] == pytest.approx(1.0)


def test_an_effect_matters_that_changes_the_motion_by_more_than_noise_and_laws_of_simulators():
    gap = 100.0
    least = RELEVANCE.noise + RELEVANCE.share * gap
    assert relevant([least + 0.01, 90.0], gap) and not relevant([least - 0.01, 90.0], gap)
    assert relevant([], gap)


def test_a_gap_within_the_noise_needs_no_effect():
    """However large an effect is that known parameters make up for."""
    assert not relevant([50.0], 0.08) and relevant([], 0.08)


def test_of_explanations_that_are_as_likely_the_simpler_one_is_named():
    numbers = {NONE: 0, A: 4, B: 1}
    found = weighed({NONE: 0.0, A: 50.9, B: 50.0}, numbers)  # odds of 2.5
    assert found.answer == B and found.beside == [A]
    found = weighed({NONE: 0.0, A: 51.4, B: 50.0}, numbers)  # of 4
    assert found.answer == A and found.beside == [B]
    assert weighed({NONE: 0.0, A: 53.2, B: 50.0}, numbers).beside == []  # of 25
