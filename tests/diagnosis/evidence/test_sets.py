"""The posterior over sets of effects, from planted evidence."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis.evidence import weighing
from bayessim_mjx.diagnosis.evidence.weighing import core
from bayessim_mjx.diagnosis.selection.numbers import RELEVANCE
from bayessim_mjx.diagnosis.selection.search_state import log_prior

A, B, AB, NONE = frozenset("a"), frozenset("b"), frozenset("ab"), frozenset()


def weighed(evidence, excess, numbers=None):
    return weighing.weighed(evidence, excess, numbers or {k: len(k) for k in evidence}, 30)


def test_the_prior_expects_one_effect():
    """Over all sets of 30 candidates its mean number is one, and none is about as likely as one."""
    n = 30
    odds = np.exp(log_prior(A, n))
    assert n * odds / (1 + odds) == pytest.approx(1.0)


def test_weights_are_posterior_probabilities():
    excess = {NONE: 100.0, A: 0.0, B: 0.02}
    found = weighed({NONE: 0.0, A: 10.0, B: 9.0}, excess)
    prior = np.exp(log_prior(A, 30))
    each = np.array([1.0, prior * np.exp(10.0), prior * np.exp(9.0)])
    assert [found.weight[k] for k in (NONE, A, B)] == pytest.approx(each / each.sum())
    assert found.answer == A and list(found.weight)[1] == B
    assert found.nats[A] - found.nats[B] == pytest.approx(1.0)


def test_an_effect_that_does_not_matter_makes_no_explanation_of_its_own():
    """However sure it is: 50 nats for a thousandth of the gap. The set counts for the one without it, and by itself."""
    excess = {NONE: 100.0, A: 0.1, B: 0.0, AB: 0.0}
    assert core(AB, excess) == B
    found = weighed({NONE: 0.0, A: 500.0, AB: 550.0}, {NONE: 100.0, A: 0.1, AB: 0.0})
    assert found.answer == A and AB not in found.weight and found.weight[A] == pytest.approx(1.0)
    assert found.nats[A] == pytest.approx(550.0 + log_prior(AB, 30))
    assert found.sets[AB] == pytest.approx(1.0) and found.possible == [A, AB]
    excess = {NONE: 100.0, A: RELEVANCE.noise + RELEVANCE.share * 100.0 + 0.01, AB: 0.0}
    assert core(AB, excess) == AB
    assert weighed({NONE: 0.0, A: 500.0, AB: 550.0}, excess).answer == AB


def test_a_gap_within_the_noise_needs_no_effect():
    """What does the work of known parameters is possible all the same, and so is in their intervals."""
    found = weighed({NONE: 0.0, A: 4.0}, {NONE: 0.08, A: 0.0})
    assert found.answer == NONE and found.weight == {NONE: 1.0} and found.possible == [NONE, A]


def test_of_explanations_that_are_as_likely_the_simpler_one_is_named():
    excess, numbers = {NONE: 100.0, A: 0.0, B: 0.0}, {NONE: 0, A: 4, B: 1}
    found = weighed({NONE: 0.0, A: 50.9, B: 50.0}, excess, numbers)  # odds of 2.5
    assert found.answer == B and found.beside == [A]
    found = weighed({NONE: 0.0, A: 51.4, B: 50.0}, excess, numbers)  # of 4
    assert found.answer == A and found.beside == [B]
    assert weighed({NONE: 0.0, A: 53.2, B: 50.0}, excess, numbers).beside == []  # of 25


def test_effects_that_leave_a_gap_are_not_named_for_likely_ones_that_close_it():
    """A joint's offset whose fit has the sensor 1.6 ms late as an error of the clock, and the same with a delay."""
    evidence = {NONE: 0.0, A: 50.0, AB: 50.0 - log_prior(frozenset("b"), 30)}
    assert weighed(evidence, {NONE: 100.0, A: 7.3, AB: 0.0}).answer == AB
    assert weighed(evidence, {NONE: 100.0, A: 0.3, AB: 0.0}).answer == A
    assert weighed({NONE: 0.0, A: 1.0 - log_prior(A, 30)}, {NONE: 7.3, A: 0.0}).answer == NONE


def test_a_law_with_neutral_numbers_counts_for_its_special_case():
    """Stribeck friction without an excess is Coulomb friction, however likely its fit is."""
    evidence, excess = {NONE: 0.0, A: 50.0, B: 53.0}, {NONE: 100.0, A: 0.0, B: 0.0}
    found = weighing.weighed(evidence, excess, {NONE: 0, A: 1, B: 3}, 30, {B: A})
    assert found.answer == A and B not in found.weight and found.weight[A] == pytest.approx(1.0)
    assert found.nats[A] - found.nats[NONE] == pytest.approx(np.logaddexp(50.0, 53.0) + log_prior(A, 30))
