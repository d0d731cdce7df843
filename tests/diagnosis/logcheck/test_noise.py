"""Runs of the same commands are found, and named where they are declared."""

import dataclasses

import pytest

from bayessim_mjx.diagnosis.logcheck.noise import repeats
from bayessim_mjx.errors import UserError
from tests.diagnosis.recordings import PENDULUM, record, sines


def test_runs_of_the_same_commands_are_one_group() -> None:
    runs = [record(PENDULUM, sines((1.0,)), sigma=2e-3, seed=k, name=f"{k}.npz") for k in range(4)]
    runs.append(record(PENDULUM, sines((1.0,), seed=9), name="other.npz"))
    assert [[log.name for log in group] for group in repeats(runs)] == [["0.npz", "1.npz", "2.npz", "3.npz"]]


def test_a_repeat_is_what_is_declared_and_of_nobody_none() -> None:
    log = record(PENDULUM, sines((1.0,)))
    assert repeats([log]) == []
    assert repeats([dataclasses.replace(log, metadata={"repeat_of": "nobody"})]) == []
    again = dataclasses.replace(log, name="again", ctrl=log.ctrl + 1.0, metadata={"repeat_of": log.name})
    assert repeats([log, again]) == [[log, again]]


def test_logs_of_different_robots_are_refused() -> None:
    log = record(PENDULUM, sines((1.0,)), seconds=1.0)
    other = dataclasses.replace(log, name="b.npz", channels=dataclasses.replace(log.channels, qpos=("elbow",)))
    with pytest.raises(UserError, match="'b.npz' has other channels than"):
        repeats([log, other])
