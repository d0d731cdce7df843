"""Noise of a joint that shows one value or two: nothing tells it, so the joint has no say and no false precision."""

import dataclasses

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis import request
from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.diagnosis.logcheck import noise
from bayessim_mjx.diagnosis.logcheck.noise import noise_free, noise_known
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import Log
from tests.diagnosis.recordings import ARM, make

COUNT = 2 * np.pi / 4096  # rad, of a 12-bit encoder
SIGMA = COUNT / np.sqrt(12)
HELD = float(np.round(0.3 / COUNT) * COUNT)
ROWS, PERIOD = 400, 0.01


@pytest.fixture(scope="module")
def arm() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ARM)


def swung(arm: mujoco.MjModel, elbow: np.ndarray, name: str = "run", **metadata: object) -> Log:
    """The shoulder swings behind its encoder; the elbow shows what is given."""
    time = PERIOD * np.arange(ROWS)
    shoulder = np.round((np.sin(4 * time) + 0.2 * np.sin(11 * time)) / COUNT) * COUNT
    qpos = np.stack([shoulder, np.broadcast_to(elbow, ROWS)], 1)
    return make(arm, time, np.zeros((ROWS, 2)), qpos, name=name, metadata=dict(metadata))


def counts(*shown: int) -> np.ndarray:
    """An elbow that changes between some counts a few times."""
    return HELD + COUNT * np.resize(np.repeat(shown, 40), ROWS)


def cut(arm: mujoco.MjModel, logs: list[Log]) -> windows.Windows:
    return windows.cut(logs, arm, PERIOD, 4, 25, limit=99)


@pytest.mark.parametrize("elbows", [[HELD, HELD], [HELD, counts(0, 1)], [HELD, HELD + 1e-9 * np.arange(ROWS) % 1e-7]])
def test_fewer_than_three_values_in_every_log_tell_no_noise(arm, elbows):
    logs = [swung(arm, e, f"{k}.npz") for k, e in enumerate(elbows)]
    found = cut(arm, logs)
    assert found.sigma_q[0] == pytest.approx(SIGMA, rel=0.3) and np.isinf(found.sigma_q[1])
    assert found.spread[1] == pytest.approx(3 * found.sigma_q[0])  # as uncertain as the usual sensor leaves a start
    assert np.isfinite(found.spread).all() and (found.spread > 1e-6).all()
    (text,) = noise.not_compared(logs)
    assert text.startswith("qpos:elbow: fewer than 3 values") and "quantum" in text
    assert not noise_free(logs, 1)  # or the time step's own error would be its noise
    limit = request.judge(arm, {}, np.array([2.0, 0.0]), noise.noise_of_positions(logs)).limit
    assert np.isfinite(limit[0]) and np.isinf(limit[1])  # no step is too coarse for it


def test_noise_is_pooled_over_the_logs_that_tell_it(arm):
    """One of four logs shows three counts: its noise is that of the encoder, not half of it."""
    logs = [swung(arm, e, f"{k}.npz") for k, e in enumerate([HELD, HELD, counts(0, 1), counts(0, 1, 2)])]
    assert [bool(noise_known(log)[1]) for log in logs] == [False, False, False, True]
    assert cut(arm, logs).sigma_q[1] == pytest.approx(SIGMA, rel=0.05)
    assert not noise.not_compared(logs)


@pytest.mark.parametrize("known", [{"quantum": {"qpos:elbow": COUNT}}, {"sigma": {"elbow": SIGMA}}])
def test_a_stated_resolution_counts(arm, known):
    stated = dataclasses.replace(swung(arm, np.full(ROWS, HELD), **known), sigma_qpos=np.array([SIGMA, SIGMA]))
    assert cut(arm, [stated]).sigma_q[1] == pytest.approx(SIGMA) and not noise.not_compared([stated])
    given = dataclasses.replace(stated, metadata={})  # by a log made in Python
    assert cut(arm, [given]).sigma_q[1] == pytest.approx(SIGMA)


def test_where_no_channel_tells_its_noise_that_is_said(arm):
    still = swung(arm, np.full(ROWS, HELD))
    still = dataclasses.replace(still, qpos=np.full((ROWS, 2), HELD), sigma_qpos=np.zeros(2))
    with pytest.raises(UserError, match="no position shows 3 values in any log.*quantum"):
        cut(arm, [still])


def test_a_spline_through_two_values_shows_no_more(arm):
    slow = swung(arm, counts(0, 1))
    assert np.isinf(windows.cut([slow], arm, PERIOD / 3, 4, 25, limit=99).sigma_q[1])


def test_a_measured_velocity_that_shows_one_value_is_not_compared(arm):
    log = swung(arm, np.full(ROWS, HELD))
    qvel = np.stack([np.round(np.cos(4 * log.time), 3), np.zeros(ROWS)], 1)
    measured = dataclasses.replace(log, has_qvel=True, qvel=qvel, sigma_qvel=np.array([1e-3, 0.0]))
    assert np.isfinite(cut(arm, [measured]).sigma_v).tolist() == [True, False]


@pytest.mark.parametrize(("grain", "free"), [(COUNT, False), (0.0, True)])
def test_rest_is_neither_noise_nor_its_absence(arm, grain, free):
    """Most of the time at rest without dither: an encoder still has steps in motion, a simulation has none."""
    time = PERIOD * np.arange(ROWS)
    moved = np.sin(6 * np.clip(time - 2.6, 0.0, None))  # at rest for two thirds
    shown = np.round(moved / grain) * grain if grain else moved
    assert np.mean(np.diff(shown, 8) == 0) > 0.5
    assert noise_free([swung(arm, shown)], 1) == free


def test_windows_tell_what_share_of_their_rows_was_measured(arm):
    """A log of a fifth of the rate has five rows compared for each that was measured."""
    slow = swung(arm, counts(0, 1, 2), "slow.npz")
    fast = dataclasses.replace(swung(arm, counts(0, 1, 2), "fast.npz"), time=0.2 * slow.time)
    found = windows.cut([slow, fast], arm, PERIOD / 5, 4, 25, limit=99)
    np.testing.assert_allclose(found.measured, np.where(found.log == 0, 0.2, 1.0), rtol=1e-9)
