"""A number that hardly moves the residual where a fit begins does not keep the others from their values."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from tests.diagnosis.rigid import Rigid

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


class Loaded(Rigid):
    """The error is (LOAD - load) ALONG + 3 (load arm^2 - LOAD ARM^2) ACROSS, as of a mass off its plane."""

    windows, physics = Windows(), SimpleNamespace()

    def __init__(self, arm=ARM):
        self.arm = arm

    def run(self, thetas, offsets):
        load, arm = np.moveaxis(np.asarray(thetas), 1, 0)[:, :, None, None]
        noise = NOISE * np.random.default_rng(0).normal(size=ALONG.shape)
        error = (LOAD - load) * ALONG + 3 * (load * arm**2 - LOAD * self.arm**2) * ACROSS + noise
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


@pytest.mark.parametrize(
    ("arm", "start", "known"), [(0.8, 0.3, 0.4), (0.8, 0.3, 0.7), (0.8, 0.6, 0.4), (0.4, 0.6, 0.4)]
)
def test_old_columns_are_differenced_anew_where_they_led_astray(arm, start, known):
    """As in a search, steps ask for an effect's column alone; the others' are of the model without it.

    Without the arm the load's column is ALONG, with an arm of .8 it is 2.2 times as long and of another direction. Of
    16 starts like these 13 arrive; with the first columns, corrected along the steps alone, 10 did.
    """
    ends = Coordinate("load", (0,), 0.0, 0.0, 2.0, unit=""), Coordinate("arm", (1,), 0.0, -1.0, 1.0, unit="")
    fitter = Fitter(Loaded(arm), ends[:1], np.zeros(2))
    begun = fitter.derive(fitter.begin(ends[:1], np.array([known])), ends[1:], np.array([start]))
    (fit,) = fitter.iterate([begun], 12, lambda f: [1])
    assert fit.values == pytest.approx([LOAD, arm], abs=0.01)
    assert fit.cost < TIMES.size


def test_a_step_as_promised_costs_one_simulation():
    """Where the error is linear, columns of the start hold at every point; asked for, they are not simulated again."""
    simulator, made = Loaded(), []
    simulator.apart, run = True, simulator.run
    simulator.run = lambda thetas, offsets: made.append(len(thetas)) or run(thetas, offsets)
    load = Coordinate("load", (0,), 0.0, 0.0, 2.0, unit="")
    fitter = Fitter(simulator, (), np.zeros(2))
    start = fitter.begin((load,), np.array([0.2]))
    made.clear()
    (fit,) = fitter.iterate([start], 6, lambda f: [0])
    assert fit.values[0] == pytest.approx(LOAD, abs=0.02)
    assert made == [1] * len(fit.history)


class Held(Loaded):
    """A linear error: (LOAD - load) (1 + ALONG) and a start state that does nearly the same."""

    def run(self, thetas, offsets):
        error = (LOAD - np.asarray(thetas)[:, 0, None, None]) * (1 + ALONG) + 0.02 - offsets[..., 0, None]
        return np.stack([error, np.zeros_like(error)], -1)


@pytest.mark.parametrize("reach", [0.004, 0.25, 1.0])
def test_a_step_gains_what_it_promises_however_much_start_states_are_damped(reach):
    """A parameter's step that counts on start states to follow promises too much where they may not."""
    fitter = Fitter(Held(), (), np.zeros(1))
    fit = fitter.begin([Coordinate("load", (0,), 0.0, -9.0, 9.0, unit="")], np.array([0.1]))
    fit, (values, offsets) = fitter._propose(dataclasses.replace(fit, reach=np.full(8, reach)))
    r = fitter.whiten(fitter.simulator.run(values[None], offsets[None]))[0]
    assert fit.cost - fitter.cost(fit, r, offsets, values) == pytest.approx(fit.promise, rel=1e-3)
    assert 0 < fit.promise < fit.cost
