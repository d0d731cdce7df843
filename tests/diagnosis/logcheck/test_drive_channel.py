"""What a drive does with its command, from efforts that were made of the commands by hand."""

import dataclasses

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.logcheck.links import Channel, channels_of
from bayessim_mjx.logs import Log
from tests.diagnosis.recordings import ARM, record, sines

GAIN, CONSTANT, ROWS = 0.9, 0.4, 3


@pytest.fixture(scope="module")
def arm() -> Log:
    return record(ARM, sines((3.0, 0.6)))


def channels(arm: Log, elbow: np.ndarray, noise: float = 0.01) -> tuple[Channel, ...]:
    """Of a shoulder that obeys, and an elbow whose effort is given; its motors have the gain 1."""
    rng = np.random.default_rng(0)
    each = np.stack([arm.ctrl[:, 0], elbow], 1)
    each = each + noise * np.sqrt(np.mean(each**2, 0)) * rng.normal(size=each.shape)
    streams = {f"effort:{a}": each[:, i] for i, a in enumerate(arm.actuators)}
    log = dataclasses.replace(arm, streams=streams)
    return channels_of([log], mujoco.MjModel.from_xml_string(ARM), True)


def test_a_drive_that_obeys_is_sound(arm: Log) -> None:
    for c in channels(arm, arm.ctrl[:, 1]):
        assert c.sound and c.static and c.identified and not c.echo and c.off == 1.0 and c.shifted == 0.0
        # an effort at its command's stamp comes half a row before the middle of the time for which the command holds
        assert c.scale == pytest.approx(1.0, abs=0.01) and c.late == pytest.approx(-arm.period / 2, abs=1e-3)


def test_a_gain_and_a_constant_are_named_with_their_sizes(arm: Log) -> None:
    shoulder, elbow = channels(arm, GAIN * arm.ctrl[:, 1] + CONSTANT)
    assert shoulder.sound and not elbow.sound
    assert elbow.off == pytest.approx(GAIN, abs=0.01) and elbow.shifted == pytest.approx(CONSTANT, abs=0.01)


def test_a_late_drive_is_static_but_not_sound(arm: Log) -> None:
    elbow = np.concatenate([np.full(ROWS, arm.ctrl[0, 1]), arm.ctrl[:-ROWS, 1]])
    late = channels(arm, elbow)[1]
    assert late.static and late.off == 1.0 and not late.sound
    assert late.late == pytest.approx((ROWS - 0.5) * arm.period, abs=1e-3)


def test_a_drive_that_saturates_is_not_static(arm: Log) -> None:
    limit = 0.6 * np.abs(arm.ctrl[:, 1]).max()
    assert not channels(arm, np.clip(arm.ctrl[:, 1], -limit, limit))[1].static


def test_a_logged_command_is_no_measured_effort(arm: Log) -> None:
    assert all(c.echo and c.off == 1.0 and not c.static for c in channels(arm, 2.0 * arm.ctrl[:, 1], noise=0.0))
