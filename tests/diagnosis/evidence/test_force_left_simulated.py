"""The force that is missing in simulated logs, which MuJoCo C made in finer steps: its size, and none where none is."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis.evidence import gaussian
from bayessim_mjx.diagnosis.evidence.force_left import force_left
from bayessim_mjx.diagnosis.evidence.gaussian import learn, windows_of
from bayessim_mjx.diagnosis.evidence.parameters import belief_of
from tests.diagnosis.missing_forces import fitted, record

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole fits
RMS = 0.04  # N m


def left(logs):
    fitter, fit = fitted(logs)
    scale = gaussian.force_scale(fitter)
    D = gaussian.columns(fitter, fit, gaussian.default_nodes(fitter), scale)
    windows = windows_of(fit.r, fit.A, fit.B, D, fit.offsets, fit.spread, scale, int(fitter.used.sum()))
    return force_left(windows, belief_of(fit), learn(windows, belief_of(fit)), scale)


def waves(count=7):
    """A force of known rms that no parameter makes: sines between 1 and 5 Hz."""
    rng = np.random.default_rng(0)
    hertz, phase = rng.uniform(1, 5, count), rng.uniform(0, 2 * np.pi, count)
    return lambda t, data: RMS * np.sqrt(2 / count) * np.sum(np.sin(2 * np.pi * hertz * t + phase), keepdims=True)


def test_a_force_has_its_size():
    """Within a third: sines are no Ornstein-Uhlenbeck process."""
    found = left(record(force=waves()))
    assert found.amplitude[0] == pytest.approx(RMS, rel=0.35)
    assert found.low[0] < found.amplitude[0] < found.high[0]
    assert found.nats > 100 and found.chance(0.5 * found.motion) > 0.99


def test_dry_friction_that_is_missing_is_a_force():
    found = left(record(friction=(0.05, 0.0)))
    assert found.nats > 100 and found.chance(1.0) > 0.99


def test_a_robot_with_other_masses_and_damping_leaves_no_force():
    found = left(record(wrong=1.06))
    assert found.chance(0.1) < 0.05
    assert found.high[0] < 0.1 * RMS
