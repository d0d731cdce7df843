"""Which of many fits in lockstep go on, also in a search that goes on from what is on disk."""

from types import SimpleNamespace

import pytest

from bayessim_mjx.diagnosis.selection.successive_halving import SuccessiveHalving


def fit(*history):
    return SimpleNamespace(cost=history[-1], history=history, promise=0.0)


def test_starts_behind_their_own_best_stop_and_candidates_far_behind_the_best():
    halving = SuccessiveHalving(lambda: False)
    fits = [fit(90, 10), fit(95, 39), fit(99, 41), fit(200, 170)]  # three starts of one candidate, one of another
    going = halving.among([3, 1])
    assert going(1, fits, range(4)) == [0, 1, 2, 3]  # one more step like the last brings the third and the last close
    slow = [fit(10, 10), fit(41, 39), fit(42.5, 42), fit(150, 149)]
    assert going(1, slow, range(4)) == [0, 1, 3]
    assert going(2, slow, range(4)) == [0]  # 1.75 times the best start, seven times the best candidate
    assert going(2, [fit(10, 10), fit(40, 26), fit(41, 26.7), fit(90, 80)], range(4)) == [
        0,
        1,
        2,
    ]  # 26.7^2 / 41 is 17.4
    assert SuccessiveHalving(lambda: True).among([1])(1, [fit(1, 1)], [0]) == []


def test_fits_from_the_disk_set_the_same_pace_as_those_that_were_made():
    rows = [(90, 40, 30, 22, 21, 20), (95, 50), (80, 60, 25, 24)]
    made = SuccessiveHalving(lambda: False)
    for step in range(6):
        now = [fit(*row[: step + 1]) for row in rows]  # settled ones stay as they are
        made.among([1, 1, 1])(step, now, range(3))
    read = SuccessiveHalving(lambda: False)
    read.learn([fit(*row) for row in rows])
    assert {at: read.pace[at] for at in range(1, 6)} == {at: made.pace[at] for at in range(1, 6)}
    made.learn([fit(*row) for row in rows])
    assert {at: made.pace[at] for at in read.pace} == pytest.approx(read.pace)


def test_finalists_race_as_starts_of_one_model_but_those_that_may_still_be_the_answer_go_on():
    finals = SuccessiveHalving(lambda: False).finals()
    fits = [fit(9e5, 1000.0), fit(9e5, 1055.0), fit(9e5, 1065.0), fit(9e5, 3900.0)]
    assert finals(0, fits, range(4)) == [0, 1, 2, 3]  # each makes one step
    still = [fit(f.cost, f.cost) for f in fits]  # and gains no more
    assert finals(1, still, range(4)) == [0, 1, 2, 3]  # 4 times the best
    assert finals(3, still, range(4)) == [0, 1, 2]  # 1 + 3 / 16
    assert finals(9, still, range(4)) == [0, 1]  # 30 nats are twice that in a cost
    assert SuccessiveHalving(lambda: True).finals()(1, fits, [0]) == []
