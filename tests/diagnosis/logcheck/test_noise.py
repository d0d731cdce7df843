"""Noise floors: known noise, known correlation times and known error growth come back."""

import dataclasses

import numpy as np
import pytest

from bayessim_mjx.diagnosis.logcheck.noise import error_growth, ess, floors, repeats, rest_spread, tau_int
from bayessim_mjx.errors import UserError
from tests.diagnosis.recordings import PENDULUM, record, sines


def ar1(phi: float, count: int, rng: np.random.Generator) -> np.ndarray:
    x = np.zeros(count)
    for k in range(1, count):
        x[k] = phi * x[k - 1] + rng.standard_normal()
    return x


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.9, 0.97])
def test_autocorrelation_time_of_an_ar1_process(phi: float) -> None:
    truth = 0.5 * (1 + phi) / (1 - phi)
    rng = np.random.default_rng(0)
    found = [tau_int(ar1(phi, 20_000, rng)) for _ in range(8)]
    assert np.mean(found) == pytest.approx(truth, rel=0.1)
    assert ess(ar1(phi, 20_000, rng)) == pytest.approx(20_000 / (2 * truth), rel=0.3)


def test_effective_size_has_limits() -> None:
    rng = np.random.default_rng(1)
    assert 700 < ess(rng.standard_normal(1000)) <= 1000
    assert ess(np.arange(100.0)) < 10
    assert tau_int(np.ones(50)) == 0.5


def test_sensor_noise_is_recovered() -> None:
    log = record(PENDULUM, sines((1.0,)), sigma=3e-3)
    assert floors([log]).qpos[0] == pytest.approx(3e-3, rel=0.15)
    quiet = [record(PENDULUM, sines((1.0,), seed=k), sigma=1e-3, seed=k) for k in (1, 2)]
    assert floors([log, *quiet]).qpos[0] == pytest.approx(1e-3, rel=0.15)  # one run that shakes is not the sensor


def test_noise_at_rest_counts_where_it_is_slow() -> None:
    rng = np.random.default_rng(2)
    t = np.arange(4000) / 200
    motion = np.where(t < 8, 0.0, np.sin(t - 8))
    slow = np.convolve(rng.standard_normal(4004), np.ones(5) / np.sqrt(5), "valid")
    assert rest_spread(motion + 1e-3 * slow) == pytest.approx(1e-3, rel=0.35)  # fourth differences see less
    assert rest_spread(np.sin(t)) < 1e-5  # turns, never rests
    assert rest_spread(motion) < 1e-12


def test_declared_noise_wins() -> None:
    log = record(PENDULUM, sines((1.0,)), sigma=3e-3)
    declared = dataclasses.replace(log, metadata={"sigma": {"hinge": 0.5}}, sigma_qpos=np.array([0.5]))
    assert floors([declared]).qpos[0] == 0.5


def test_repeats_give_the_reproducibility() -> None:
    law = sines((1.0,))
    runs = [record(PENDULUM, law, sigma=2e-3, seed=k, name=f"{k}.npz") for k in range(4)]
    runs.append(record(PENDULUM, sines((1.0,), seed=9), name="other.npz"))
    found = floors(runs, (0.5, 1.0, 4.0, 100.0))
    assert found.repeats == (("0.npz", "1.npz", "2.npz", "3.npz"),)
    assert found.horizons is not None and found.repeat_qpos is not None
    assert found.horizons.tolist() == [0.5, 1.0, 4.0, 100.0]
    np.testing.assert_allclose(found.repeat_qpos[:, 0], 2e-3, rtol=0.2)  # the process itself repeats exactly
    assert not found.warnings


def test_chance_in_the_process_grows_with_the_horizon() -> None:
    law = sines((1.0,))

    def shaken(seed: int):  # a random walk of the angle on top of the same motion
        log = record(PENDULUM, law, sigma=0.0, name=f"{seed}.npz")
        walk = 1e-3 * np.cumsum(np.random.default_rng(seed).standard_normal(len(log)))
        return dataclasses.replace(log, qpos=log.qpos + walk[:, None], metadata={"repeat_of": "0"})

    found = floors([shaken(k) for k in range(8)], (0.5, 8.0))
    assert found.repeat_qpos is not None
    # rms over 0..0.5 s and 0.5..8 s of a walk of 1 mrad per row at 100 Hz: sqrt(25), sqrt(425) mrad
    np.testing.assert_allclose(found.repeat_qpos[:, 0] * 1e3, [5.0, 20.6], rtol=0.45)


def test_without_repeats_it_says_so() -> None:
    log = record(PENDULUM, sines((1.0,)))
    found = floors([log])
    assert found.repeat_qpos is None and found.horizons is None and "no repeated runs" in found.warnings[0]
    with pytest.warns(UserWarning, match="repeat_of = 'nobody'"):
        assert repeats([dataclasses.replace(log, metadata={"repeat_of": "nobody"})]) == []


@pytest.mark.parametrize("parts", [(1e-6, 0.0, 0.0), (1e-6, 4e-5, 0.0), (1e-6, 0.0, 3e-4), (2e-6, 2e-5, 4e-4)])
def test_error_growth_is_split(parts: tuple[float, float, float]) -> None:
    h = np.array([0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.8, 1.0])
    sensor, process, bias = parts
    found = error_growth(h, sensor + process * h + bias * h**2)
    assert (found.sensor, found.process, found.bias) == pytest.approx(parts, rel=1e-3, abs=1e-9)
    assert found.misfit < 1e-6
    at = found.parts(0.5)
    assert at["process"] == pytest.approx(0.5 * process, abs=1e-9) and at["bias"] == pytest.approx(
        0.25 * bias, abs=1e-9
    )


def test_error_growth_of_forces() -> None:
    h = np.array([0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.8, 1.0])
    rng = np.random.default_rng(3)
    found = error_growth(h, (1e-6 + 2e-4 * h**3 + 1e-3 * h**4) * (1 + 0.01 * rng.standard_normal(8)))
    assert (found.process_power, found.bias_power) == (3.0, 4.0)
    assert found.bias == pytest.approx(1e-3, rel=0.2) and found.sensor == pytest.approx(1e-6, rel=0.1)


def test_bad_input_is_refused() -> None:
    log = record(PENDULUM, sines((1.0,)), seconds=1.0)
    for call, words in (
        (lambda: floors([]), "no logs"),
        (lambda: floors([log], (1.0, 0.5)), "increasing"),
        (lambda: error_growth(np.ones(3), np.ones(3)), "at least four"),
        (lambda: error_growth(np.arange(1.0, 6), np.zeros(5)), "positive"),
    ):
        with pytest.raises(UserError, match=words):
            call()
