"""What a search did not fit is listed with the reason; a limit of time is told."""

from types import SimpleNamespace

import pytest

from bayessim_mjx.diagnosis import phrases
from bayessim_mjx.diagnosis.selection.budget import ENDS, Budget, begun
from bayessim_mjx.diagnosis.selection.left_out import not_fitted, not_tried
from bayessim_mjx.diagnosis.selection.tried import Settings


def tried(gains, fitted, cut_short=(), skipped=None, above=True, **settings):
    return SimpleNamespace(
        candidates=[SimpleNamespace(label=label) for label in [*gains, "late@b"]],
        models={frozenset(): None, **{frozenset(f): None for f in fitted}},
        screened=[SimpleNamespace(candidate=SimpleNamespace(label=n), gain=g) for n, g in gains.items()],
        base=None, above_noise=lambda model: above, cut_short=set(cut_short), skipped=skipped or {},
        settings=Settings(**settings),
    )  # fmt: skip


def test_every_candidate_is_in_a_model_or_has_a_reason():
    gains = {"a@h": 5.0, "b@h": 4.0, "c@h": 3.0, "d@h": 0.0, "e@h": 2.0}
    found = tried(gains, [["a@h"], ["a@h", "b@h"]], cut_short=["e@h"])
    assert not_fitted(found) == {
        phrases.LESS_PROMISING: ["c@h"], phrases.NO_GAIN: ["d@h"], phrases.NO_TIME_LEFT: ["e@h"],
        phrases.NOT_SCREENED: ["late@b"],
    }  # fmt: skip
    assert phrases.NOTHING_LEFT in not_fitted(tried(gains, [], above=False))


def test_what_there_was_no_time_for_is_told_in_words():
    assert not_tried(tried({}, [])) == ""
    short = tried({}, [], ["a@h", "b@h"], {"single effects": 2, "2 effects": 30}, budget=Budget(120.0))
    told = "In 2 minutes not everything was tried: no time was left for 2 single effects and 30 models (2 effects)."
    assert not_tried(short) == told


def test_parts_end_one_after_the_other_and_without_a_limit_never():
    clock = iter([30.0, 55.0, 60.0])
    budget = Budget(100.0, 0.0, lambda: next(clock))
    assert [budget.over(part) for part in ("single effects", "single effects", "finalists")] == [False, True, False]
    assert list(ENDS.values()) == sorted(ENDS.values())
    assert not begun(None).over("screening") and not begun(None).limited
    assert begun(2.0).left("single effects") == pytest.approx(120 * ENDS["single effects"], abs=1.0)
