"""What is named and what is told beside it, from a table of scores alone."""

import dataclasses

import numpy as np
import pytest

from bayessim_mjx.diagnosis.selection.criteria import Criteria
from bayessim_mjx.diagnosis.selection.decide import chosen_elsewhere, closed_elsewhere, compare, decide, order
from bayessim_mjx.diagnosis.selection.table import BASE, read
from bayessim_mjx.errors import UserError
from tests.diagnosis.selection.planted import law, table

A, B, C, D, E = (law(name) for name in "abcde")
GROUP = np.repeat(np.arange(5), 4)


def decided(errors, criteria=None, **options):
    known = table(errors, **options)
    return decide(known, order(known.laws), criteria or Criteria())


def named(errors, **options):
    return set(decided(errors, **options).answer)


def labels(*laws):
    return {c.label for c in laws}


def test_nothing_is_named_where_the_known_parameters_are_at_the_noise():
    assert named({(): 1.2, (A,): 0.5, (B,): 1.1}) == set()


def test_the_best_is_named_where_it_is_better_by_evidence_and_closes_enough():
    assert named({(): 100, (A,): 1.0, (B,): 60}) == labels(A)
    assert named({(): 100, (A,): 90}) == set()  # closes too little
    assert named({(): 100, (A,): 40}, samples=4) == set()  # too few residuals to tell


def test_a_further_effect_has_to_close_enough_of_what_the_others_leave():
    assert named({(): 100, (A,): 50, (A, B): 44}) == labels(A)
    assert named({(): 100, (A,): 50, (A, B): 30}) == labels(A, B)
    assert named({(): 1e6, (A,): 82, (A, B): 2}) == labels(A)  # .008 % of the whole gap
    assert named({(): 1e6, (A,): 122, (A, B): 2}) == labels(A, B)
    assert named({(): 1e6, (A,): 122, (A, B): 2}, tolerated=150.0) == labels(A)  # no more is asked for
    assert named({(): 1e6, (A,): 4000, (A, B): 2}, tolerated=5000.0) == labels(A, B)
    assert named({(): 1e6, (A,): 122, (B, C): 2}, tolerated=150.0) == labels(A)
    assert named({(): 1e6, (A,): 122, (B, C): 2}) == labels(B, C)


def test_of_two_that_close_a_large_gap_the_better_leads_though_its_residuals_are_fewer():
    """B predicts each window better, so it leads; counts of independent residuals are no evidence between models."""
    known = table({(): 1e4, (A,): 90, (A, B): 40}, samples=1000)
    both = frozenset(labels(A, B))
    known.rows[both] = dataclasses.replace(known.rows[both], samples=700)
    found = decide(known, order(known.laws), Criteria())
    assert found.best == found.answer == both


def test_a_set_needs_no_member_that_shows_alone():
    assert named({(): 100, (A,): 99, (B,): 101, (C,): 40, (A, B): 1.0}) == labels(A, B)
    assert named({(): 100, (A,): 99, (B,): 98, (A, B): 97, (A, B, C): 1.0}) == labels(A, B, C)


def test_what_helps_one_condition_only_is_chance_unless_it_helps_much_and_harms_nowhere():
    """A limit acts in few windows: of five conditions one gains."""
    rare = np.where(GROUP == 3, 1.0, 50.0)
    bare = np.where(GROUP == 3, 400.0, 50.0)
    assert named({(): bare, (A,): rare}, group=GROUP) == labels(A)
    assert named({(): bare, (A,): rare}, group=GROUP, samples=20) == set()
    harmed = np.where(GROUP == 1, 90.0, rare)
    assert named({(): bare, (A,): harmed}, group=GROUP) == set()


def test_what_conditions_show_very_unequally_is_told_though_one_loses_a_little():
    """Friction in a slow and in fast motions: the standard error of unequal gains is large, though all but one gain."""
    unequal = np.array([900.0, 100.0, 10.0, 2.0, 1.0])[GROUP]
    harmed = np.where(GROUP == 4, 1.4, 1.0)
    found = compare(table({(): unequal, (A,): harmed}, group=GROUP), BASE, frozenset([A.label]))
    assert found.deviate < 2 and -0.1 < found.worst < 0
    assert named({(): unequal, (A,): harmed}, group=GROUP) == labels(A)
    assert named({(): unequal, (A,): np.where(GROUP == 4, 90.0, 1.0)}, group=GROUP) == set()


