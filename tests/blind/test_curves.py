"""Detection curves on trials whose thresholds are known."""

import numpy as np
import pytest

from bayessim_mjx.blind import cases
from bayessim_mjx.blind.amounts import AMOUNTS, amount_of, in_words, unit_of
from bayessim_mjx.blind.answer import amount_at
from bayessim_mjx.blind.curves import LAPSE, Curves, Trial, chance
from bayessim_mjx.blind.reality.menu import KNOWN


def step(threshold: float, count: int = 32) -> list[Trial]:
    """What finds an effect if and only if it is stronger than a threshold."""
    strengths = np.geomspace(2, 60, count)
    return [Trial(f"e{i % 4}", f"p{i % 3}", float(s), bool(s > threshold)) for i, s in enumerate(strengths)]


@pytest.mark.parametrize("threshold", [6.0, 20.0])
def test_a_threshold_lies_within_its_interval(threshold):
    curves = Curves(step(threshold))
    for effect, where in (("e0", "p0"), ("e3", "p1"), ("e1", "never tried")):
        middle, low, high = curves.of(effect, where).interval()
        assert low < threshold < high and threshold / 1.5 < middle < threshold * 1.6


def test_what_was_never_tried_is_known_less_well():
    curves = Curves(step(10.0))
    widths = [np.log(high / low) for _, low, high in (curves.of(*g).interval() for g in (("e0", "p0"), ("new", "p")))]
    assert widths[0] < widths[1]


def test_an_effect_that_is_found_later_than_the_others_is_told_so():
    found = step(6.0) + [Trial("late", "p", s, False) for s in (8.0, 15.0, 30.0, 40.0)]
    assert Curves(found).of("late", "p").interval()[0] > 3 * Curves(found).of("e0", "p0").interval()[0]


def test_intervals_hold_as_often_as_they_say():
    """Thresholds and slopes differ by effect; benchmarks/blind/calibration.py counts more, with planned strengths."""
    rng, inside = np.random.default_rng(0), []
    for _ in range(8):
        centre, slope = rng.uniform(1.5, 3.5), {f"e{i}": rng.choice([2.0, 5.0]) for i in range(10)}
        effects = rng.normal(centre, 0.5, 10)
        true = {(f"e{i}", f"p{k}"): rng.normal(effects[i], 0.2) for i in range(10) for k in range(2)}
        groups = [list(true)[i * 7 % 20] for i in range(70)]
        strengths = rng.uniform(0.5, 5.0, 70)
        trials = [
            Trial(*g, float(np.exp(x)), bool(rng.uniform() < chance(x, true[g], slope[g[0]])))
            for g, x in zip(groups, strengths, strict=True)
        ]
        curves, odds = Curves(trials), 0.9 / (1 - LAPSE)
        for g, threshold in true.items():
            _, low, high = curves.of(*g).interval()
            inside.append(low <= np.exp(threshold + np.log(odds / (1 - odds)) / slope[g[0]]) <= high)
    assert 0.82 < np.mean(inside) < 0.98


def test_drawn_numbers_have_the_chances_of_their_curves():
    """Drawn one after the other from population, effect and place: on average what the curves of single places say."""
    curves = Curves(step(10.0, count=12))
    fresh = [Trial(e, w, s, False) for e, w in (("e0", "p0"), ("e0", "never"), ("new", "p")) for s in (5.0, 12.0)]
    numbers = curves.numbers(fresh, 2000, np.random.default_rng(0))
    for effect, draws in numbers.items():
        own = [t for t in fresh if t.effect == effect]
        due = sum(float(curves.of(t.effect, t.where).curve(np.array([t.strength]))[0][0]) for t in own)
        assert len(draws) == 2000 and draws.mean() == pytest.approx(due, abs=4 * draws.std() / 2000**0.5)
    assert set(numbers) == {"e0", "new"}


def test_later_strengths_are_drawn_where_an_effect_begins_to_be_found():
    groups = [(f"e{i}", "p0") for i in range(4)]
    items = cases.plan(range(32, 72), groups, [("unknown", "x")], step(10.0), seed=0)
    strengths = [i.strength for i in items if i.kind == "single"]
    assert 5 < np.median(strengths) < 20 and np.mean([3 < s < 40 for s in strengths]) > 0.85


def test_a_round_waits_for_the_cases_four_rounds_before_it_whatever_is_asked_for_in_all():
    rounds = cases.rounds(60)
    assert [cases.known(r) for r in rounds] == [0, 0, 0, 0, 16, 24, 32]
    assert [cases.known(r) for r in cases.rounds(100)][: len(rounds)] == [cases.known(r) for r in rounds]
    assert all(r.start - cases.known(r) <= 40 for r in cases.rounds(200))  # so many cores have work


def test_a_round_follows_from_the_seed_and_the_cases_before_it_alone():
    groups, trials = [("a", "p"), ("a", "q"), ("b", "p")], step(10.0)
    first = cases.plan(range(16, 24), groups, [("u", "p")], trials, seed=3)
    assert first == cases.plan(range(16, 24), groups, [("u", "p")], trials, seed=3)
    assert first != cases.plan(range(16, 24), groups, [("u", "p")], trials, seed=4)
    assert first[:4] == cases.plan(range(16, 20), groups, [("u", "p")], trials, seed=3)
    assert cases.rounds(40)[:3] == cases.rounds(100)[:3] and cases.rounds(5) == [range(0, 5)]


def test_effects_and_places_take_turns():
    groups = [(e, w) for e in "abc" for w in "pq"]
    turns = [cases.in_turn(groups, k, seed=0) for k in range(6)]
    assert {e for e, _ in turns[:3]} == set("abc") and set(turns) == set(groups)


def test_amounts_grow_with_the_effect_and_are_told_in_its_units():
    assert set(AMOUNTS) == set(KNOWN)
    assert amount_of("backlash", {"gap": 0.003}) == 0.003 and in_words("backlash", 0.003) == "0.17 deg"
    assert in_words("backlash", 0.003, slide=True) == "3.0 mm" and in_words("actuator_delay", 0.004) == "4.0 ms"
    assert amount_of("actuator_gain", {"gain": 0.7}) == pytest.approx(0.3) and in_words("actuator_gain", 0.3) == "30 %"
    assert in_words("actuator_saturation", 0.5) == "2.0 N m" and unit_of("viscous_friction", False) == "N m s/rad"
    assert unit_of("armature", False) == "kg m²" and unit_of("joint_elasticity", True) == "m/N"


def test_an_amount_follows_the_power_law_of_its_cases():
    assert amount_at(20.0, [(10.0, 0.1)]) == pytest.approx(0.2)
    assert amount_at(40.0, [(s, 0.1 * s**0.5) for s in (4.0, 9.0, 25.0)]) == pytest.approx(0.1 * 40**0.5)
