"""Logs at the control period, their windows, noise and velocities."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import Channels, estimate_velocity, noise, read_logs, resample, segments
from bayessim_mjx.logs.signals import noise_level, quantum
from tests.logs.log_files import HEADER, rows, write


def test_irregular_log_is_resampled(tmp_path: Path, arm: mujoco.MjModel) -> None:
    rng = np.random.default_rng(0)
    t = np.sort(0.0053 * np.arange(600) + rng.uniform(-5e-4, 5e-4, 600))
    table = np.stack([t, np.sign(np.sin(9 * t)), t, np.sin(2 * np.pi * 2 * t), np.cos(5 * t)], 1)
    write(tmp_path, table)
    (log,) = read_logs(tmp_path, arm)
    even = resample(log, 0.005)
    grid = t[0] + 0.005 * np.arange(len(even))
    np.testing.assert_allclose(even.time, grid, atol=1e-9)
    np.testing.assert_allclose(even.qpos[:, 0], np.sin(2 * np.pi * 2 * grid), atol=2e-5)  # cubic: h^4 w^4 / 100
    assert np.abs(resample(log, 0.005, "linear").qpos[:, 0] - np.sin(4 * np.pi * grid)).max() < 1e-3
    inner = slice(4, -4)
    assert np.abs(even.qvel[inner, 0] - 4 * np.pi * np.cos(4 * np.pi * grid[inner])).max() < 0.02 * 4 * np.pi
    # the impulse of the held command is kept
    steps = np.diff(np.append(t, grid[-1] + 0.005))
    assert 0.005 * even.ctrl[:, 0].sum() == pytest.approx((table[:, 1] * steps)[: len(t)].sum(), abs=1e-9)
    assert np.abs(even.ctrl[:, 1] - grid).max() < 0.0053 * 1.5


def test_an_even_log_passes_unchanged(tmp_path: Path, arm: mujoco.MjModel) -> None:
    write(tmp_path, rows())
    (log,) = read_logs(tmp_path, arm)
    same = resample(log, 0.01)
    assert np.array_equal(same.ctrl, log.ctrl) and np.array_equal(same.qpos, log.qpos)
    coarse = resample(log, 0.02)  # commands of two rows are averaged over the step they share
    np.testing.assert_allclose(coarse.ctrl[:-1], 0.5 * (log.ctrl[0:-2:2] + log.ctrl[1:-1:2]), atol=1e-9)
    for bad in ({"dt": 0.0}, {"dt": 1e-4}, {"dt": 5.0}, {"dt": 0.005, "kind": "spline"}):
        with pytest.raises(UserError, match="allowed"):
            resample(log, **bad)  # type: ignore[arg-type]


def test_segments(tmp_path: Path, arm: mujoco.MjModel) -> None:
    for k in range(2):
        write(tmp_path, rows(50 - 20 * k), name=f"{k}.csv")
    logs = read_logs(tmp_path, arm)
    data = segments(logs, 10, stride=5)
    assert data["qpos"].shape == (8 + 4, 11, 2) and data["command"].shape == (12, 10, 2)
    assert data["run"].tolist() == [0] * 8 + [1] * 4 and data["start"][:3].tolist() == [0, 5, 10]
    np.testing.assert_array_equal(data["qpos0"], data["qpos"][:, 0])
    np.testing.assert_allclose(data["command"][1], logs[0].ctrl[5:15], rtol=1e-6)
    np.testing.assert_allclose(data["qpos"][9], logs[1].qpos[5:16], rtol=1e-6)
    assert all(v.dtype == np.float32 for k, v in data.items() if k not in ("run", "start"))
    # the recording around each start; beyond the ends of a log the end is held
    near = segments(logs, 10, stride=5, rows=3)
    for name, log, first in (("around_qpos", logs[0].qpos, 0), ("around_command", logs[1].ctrl, 8)):
        assert near[name].shape == (12, 7, 2)
        np.testing.assert_allclose(near[name][first], log[[0, 0, 0, 0, 1, 2, 3]], rtol=1e-6)
        np.testing.assert_allclose(near[name][first + 1], log[2:9], rtol=1e-6)
    assert len(segments(logs[0], 10)["qpos0"]) == 4
    assert segments(logs, 10, dt=0.005)["qpos"].shape == (9 + 5, 11, 2)
    with pytest.raises(UserError, match="no log holds 60 control steps.*'0.csv' with 49.*trainTrajLen"):
        segments(logs, 60)
    with pytest.raises(UserError, match="length = 0"):
        segments(logs, 0)
    with pytest.raises(UserError, match="no logs"):
        segments([], 5)
    with pytest.raises(UserError, match="'1.csv'.*not sampled evenly"):
        segments([logs[0], resample(logs[1], 0.005)], 5)


def test_windows_with_the_drive_off_are_left_out(tmp_path: Path, arm: mujoco.MjModel) -> None:
    on = (np.arange(60) < 33).astype(float)
    write(tmp_path, np.c_[rows(60), on], HEADER + ",enabled:m_elbow")
    (log,) = read_logs(tmp_path, arm)
    assert segments(log, 10)["start"].tolist() == [0, 10, 20]
    fine = resample(log, 0.004)
    assert fine.enabled[:82].all() and not fine.enabled[82:].any()  # rows 0..32 act until t = 0.33 = 82.5 steps
    with pytest.raises(UserError, match="drive switched off"):
        segments(log, 40)


def test_quantum_and_noise() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(2000) / 200
    clean = np.sin(2 * np.pi * t)
    step = 2 * np.pi / 4096
    assert quantum(np.round(clean / step) * step) == pytest.approx(step, rel=1e-6)
    assert quantum(clean) == 0.0 and quantum(np.zeros(50)) == 0.0
    assert noise_level(clean + 3e-3 * rng.standard_normal(2000)) == pytest.approx(3e-3, rel=0.1)
    assert step / np.sqrt(12) <= noise_level(np.round(clean / step) * step) < 1.3 * step / np.sqrt(12)
    assert noise_level(clean) < 1e-6


def test_velocity_from_noisy_positions(arm: mujoco.MjModel) -> None:
    rng = np.random.default_rng(2)
    t = np.arange(1000) / 200
    truth = np.stack([np.cos(6 * t) * 3, -np.sin(15 * t) * 3], 1)
    sigma = np.array([5e-4, 2e-3])
    seen = np.stack([0.5 * np.sin(6 * t), 0.2 * np.cos(15 * t)], 1) + sigma * rng.standard_normal((1000, 2))
    velocity, spread = estimate_velocity(t, seen, Channels.of(arm), sigma)
    rms = np.sqrt(np.mean((velocity - truth) ** 2, axis=0))
    assert (rms < [0.01, 0.04]).all(), rms  # a plain difference gives sigma sqrt(2) 200 = 0.14 and 0.57 rad/s
    assert (rms < 4 * spread).all() and (rms > 0.5 * spread).all()
    lag = np.argmax(np.correlate(velocity[:, 1], truth[:, 1], "full")) - 999
    assert lag == 0  # zero phase


def test_noise_pools_logs(tmp_path: Path, arm: mujoco.MjModel) -> None:
    rng = np.random.default_rng(3)
    for k, sigma in enumerate((1e-3, 3e-3)):
        table = rows(2000, 0.005)
        table[:, 3:] += sigma * rng.standard_normal((2000, 2))
        write(tmp_path, table, name=f"{k}.csv")
    level = noise(read_logs(tmp_path, arm))
    np.testing.assert_allclose(level["qpos"], np.sqrt(5) * 1e-3, rtol=0.1)
    assert level["qvel"].shape == (2,)


def test_shifts_of_commands_add_up(tmp_path: Path, arm: mujoco.MjModel) -> None:
    """A step at 0.1 s that acts 0.02 s late, and 0.03 s later still."""
    table = rows()
    table[:, 1] = table[:, 0] > 0.0999
    write(tmp_path, table)
    (log,) = read_logs(tmp_path, arm)
    twice = log.shifted(0.02).shifted(0.03)
    assert twice.late == pytest.approx(0.05) and twice.shifted(-0.05).late == pytest.approx(0.0)
    late = resample(twice, 0.01)
    assert late.late == 0.0  # done with
    np.testing.assert_allclose(late.ctrl[:, 0], late.time > 0.1499, atol=1e-9)