def test_a_doubtful_effect_on_top_of_a_sure_one_leaves_the_sure_one_named():
    """Both together are the best, but not in all conditions: alone they would not tell that anything is missing."""
    bare, one = np.where(GROUP == 3, 400.0, 50.0), np.where(GROUP == 3, 1.0, 50.0)
    both = np.select([GROUP == 0, GROUP == 1], [30.0, 100.0], one)
    assert named({(): bare, (A, B): both}, group=GROUP) == set()
    found = decided({(): bare, (A,): one, (B,): bare, (C,): 0.9 * bare, (A, B): both}, group=GROUP)
    assert found.answer == labels(A) and not found.rivals  # what shows nothing is no rival


def test_what_does_as_well_as_the_answer_stands_beside_it_where_the_best_has_an_effect_more():
    """A further effect is not worth naming, but counts against what lacks it: the like of the answer is no worse."""
    few, many = law("a", numbers=1), law("b", numbers=3)
    errors = {(): 100.0, (many,): 1.25, (many, C): 1.0, (few,): 1.25}
    found = decided(errors)
    assert found.best == labels(many, C) and found.answer == labels(few)
    assert [r.key for r in found.rivals] == [labels(many)]
    assert decided(errors | {(few,): 1.6}).answer == labels(many)


def test_the_standard_error_is_that_of_conditions_not_of_windows():
    """Windows of a condition err alike: gains in all conditions are evidence, the same gains within one are not."""
    mixed = np.where(np.arange(20) % 4 == 0, 5.0, 55.0)
    together = np.sort(mixed)
    each = [
        compare(table({(): 50.0, (A,): cost}, group=GROUP), BASE, frozenset([A.label])) for cost in (mixed, together)
    ]
    assert each[0].nats == pytest.approx(each[1].nats, rel=0.02)
    assert each[0].deviate > 4 > 2 > each[1].deviate


def test_a_special_case_is_named_before_its_law_which_is_told():
    dry, general = law("coulomb_friction"), law("asymmetric_friction", numbers=2, special=("coulomb_friction",))
    found = decided({(): 100, (dry,): 1.05, (general,): 1.0})
    assert found.answer == labels(dry) and [r.key for r in found.rivals] == [labels(general)]
    for bare, special in ((100, 30.0), (100, 10.0), (20, 2.8)):
        assert decided({(): bare, (dry,): special, (general,): 1.0}).answer == labels(general)


def test_one_place_is_named_before_all_of_them():
    tied, one = law("armature", "all", places=("pole", "cart")), law("armature", "pole")
    assert decided({(): 100, (tied,): 1.1, (one,): 1.15}).answer == labels(one)
    assert decided({(): 100, (tied,): 1.1, (one,): 3.0}).answer == labels(tied)


def test_one_effect_of_many_numbers_before_several_of_few():
    """Friction that differs by direction is dry friction and a bias, of as many numbers."""
    dry, bias, both = law("coulomb_friction"), law("actuator_bias"), law("asymmetric_friction", numbers=3)
    found = decided({(): 100, (dry,): 40, (bias,): 60, (both,): 1.0, (dry, bias): 1.0})
    assert found.answer == labels(both) and [r.key for r in found.rivals] == [labels(dry, bias)]


def test_rivals_are_what_the_logs_cannot_tell_the_fewest_effects_first_and_no_supersets():
    errors = {(): 100, (A,): 1.0, (B,): 1.01, (C,): 1.6, (B, C): 1.0, (A, C): 1.0}
    found = decided(errors)
    assert found.answer == labels(A)
    assert [r.key for r in found.rivals] == [labels(B)]  # c is told apart by its evidence
    assert found.rivals[0].closed == pytest.approx(1.0, abs=1e-3) and abs(found.rivals[0].nats) < 60


def test_of_what_is_alike_the_least_even_if_another_is_better_by_chance():
    two = law("two", numbers=2)
    assert named({(): 100, (two,): 0.9, (A,): 0.95}) == labels(A)


