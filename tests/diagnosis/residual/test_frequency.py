"""Delays, responses, orders and lines of signals and of logs where they are known."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis.phrases.residual import spectra as spectra_in_words
from bayessim_mjx.diagnosis.residual import disturbance, frequency
from tests.diagnosis.missing_forces import fitted, known, record

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole diagnoses and fits


def coloured(rng, size, dt, top):
    """Noise with power up to `top` Hz."""
    spectrum = np.fft.rfft(rng.standard_normal(size))
    spectrum[np.fft.rfftfreq(size, dt) > top] = 0
    return np.fft.irfft(spectrum, size)


def delayed(x, dt, by):
    return np.fft.irfft(np.fft.rfft(x) * np.exp(-2j * np.pi * np.fft.rfftfreq(len(x), dt) * by), len(x))


def test_a_fractional_delay_is_measured_with_its_interval():
    rng, dt = np.random.default_rng(0), 0.02
    x = [coloured(rng, 400, dt, 5.0) for _ in range(6)]
    y = [2.0 * delayed(a, dt, 0.0065) + 0.05 * rng.standard_normal(400) for a in x]
    found = frequency.spectra(x, y, dt)
    late = frequency.delay(found)
    assert late.value == pytest.approx(0.0065, rel=0.05)
    assert late.low < 0.0065 < late.high and late.high - late.low < 0.002
    busy = found.hz < 4.5
    np.testing.assert_allclose(np.abs(found.response[busy]), 2.0, rtol=0.1)
    assert found.coherence[busy].min() > 0.95


def test_unrelated_signals_are_not_coherent():
    rng = np.random.default_rng(1)
    x, y = ([rng.standard_normal(400) for _ in range(6)] for _ in range(2))
    assert frequency.spectra(x, y, 0.02).coherence.mean() < 0.2


def test_a_lag_bends_the_phase_and_a_delay_does_not_change_the_gain():
    rng, dt, lag = np.random.default_rng(2), 0.01, 0.05
    x = [coloured(rng, 800, dt, 10.0) for _ in range(4)]
    hz = np.fft.rfftfreq(800, dt)
    y = [np.fft.irfft(np.fft.rfft(a) / (1 + 2j * np.pi * hz * lag), 800) for a in x]
    found = frequency.spectra(x, y, dt)
    at = np.argmin(np.abs(found.hz - 1 / (2 * np.pi * lag)))  # corner: -3 dB, -45 degrees
    assert np.abs(found.response[at]) == pytest.approx(0.707, rel=0.1)
    assert np.degrees(np.angle(found.response[at])) == pytest.approx(-45, abs=4)


def test_a_line_stands_out_of_its_surroundings():
    rng, dt = np.random.default_rng(3), 0.02
    x, y = ([rng.standard_normal(400) for _ in range(6)] for _ in range(2))
    assert frequency.line(frequency.spectra(x, y, dt))[1] == 0.0
    hum = np.sin(2 * np.pi * 7.0 * dt * np.arange(400))
    found = frequency.spectra(x, [a + hum for a in y], dt)
    assert frequency.line(found)[0] == pytest.approx(7.0, abs=found.hz[0])


def test_windows_without_gaps_are_joined():
    fitter, _ = fitted(record(logs=2, seconds=2.0), iterations=0)
    parts = frequency.runs(fitter.simulator.windows)
    assert [len(p) for p in parts] == [4, 4]


def test_cogging_is_found_with_its_order_and_amplitude():
    fitter, fit = fitted(record(force=lambda t, d: np.array([0.05 * np.sin(11 * d.qpos[0])])))
    heard = frequency.analyse(fitter, fit)
    found, text = [h.details() for h in heard], spectra_in_words(heard)
    assert [o["order"] for o in found[0]["orders"]] == [11]
    assert found[0]["orders"][0]["amplitude"] == pytest.approx(0.05, rel=0.1)  # N m
    assert any("11 times per turn" in t for t in text)


def test_a_delay_of_the_effort_is_found():
    fitter, fit = known(record(delay=0.006, wrong=1.0))
    heard = frequency.analyse(fitter, fit)
    found, text = [h.details() for h in heard], spectra_in_words(heard)
    assert found[0]["delay"]["mean"] == pytest.approx(0.006, rel=0.12)  # s
    assert any("later than simulated" in t for t in text)
    for key in ("coherence_real", "coherence_sim", "gain_real", "gain_sim", "phase_real_deg", "phase_sim_deg"):
        assert len(found[0][key]) == len(found[0]["hz"])
    assert found[0]["orders"] == []


def test_windows_apart_have_no_spectrum(monkeypatch):
    """Of unstable motion only some windows are kept, so that none follows another."""
    fitter, fit = fitted(record(logs=2, seconds=2.0), iterations=0)
    monkeypatch.setattr(frequency, "runs", lambda windows: [np.array([i]) for i in range(len(windows.log))])
    assert frequency.analyse(fitter, fit, disturbance.estimate(fitter, fit)) == ()
