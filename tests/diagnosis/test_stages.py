"""Stages after the selection: what needs nothing of the others goes on beside them, and nothing of it is lost."""

import dataclasses
import threading
from types import MappingProxyType

import pytest

from bayessim_mjx.diagnosis.findings import Findings, Observer, Stage, carry_out
from bayessim_mjx.diagnosis.selection.numbers import Budget


class First:
    """A part."""


class Second:
    """Another."""


@pytest.fixture
def found():
    return Findings(None, None, parts=MappingProxyType({str: "before"}), warnings=("before",))


def adding(part, meeting=None):
    """A stage's function; meeting: a barrier that both of two stages have to reach."""

    def run(found, say):
        if meeting is not None:
            meeting.wait(timeout=10)
        return dataclasses.replace(found.having(part), warnings=(*found.warnings, type(part).__name__))

    return run


def test_stages_beside_each_other_go_on_at_once_and_their_parts_are_joined(found):
    meeting = threading.Barrier(2)  # one after the other would wait for ever
    stages = [Stage("a", adding(First(), meeting), beside=True), Stage("b", adding(Second(), meeting), beside=True)]
    after = carry_out(stages, found, Budget(), Observer())
    assert set(after.parts) == {str, First, Second} and after.parts[str] == "before"
    assert after.warnings == ("before", "First", "Second")


def test_under_a_limit_they_take_turns_and_are_left_out_once_the_time_is_over(found):
    clock = [0.0]

    def slow(found, say):
        clock[0] = 9.0
        return found.having(First())

    stages = [Stage("a", slow, beside=True, patient=True), Stage("b", adding(Second()), beside=True, patient=True)]
    after = carry_out(stages, found, Budget(10.0, 0.0, lambda: clock[0]), Observer())
    assert First in after.parts and Second not in after.parts
    assert after.warnings == ("before", "the time was over, so these are left out: b")


@pytest.mark.parametrize("limit", [float("inf"), 10.0])
def test_the_verdict_has_what_is_needed_and_waits_for_nothing_that_is_optional(found, limit):
    told, seen = threading.Event(), []

    def optional(found, say):
        assert told.wait(timeout=10)
        raise ValueError("a picture less")

    class Waits(Observer):
        def verdict(self, found):
            seen.append(found)
            told.set()

    stages = [
        Stage("first", adding(First())),
        Stage("second", adding(Second()), beside=True),
        Stage("maps", optional, optional=True, beside=True),
    ]
    after = carry_out(stages, found, Budget(limit, 0.0, lambda: 0.0), Waits())
    (one,) = seen
    assert set(one.parts) == {str, First, Second} and one.warnings == ("before", "First", "Second")
    assert after.parts == one.parts
    assert after.warnings == (*one.warnings, "maps: not available (ValueError: a picture less)")


@pytest.mark.parametrize("beside", [True, False])
def test_a_stage_that_is_needed_is_not_lost_in_silence(found, beside):
    def fails(found, say):
        raise ValueError("no verdict")

    with pytest.raises(ValueError, match="no verdict"):
        carry_out(
            [Stage("a", fails, beside=beside), Stage("b", adding(First()), beside=True)], found, Budget(), Observer()
        )