def test_of_what_is_alike_above_the_noise_the_one_that_the_evidence_prefers():
    """It closes too little more to be worth another effect; with as many it is told apart."""
    two = law("two", numbers=2)
    assert named({(): 100, (two,): 20.0, (A,): 22.5}) == labels(two)
    assert named({(): 100, (two,): 20.0, (A,): 22.5}, samples=40) == labels(A)


def test_a_model_of_which_an_effect_is_hardly_there_is_not_named():
    known = table({(): 100, (A,): 2.5, (A, B): 1.0})
    known.rows[frozenset([A.label, B.label])].distance[B.label] = 0.5
    assert set(decide(known, order(known.laws), Criteria()).answer) == labels(A)


def test_with_effects_the_sensors_own_noise_is_reached_where_the_time_step_costs_less_than_feared():
    errors = {(): 100, (A,): 1.5, (A, B): 1.0}
    assert named(errors) == labels(A) and named(errors, believed=0.5) == labels(A, B)


def test_where_a_model_leaves_less_than_the_noise_the_noise_was_taken_too_large():
    assert named({(): 100, (A,): 1.5, (A, B): 0.3}) == labels(A, B)
    assert named({(): 100, (A,): 0.4, (A, B): 0.3}) == labels(A)  # 1.15 of the best, rms


def test_of_what_predicts_alike_the_one_that_data_sheets_forbid_is_no_rival():
    """One is alike by prediction; its centre of mass would be 8 standard deviations off (32 nats)."""
    known = table({(): 100, (A,): 1.0, (B,): 1.0}, group=GROUP)
    free = decide(known, order(known.laws), Criteria())
    assert {*free.answer, *(label for r in free.rivals for label in r.key)} == labels(A, B)
    key = frozenset(labels(B))
    rows = known.rows | {key: dataclasses.replace(known.rows[key], belief=-32.0)}
    far = dataclasses.replace(known, rows=rows)
    found = decide(far, order(far.laws), Criteria())
    assert set(found.answer) == labels(A) and not found.rivals
    assert read(far.to_dict()).rows[key].belief == -32.0


def test_the_order_of_the_rows_and_a_round_trip_decide_nothing():
    errors = {(): 100, (A,): 30, (B,): 60, (A, B): 1.0, (B, C): 1.0}  # a tie
    known = table(errors)
    turned = table(dict(reversed(errors.items())))
    first, second, third = (decide(t, order(t.laws), Criteria()) for t in (known, turned, read(known.to_dict())))
    assert first.answer == second.answer == third.answer
    assert first.rivals == second.rivals and [r.key for r in third.rivals] == [r.key for r in first.rivals]


def test_conditions_can_be_left_out_of_a_table():
    known = table({(): 100, (A,): np.where(GROUP == 2, 70.0, 1.0)}, group=GROUP)
    less = known.without(2)
    assert set(less.group) == {0, 1, 3, 4}
    assert less.excess(frozenset([A.label])) < 0.1 < known.excess(frozenset([A.label]))


def test_criteria_are_given_as_texts():
    changed = Criteria().changed(["same=.3", "beam=5"])
    assert changed.same == 0.3 and changed.beam == 5 and changed.errors == Criteria().errors
    for wrong in ("sme=1", "same=much", "beam=2.5", "same=-1", "beam=0"):
        with pytest.raises(UserError, match=wrong.partition("=")[0]):
            Criteria().changed([wrong])


def elsewhere(errors):
    known = table(errors, group=GROUP)
    return closed_elsewhere(known, chosen_elsewhere(known, order(known.laws), Criteria()))


def test_what_is_quoted_of_conditions_that_did_not_choose():
    """The same where every condition names the same; less where the winner of the others fails on the one left out."""
    assert elsewhere({(): 101, (A,): 51, (B,): 90}) == pytest.approx(0.5, abs=0.01)
    assert elsewhere({(): 101}) == 0.0 and np.isnan(elsewhere({(): 0.9}))
    lucky = {(c,): np.where(g == GROUP, 301.0, 41.0) for g, c in enumerate((A, B, C, D, E))}
    assert elsewhere({(): 101, **lucky}) == pytest.approx(-2.0, abs=0.05)


def test_one_condition_says_nothing_of_others():
    known = table({(): 100, (A,): 1.0}, group=np.zeros(8, int))
    assert np.isnan(closed_elsewhere(known, chosen_elsewhere(known, order(known.laws), Criteria())))
