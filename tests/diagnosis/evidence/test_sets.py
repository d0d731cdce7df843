"""The posterior over sets of effects, from planted evidence."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis.evidence import weighing
from bayessim_mjx.diagnosis.evidence.weighing import Left, core
from bayessim_mjx.diagnosis.selection.numbers import RELEVANCE
from bayessim_mjx.diagnosis.selection.search_state import log_prior

A, B, AB, NONE = frozenset("a"), frozenset("b"), frozenset("ab"), frozenset()


def left_of(excess, unlikely=None):
    return {k: Left(e, (unlikely or {}).get(k, 0.0)) for k, e in excess.items()}


def weighed(evidence, excess, numbers=None, unlikely=None):
    return weighing.weighed(evidence, left_of(excess, unlikely), numbers or {k: len(k) for k in evidence}, 30)


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
    assert core(AB, left_of(excess)) == B
    found = weighed({NONE: 0.0, A: 500.0, AB: 550.0}, {NONE: 100.0, A: 0.1, AB: 0.0})
    assert found.answer == A and AB not in found.weight and found.weight[A] == pytest.approx(1.0)
    assert found.nats[A] == pytest.approx(550.0 + log_prior(AB, 30))
    assert found.sets[AB] == pytest.approx(1.0) and found.possible == [A, AB]
    excess = {NONE: 100.0, A: RELEVANCE.noise + RELEVANCE.share * 100.0 + 0.01, AB: 0.0}
    assert core(AB, left_of(excess)) == AB
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
    found = weighing.weighed(evidence, left_of(excess), {NONE: 0, A: 1, B: 3}, 30, {B: A})
    assert found.answer == A and B not in found.weight and found.weight[A] == pytest.approx(1.0)
    assert found.nats[A] - found.nats[NONE] == pytest.approx(np.logaddexp(50.0, 53.0) + log_prior(A, 30))


@pytest.mark.parametrize("odds", [0.1, 10.0, 30.0])
def test_an_effect_that_does_the_work_of_known_parameters_is_weighed_by_the_data_sheet(odds):
    """No gap remains without it, and parameters far off: an explanation of its own, that is not named."""
    evidence, gap = {NONE: 0.0, A: np.log(odds) - log_prior(A, 30)}, {NONE: 0.0, A: 0.0}
    found = weighed(evidence, gap, unlikely={NONE: 8.0, A: 0.5})
    assert found.weight[A] / found.weight[NONE] == pytest.approx(odds)
    assert found.answer == NONE and found.beside == [A]
    assert found.chance()["answer"] == pytest.approx(1 / (1 + odds)) == 1 - found.chance()["rivals"]
    near = weighed(evidence, gap, unlikely={NONE: 1.0, A: 0.5})  # parameters hardly move: the effect is irrelevant
    assert near.answer == NONE and near.weight == {NONE: 1.0}


@pytest.mark.parametrize(
    ("more", "unlikely", "named"),
    [(40.0, 9.0, AB), (40.0, 2.0, A), (11.0, 9.0, A), (13.0, 9.0, AB)],
    ids=["both", "the logs alone", "the data sheet alone", "both, just"],
)
def test_an_effect_for_which_logs_and_data_sheet_both_speak_is_named(more, unlikely, named):
    """A payload beside a delay that makes nearly the whole gap: without it a mass is twice the data sheet's."""
    evidence = {NONE: 0.0, A: 500.0, AB: 500.0 + more - log_prior(AB, 30) + log_prior(A, 30)}
    found = weighed(evidence, {NONE: 100.0, A: 0.2, AB: 0.0}, unlikely={NONE: 9.0, A: unlikely})
    assert found.answer == named and found.weight[AB] > 0.99


def test_named_effects_are_as_probable_as_all_sets_with_them():
    """Beside an effect that closes the gap, another may do the work of known parameters: no rival of the first."""
    evidence = {NONE: 0.0, A: 50.0, AB: 51.0 - log_prior(B, 30), B: 3.0}
    found = weighed(evidence, {NONE: 100.0, A: 0.0, AB: 0.0, B: 100.0}, unlikely={NONE: 9.0, A: 9.0})
    assert found.answer == A and list(found.weight)[0] == AB and found.beside == [AB]
    assert found.chance()["answer"] == pytest.approx(found.weight[A] + found.weight[AB])
    assert found.chance()["rivals"] == 0.0
