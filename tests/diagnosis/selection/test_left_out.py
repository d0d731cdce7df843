"""What a search did not fit is listed with the reason; a limit of time is told."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.phrases import effects as phrases
from bayessim_mjx.diagnosis.phrases import notes
from bayessim_mjx.diagnosis.selection import successive_halving
from bayessim_mjx.diagnosis.selection.numbers import ENDS, Budget, begun
from bayessim_mjx.diagnosis.selection.search_state import Settings
from bayessim_mjx.diagnosis.summary.assemble import not_fitted, not_tried


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
    assert not_tried(tried({}, [])) == {}
    short = tried({}, [], ["a@h", "b@h"], {"single effects": 2, "2 effects": 30}, budget=Budget(120.0))
    told = "In 2 minutes not everything was tried: no time for 2 single effects and 30 models (2 effects)."
    assert notes.not_tried(not_tried(short)) == told


def test_parts_end_one_after_the_other_and_without_a_limit_never():
    clock = iter([42.0, 43.0, 70.0])
    budget = Budget(100.0, 0.0, lambda: next(clock))
    assert [budget.over(part) for part in ("single effects", "single effects", "leaving out")] == [False, True, False]
    assert list(ENDS.values()) == sorted(ENDS.values())
    assert not begun(None).over("screening") and not begun(None).limited
    assert begun(2.0).left("single effects") == pytest.approx(120 * ENDS["single effects"], abs=1.0)


def test_parts_share_what_is_left_once_the_simulator_is_compiled():
    """Of 100 s 40 are gone: parts have shares of 60 s after them, and with all of it gone nothing has time."""
    now = {"s": 40.0}
    budget = Budget(100.0, 0.0, lambda: now["s"]).searching()
    assert budget.left("single effects") == pytest.approx(60 * ENDS["single effects"])
    now["s"] = 40 + 60 * ENDS["single effects"] + 1
    assert budget.over("single effects") and not budget.over("effects together")
    late = Budget(100.0, 0.0, lambda: 130.0).searching()
    assert late.fixed == 100 and all(late.over(part) for part in ENDS)
    assert begun(None).searching() == begun(None)
    told = notes.not_tried(not_tried(tried({}, [], ["a@h"], {}, budget=budget)))
    assert told.endswith("Before the search, reading the logs and compiling took 0.67 of them.")


@dataclasses.dataclass(frozen=True)
class Rough:
    """A fit that says how many steps were made in all."""

    steps: int = 0
    coordinates: tuple = ()
    history: tuple = ()
    damping: float = 0.0
    reach: float = 1.0
    r: tuple = (0, 0)


class Slow:
    """Each step of a fit takes ten seconds."""

    base = ()

    def __init__(self):
        self.seconds, self.refreshed, self.simulator = 0.0, 0, SimpleNamespace(rollouts=0)

    def begin(self, coordinates):
        return Rough()

    def refresh(self, fit):
        self.refreshed += 1
        return fit

    def iterate(self, fits, iterations, fresh, keep):
        (fit,) = fits
        for made in range(iterations):
            if not list(keep(made, [fit], range(1))):
                break
            fit = dataclasses.replace(fit, steps=fit.steps + 1)
            self.seconds, self.simulator.rollouts = self.seconds + 10, self.simulator.rollouts + 100
        return [fit]


@pytest.mark.parametrize(
    ("limit", "steps", "refreshed", "windows"), [(630.0, 9, 1, 11), (1e9, 24, 2, 20), (4000.0, 24, 2, 20)]
)
def test_the_fit_of_the_known_parameters_ends_with_its_share_of_the_time(monkeypatch, limit, steps, refreshed, windows):
    """Twelve steps twice where there is time for them; a seventh of 630 s is nine. Windows are then as time allows."""
    fitter, seen = Slow(), {}
    settings = Settings(budget=Budget(limit, 0.0, lambda: fitter.seconds), screened=20)
    candidates = [SimpleNamespace(probes=np.zeros((40, 1)))] * 2

    def screen(fitter, fit, candidates, screened, say, secants, over):
        seen.update(steps=fit.steps, screened=screened)
        return []

    monkeypatch.setattr(successive_halving, "scored", lambda fitter, fit, effects: SimpleNamespace(fit=fit))
    monkeypatch.setattr(successive_halving, "screen", screen)
    monkeypatch.setattr(successive_halving.SearchState, "rough", False)
    monkeypatch.setattr(successive_halving.SearchState, "begun", lambda pool, fit: fit)
    successive_halving.begin(fitter, candidates, settings)
    assert (seen["steps"], fitter.refreshed) == (steps, refreshed)
    assert seen["screened"] == windows  # 90 s for 80 points at .1 s a window are 11
