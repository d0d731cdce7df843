"""Joints that keep their speed: nothing is left of a straight motion, of a bent one what a weighted line leaves."""

import dataclasses

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.diagnosis.phrases.verdict import coasting
from bayessim_mjx.diagnosis.result import Gap
from bayessim_mjx.diagnosis.summary.how_far import constant_velocity_baseline
from tests.diagnosis.pendulums import ARMATURE, DAMPING, MASS, MODEL, PERIOD, STEP, recorded

LENGTH = 25
PENDULUM = mujoco.MjModel.from_xml_string(MODEL % (STEP, "Euler", DAMPING, ARMATURE, 0.0, MASS))
FREE = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
)


def moving(qpos, qvel, use_qvel=True):
    """Windows of one log with this motion of the pendulum."""
    (log,) = recorded(count=1, seconds=2.0)
    motion = {"qpos": qpos(log.time)[:, None], "qvel": qvel(log.time)[:, None]}
    log = dataclasses.replace(log, has_qvel=True, **motion)
    return windows.cut([log], PENDULUM, PERIOD, 10, LENGTH, limit=99, use_qvel=use_qvel)


def test_nothing_is_left_of_a_straight_motion():
    found = constant_velocity_baseline(moving(lambda t: 0.3 + 0.7 * t, lambda t: 0.7 + 0 * t), PENDULUM)
    np.testing.assert_allclose(found.error, 0, atol=2e-2)  # in noises: positions are kept in float32
    np.testing.assert_allclose(found.offsets, 0, atol=1e-4)


@pytest.mark.parametrize("use_qvel", [True, False])
def test_a_bent_motion_leaves_what_a_weighted_line_leaves(use_qvel):
    cut = moving(lambda t: t**2, lambda t: 2 * t, use_qvel)
    found = constant_velocity_baseline(cut, PENDULUM)
    t, nothing = PERIOD * np.arange(1, LENGTH + 1), np.zeros(LENGTH)
    for w, row in enumerate(found.error):
        begin = PERIOD * cut.start[w]
        # rows of least squares in (position, speed) at the start: positions, speeds, the start state's own spread
        place, speed = (begin + t) ** 2 - begin**2 - 2 * begin * t, 2 * t
        design = [np.stack([nothing + 1, t], 1) / cut.sigma_q, np.stack([nothing, nothing + 1], 1) / cut.sigma_v]
        left = np.concatenate([place / cut.sigma_q, speed / cut.sigma_v * np.isfinite(cut.sigma_v)])
        both, target = np.concatenate([*design, np.diag(1 / cut.spread)]), np.concatenate([left, [0, 0]])
        line = np.linalg.lstsq(both, target, rcond=None)[0]
        rest = (target - both @ line)[: LENGTH * (1 + use_qvel)]
        np.testing.assert_allclose(row.T.ravel(), rest, atol=1e-3 * np.abs(rest).max())
        np.testing.assert_allclose(found.offsets[w], line, rtol=1e-3)
    assert found.error.shape[2] == 1 + use_qvel


def test_a_body_that_turns_evenly_coasts():
    (log,) = recorded(count=1, seconds=2.0)
    turned = np.zeros((len(log), 7))
    for row, time in zip(turned, log.time, strict=True):
        row[:3] = time
        mujoco.mju_axisAngle2Quat(row[3:], np.array([0.0, 0.6, 0.8]), 3.0 * time)
    speeds = np.tile([1.0, 1.0, 1.0, 0.0, 1.8, 2.4], (len(log), 1))
    cut = windows.cut([log], PENDULUM, PERIOD, 10, LENGTH, limit=4)
    pick = cut.start[:, None] + 1 + np.arange(LENGTH)
    around = cut.batch.around
    rows = np.clip(cut.start[:, None] + np.arange(around.qpos.shape[1]) - around.start, 0, len(log) - 1)
    batch = cut.batch.replace(
        qpos=turned[pick], qvel=speeds[pick], around=around.replace(qpos=turned[rows], qvel=speeds[rows])
    )
    six = {"sigma_q": np.full(6, 1e-3), "sigma_v": np.full(6, np.inf), "spread": np.full(12, 1e-2)}
    found = constant_velocity_baseline(dataclasses.replace(cut, batch=batch, **six), FREE)
    assert found.error.shape == (4, LENGTH, 6)
    np.testing.assert_allclose(found.error, 0, atol=1e-6)


def test_a_simulator_that_is_worse_than_none_is_told():
    known = Gap(1.0, 300.0, 222.0, 26.6, 1.0, coasting=32.3)
    # 1 - (26.6^2 - 1) / (32.3^2 - 1)
    told = coasting(known, named=True)
    assert "32.3 noise sd off, less than the recalibrated simulator's 222. " in told
    assert "The effects close 32 % of the squared gap of such joints." in told
    assert "effects" not in coasting(known, named=False)
    assert coasting(dataclasses.replace(known, coasting=250.0), named=True) == ""
    assert coasting(dataclasses.replace(known, coasting=None), named=True) == ""
