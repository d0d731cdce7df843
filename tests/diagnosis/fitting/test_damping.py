"""A number that hardly moves the residual where a fit begins does not keep the others from their values."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter

TIMES = np.arange(8 * 20).reshape(8, 20)
ALONG, ACROSS = np.sin(0.7 * TIMES), np.sin(0.7 * TIMES + 1.0)
LOAD, ARM = 0.8, 0.0  # true values
NOISE = 0.01


@dataclasses.dataclass(frozen=True)
class Windows:
    group: np.ndarray = dataclasses.field(default_factory=lambda: np.repeat(np.arange(4), 2))
    sigma_q, sigma_v, spread, steps = np.array([NOISE]), np.array([np.inf]), np.array([0.03, 0.1]), 20
    measured = np.ones(1)

    def __len__(self):
        return 8


class Loaded:
    """The error is (LOAD - load) ALONG + 3 load arm^2 ACROSS, as of a mass off its plane."""

    windows, physics = Windows(), SimpleNamespace()

    def run(self, thetas, offsets):
        load, arm = np.moveaxis(np.asarray(thetas), 1, 0)[:, :, None, None]
        noise = NOISE * np.random.default_rng(0).normal(size=ALONG.shape)
        error = (LOAD - load) * ALONG + 3 * load * arm**2 * ACROSS + noise
        return np.stack([error - offsets[..., 0, None], np.zeros_like(error)], -1)


@pytest.mark.parametrize("start", [(0.05, 0.01), (0.2, 0.01), (0.05, 0.05), (0.5, -0.02)])
def test_a_payload_is_found_from_any_start_in_a_few_steps(start):
    names = ("load", "arm")
    ends = ((0.0, 2.0), (-1.0, 1.0))
    coordinates = [Coordinate(n, (i,), 0.0, *ends[i], unit="") for i, n in enumerate(names)]
    fitter = Fitter(Loaded(), (), np.zeros(2))
    (fit,) = fitter.iterate([fitter.begin(coordinates, np.array(start))], 8, lambda f: range(2))
    assert fit.values[0] == pytest.approx(LOAD, abs=0.02) and abs(fit.values[1]) < 0.1
    assert fit.cost < 1.5 * TIMES.size
