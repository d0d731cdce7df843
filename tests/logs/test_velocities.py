"""Velocities that a filter would take for on time: those that their positions do not bear out are left out."""

import re
from dataclasses import replace

import numpy as np
import pytest

from bayessim_mjx.logs.velocities import agreeing, trusted, velocities
from tests.diagnosis.recordings import ARM, record, sines

PERIOD = 0.01


@pytest.fixture(scope="module")
def logs():
    return [record(ARM, sines((3.0, 0.6), seed=k), qvel=True, name=f"run{k}.npz", seed=k) for k in range(3)]


def late(log, rows, column=1):
    """Return the elbow's velocity `rows` rows late."""
    qvel = log.qvel.copy()
    qvel[rows:, column] = log.qvel[:-rows, column]
    return replace(log, qvel=qvel)


def test_velocities_on_time_are_left_as_they_are(logs):
    same, notes = trusted(logs, PERIOD)
    assert notes == [] and all(a is b for a, b in zip(same, logs, strict=True))


def test_a_late_velocity_is_replaced_by_its_positions_derivative_and_told(logs):
    wrong = [late(log, 4) for log in logs]
    found, (note,) = trusted(wrong, PERIOD)
    assert (
        "qvel:elbow" in note
        and re.search(r"\+4[01] ms late", note)
        and "3 of 3 logs" in note
        and "positions are used" in note
    )
    for log, before, true in zip(found, wrong, logs, strict=True):
        assert log.seen_speeds.tolist() == [True, False] and log.has_qvel and log.lost == ()
        np.testing.assert_array_equal(log.qvel[:, 0], before.qvel[:, 0])
        error = [np.sqrt(np.mean((x.qvel[50:-50, 1] - true.qvel[50:-50, 1]) ** 2)) for x in (log, before)]
        assert error[0] < 0.2 * error[1]


def test_logs_whose_velocities_are_all_wrong_have_none_measured(logs):
    wrong = [replace(log, qvel=np.degrees(log.qvel)) for log in logs]
    found, notes = trusted(wrong, PERIOD)
    assert len(notes) == 2 and not any(log.has_qvel or log.absent for log in found)


def test_one_log_of_three_proves_nothing(logs):
    one = [late(logs[0], 4), *logs[1:]]
    assert trusted(one, PERIOD)[1] == []
    seen = [v for log in one for v in velocities(log)]
    assert agreeing(seen, PERIOD) == {"shoulder": True, "elbow": True}


def test_a_joint_that_shows_one_position_has_no_derivative_to_compare_with(logs):
    """A held joint behind an encoder: its velocity is noise, and a derivative of rounding errors says nothing."""
    rng = np.random.default_rng(0)
    qpos, qvel = (np.array(x) for x in (logs[0].qpos, logs[0].qvel))
    qpos[:, 1], qvel[:, 1] = 0.6059, 1e-3 * rng.normal(size=len(qvel))
    held = replace(logs[0], qpos=qpos, qvel=qvel, sigma_qpos=logs[0].sigma_qpos * [1.0, 0.0])
    assert [v.channel for v in velocities(held)] == ["shoulder"]
