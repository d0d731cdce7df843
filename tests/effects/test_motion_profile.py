"""The profile generator of a drive: times of triangles and trapezoids by hand, and its two ends."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make

MODEL = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><body><joint name="x"/><geom size=".1"/></body></worldbody>'
    '<actuator><position name="servo" joint="x" kp="6"/></actuator></mujoco>'
)
TIMESTEP = 1e-3


def followed(name, values, command):
    """What the servo gets `[T]` of a command `[T]`, one sub-step each."""
    effect = make(name, where="servo")
    at = effect.bind(MODEL, TIMESTEP, len(command))
    run = jax.jit(effect.on_command, static_argnums=0)
    column = jnp.asarray(command, jnp.float32)[:, None]
    return np.asarray(run(at, effect.init(at), column, jnp.asarray(values, jnp.float32))[1][:, 0])


def step(size, rows=700):
    command = np.full(rows, size)
    command[:10] = 0.0  # at rest there first
    return command


@pytest.mark.parametrize(
    ("size", "slowness", "inertness", "seconds"),
    [
        (1.0, 0.0, 0.04, 2 * np.sqrt(0.04)),  # a triangle: 2 sqrt(w b)
        (0.25, 0.0, 0.04, 2 * np.sqrt(0.25 * 0.04)),
        (-1.0, 0.4, 0.04, 0.4 + 0.04 / 0.4),  # a trapezoid: w / v + v / a
        (0.2, 0.4, 0.04, 2 * np.sqrt(0.2 * 0.04)),  # too short to get to full speed
    ],
)
def test_times_of_profiles(size, slowness, inertness, seconds):
    """It arrives after these seconds, is half way at half of them, and neither turns back nor goes beyond."""
    got = followed("acceleration_limit", [slowness, inertness], step(size)) / size
    arrived = 10 + round(seconds / TIMESTEP)
    assert got[arrived + 4] == pytest.approx(1.0, abs=1e-5)
    assert got[arrived - 15] < 1 - 1e-4
    assert got[10 + round(seconds / 2 / TIMESTEP)] == pytest.approx(0.5, abs=0.012)
    assert np.diff(got).min() > -1e-5
    assert got.max() < 1 + 1e-5


def test_speed_and_acceleration_stay_within_their_limits():
    command = np.random.default_rng(0).choice([-1.0, 0.0, 0.3, 1.0], 20).repeat(60)
    speed = np.diff(followed("acceleration_limit", [0.2, 0.004], command)) / TIMESTEP
    assert np.abs(speed).max() < 5.0 * 1.001
    assert np.abs(np.diff(speed)).max() / TIMESTEP < 250 * 1.002


def test_without_inertness_it_is_the_rate_limit_and_without_both_nothing():
    command = np.random.default_rng(1).normal(size=30).repeat(7)
    rate = followed("rate_limit", [0.02], command)
    assert np.abs(rate - command).max() > 0.5
    np.testing.assert_allclose(followed("acceleration_limit", [0.02, 0.0], command), rate, atol=2e-6)
    assert np.array_equal(followed("acceleration_limit", [0.0, 0.0], command), command.astype(np.float32))


def test_little_inertness_changes_little():
    """Behind the steps h v of a held command, on average over each: w sqrt(w b) / h where it arrives within one.

    Else it switches to braking in the middle of one, at the speed p = v + h / (4 b): p^2 b / 2.
    """
    h, v, w = TIMESTEP, 50.0, 0.05
    command = w * np.arange(60)
    inertness = np.array([1e-4, 1e-5, 1e-6, 1e-7])
    apart = [command[-1] - followed("acceleration_limit", [0.0, b], command)[-1] for b in inertness]
    within = 2 * np.sqrt(w * inertness) < h
    expected = np.where(within, w * np.sqrt(w * inertness) / h, (v + h / (4 * inertness)) ** 2 * inertness / 2)
    np.testing.assert_allclose(apart, expected, rtol=1e-3)
