"""Noise of a sensor and the work of a force are told apart on a mass whose forces and measurements are made up."""

import numpy as np
import pytest
from scipy.signal import lfilter

from bayessim_mjx.diagnosis.residual.disturbance import origin

STEPS, WINDOWS, DT = 40, 40, 0.0125


def columns(steps=STEPS):
    """(start columns, force columns) of a mass of which the position is measured, in noise sd."""
    t = np.arange(steps) * DT
    push = np.tril(np.subtract.outer(np.arange(steps), np.arange(steps)), -1) * DT**2  # position per unit of force
    tile = lambda a: np.repeat(a[None], WINDOWS, 0)  # noqa: E731
    return tile(np.stack([np.ones(steps), t], 1)), tile(push / DT**2 / 50)


def coloured(rng, memory, steps=STEPS):
    white = rng.normal(size=(WINDOWS, steps + 100))
    return lfilter([np.sqrt(1 - memory**2)], [1, -memory], white, axis=1)[:, 100:]


@pytest.mark.parametrize(("size", "memory"), [(3.0, 0.0), (3.0, 0.8), (6.0, 0.9)])
def test_larger_and_coloured_noise_of_sensors(size, memory):
    """60 ms of memory at 80 Hz are .8 a row."""
    rng, (B, D) = np.random.default_rng(0), columns()
    r = rng.normal(size=(WINDOWS, STEPS)) + size * coloured(rng, memory)
    found = origin(r, B, D, np.ones(1), 1, np.ones(WINDOWS))
    assert found.of_sensors and (found.memory > 0) == (memory > 0)


@pytest.mark.parametrize("memory", [0.5, 0.95])
def test_forces(memory):
    rng, (B, D) = np.random.default_rng(1), columns()
    force = coloured(rng, memory)
    moved = np.einsum("wnd,wd->wn", D, force)
    r = rng.normal(size=(WINDOWS, STEPS)) + 4 * moved / np.sqrt(np.mean(moved**2))
    found = origin(r, B, D, np.ones(1), 1, np.ones(WINDOWS))
    assert not found.of_sensors


def test_windows_of_many_rows_are_told_from_some_of_them():
    """240 rows a window, of which 80 are looked at."""
    steps = 240
    rng, (B, D) = np.random.default_rng(3), columns(steps)
    white = rng.normal(size=(WINDOWS, steps))
    moved = np.einsum("wnd,wd->wn", D, coloured(rng, 0.95, steps))
    noisy = origin(white + 3 * coloured(rng, 0.95, steps), B, D, np.ones(1), 1, np.ones(WINDOWS))
    assert noisy.of_sensors and noisy.memory > 0
    pushed = origin(white + 4 * moved / np.sqrt(np.mean(moved**2)), B, D, np.ones(1), 1, np.ones(WINDOWS))
    assert not pushed.of_sensors


def test_a_force_on_a_heavy_mass_beside_a_light_one_that_would_move_a_hundred_times_as_far():
    """Forces of one size on both would leave their trace on the light one alone."""
    rng, (B, D) = np.random.default_rng(2), columns()
    W, n, s = B.shape
    two = np.zeros((W, n, 2, 2 * s))
    two[:, :, 0, :s], two[:, :, 1, s:] = B, B
    pushed = np.zeros((W, n, 2, 2 * n))
    pushed[:, :, 0, :n], pushed[:, :, 1, n:] = D, 100 * D
    moved = np.einsum("wnd,wd->wn", D, coloured(rng, 0.95))
    r = rng.normal(size=(W, n, 2))
    r[:, :, 0] += 4 * moved / np.sqrt(np.mean(moved**2))
    parts = (r.reshape(W, -1), two.reshape(W, 2 * n, -1), pushed.reshape(W, 2 * n, -1))
    assert not origin(*parts, np.array([1.0, 1e-4]), 2, np.ones(W)).of_sensors
    assert origin(*parts, np.array([1.0, 1e-4]), 2, np.ones(W)).force > origin(*parts, np.ones(2), 2, np.ones(W)).force


def test_a_clock_that_jitters_is_no_force_though_it_moves_position_and_speed_together():
    """Position and speed of a mass that swings are read at times that are off by 1.2 ms, and one step comes early."""
    rng, (B, D) = np.random.default_rng(3), columns()
    t = np.arange(STEPS) * DT + rng.uniform(0, 3, (WINDOWS, 1))
    speed = 3.0 * rng.uniform(0, 2, (WINDOWS, 1)) * np.sin(6 * t)
    rate = np.stack([speed, np.gradient(speed, DT, axis=1)], 2) / 1e-3
    shift = lambda a: np.gradient(a, axis=1)  # noqa: E731
    both = lambda a: np.stack([a, shift(a)], 2)  # noqa: E731
    B, D = (both(a).reshape(WINDOWS, 2 * STEPS, -1) for a in (B, D))
    r = rng.normal(size=(WINDOWS, STEPS, 2)) + 1.2e-3 * rng.normal(size=(WINDOWS, STEPS, 1)) * rate
    r = r.reshape(WINDOWS, -1)
    r[7] += 6 * D[7, :, 20] / np.sqrt(np.mean(D[7, :, 20] ** 2))
    found = origin(r, B, D, np.ones(1), 2, np.ones(WINDOWS), rate.reshape(WINDOWS, -1))
    assert found.of_sensors and found.deviate < 1
    r += 3 * np.einsum("wnd,wd->wn", D, coloured(rng, 0.95)) / np.sqrt(np.mean(D**2) * STEPS)
    assert not origin(r, B, D, np.ones(1), 2, np.ones(WINDOWS), rate.reshape(WINDOWS, -1)).of_sensors
