"""A fair race that can be killed: ranges that grow to hold the truth, fits that are found again, limits of time."""

import dataclasses
import itertools

import numpy as np
import pytest

from bayessim_mjx.diagnosis import run
from bayessim_mjx.diagnosis.evidence import selecting
from bayessim_mjx.diagnosis.phrases import effects as phrases
from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.selection import successive_halving
from bayessim_mjx.diagnosis.selection.numbers import Budget
from bayessim_mjx.diagnosis.setup import prepare
from bayessim_mjx.diagnosis.summary.assemble import not_fitted, not_tried

from .pendulums import nominal, recorded

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole searches

CUBIC = 2.0  # N m/rad^3
SPRING = "joint_spring@hinge"


@pytest.fixture(scope="module")
def setup(tmp_path_factory):
    """Of a pendulum with a cubic spring, whose range ends at a fifth of the truth."""
    request = Request(["joint_spring", "coulomb_friction", "viscous_friction"])
    logs = recorded(cubic=CUBIC, count=6, seconds=2.0)
    found = prepare(nominal(tmp_path_factory.mktemp("spring")), logs, request)
    return dataclasses.replace(found, candidates=tuple(map(narrowed, found.candidates)))


def narrowed(candidate):
    if candidate.label != SPRING:
        return candidate
    stiffness, cubic, rest = candidate.coordinates
    short = dataclasses.replace(cubic, high=CUBIC / 5, precision=(5 / CUBIC) ** 2)
    probes = np.minimum(candidate.probes, [stiffness.high, short.high, rest.high])
    return dataclasses.replace(candidate, coordinates=(stiffness, short, rest), probes=probes)


def searched(setup, say=lambda *told: None, **budget):
    settings = dataclasses.replace(setup.settings, budget=Budget(**budget))
    return selecting.select(setup.fitter, setup.candidates, settings, say)


@pytest.fixture(scope="module")
def counted_whole(setup):
    """A search that nobody kills, without a folder, and the windows that it simulated."""
    before = setup.fitter.simulator.rollouts
    return searched(setup), setup.fitter.simulator.rollouts - before


@pytest.fixture(scope="module")
def whole(counted_whole):
    return counted_whole[0]


def test_a_truth_five_times_beyond_its_range_is_found(whole):
    (effect,) = whole.answer.effects
    assert effect.label == SPRING
    values = dict(
        zip([c.name.rpartition(".")[2] for c in effect.coordinates], whole.answer.values_of(effect), strict=True)
    )
    assert values["cubic"] == pytest.approx(CUBIC, rel=0.05)
    cubic = next(c for c in effect.coordinates if c.name.endswith("cubic"))
    assert CUBIC < cubic.high <= 4 * CUBIC and not whole.state.above_noise(whole.answer)


def test_a_killed_search_goes_on_and_comes_to_the_same(setup, counted_whole, tmp_path):
    class Killed(Exception):
        pass

    (whole, cost), counted = counted_whole, itertools.count()

    def say(text, done, total):
        if text == "final fits" and next(counted) == 1:
            raise Killed

    simulator = setup.fitter.simulator
    with pytest.raises(Killed):
        searched(run.remembering(setup, tmp_path), say)
    before, again = simulator.rollouts, run.remembering(setup, tmp_path)
    rest = searched(again)
    there = again.fitter.journal.found
    assert there > 3 and rest.answer.label == whole.answer.label
    assert np.array_equal(rest.answer.fit.values, whole.answer.fit.values)
    assert {k: m.total for k, m in rest.state.models.items()} == {k: m.total for k, m in whole.state.models.items()}
    assert simulator.rollouts - before < 0.7 * cost


def test_without_time_the_first_answer_says_what_was_not_tried(setup, monkeypatch):
    """The clock strikes whenever it is read: the first effect is fitted, the others have no time."""
    clock = itertools.count()
    monkeypatch.setattr(successive_halving, "EFFORT", dataclasses.replace(successive_halving.EFFORT, sets=(1,)))
    short = searched(setup, seconds=27.0, now=lambda: float(next(clock)))
    assert short.answer.label == SPRING and len(short.state.cut_short) == 2
    assert not_fitted(short.state) == {phrases.NO_TIME_LEFT: sorted(short.state.cut_short, key=labels(setup).index)}
    assert "2 single effects" in not_tried(short.state)["parts"]


def test_when_the_time_is_over_the_verdict_rests_on_what_is_fitted(setup, counted_whole):
    """The clock strikes with the first model that is polished: nothing else is fitted, and the rest is short."""
    simulator, at = setup.fitter.simulator, {"now": 0.0}

    def say(text, done, total):
        if text == "final fits" and "rollouts" not in at:
            at.update(now=1e9, rollouts=simulator.rollouts)

    short = searched(setup, say, seconds=1.0, now=lambda: at["now"])
    assert short.answer.label == SPRING
    assert simulator.rollouts - at["rollouts"] < 0.3 * counted_whole[1]


def labels(setup):
    return [c.label for c in setup.candidates]
