"""Parameters that end at a bound: ranges grow to hold what the logs say, end where physics does, and it is told."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting.candidates import Candidate, Coordinate, shrink
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.result import Estimate
from bayessim_mjx.diagnosis.selection import bounds
from bayessim_mjx.diagnosis.selection.models import scored
from bayessim_mjx.diagnosis.selection.search_state import SearchState, Settings
from bayessim_mjx.effects.effect import Quantity
from bayessim_mjx.report import words
from tests.diagnosis.rigid import Rigid

MOTION = np.sin(np.arange(8 * 20) * 0.7).reshape(8, 20)  # of eight windows; their error is value * MOTION


class Linear(Rigid):
    """Windows whose error is (true - theta[0]) MOTION plus noise of 0.01, in place of a simulator."""

    def __init__(self, true, quantity, low, high):
        self.noise = 0.01 * np.random.default_rng(0).normal(size=MOTION.shape)
        self.true = true
        parameter = SimpleNamespace(low=low, high=high)
        space = SimpleNamespace(parameters=(parameter,))
        self.physics = SimpleNamespace(quantity=lambda index: quantity, space=space)
        self.windows, self.rollouts = Windows(), 0

    def run(self, thetas, offsets, own=None):
        own = np.arange(len(MOTION)) if own is None else own
        self.rollouts += len(thetas) * len(own)
        error = (self.true - np.asarray(thetas)[:, :1, None]) * MOTION[own] + self.noise[own]
        return np.stack([error - offsets[..., 0, None], np.zeros_like(error)], -1)


@dataclasses.dataclass(frozen=True)
class Windows:
    log: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(len(MOTION), int))
    start: np.ndarray = dataclasses.field(default_factory=lambda: np.arange(len(MOTION)))
    group: np.ndarray = dataclasses.field(default_factory=lambda: np.repeat(np.arange(4), 2))

    sigma_q, sigma_v, spread, steps = np.array([0.01]), np.array([np.inf]), np.array([0.03, 0.1]), 20
    measured, blocks = np.ones(1), False

    def __len__(self):
        return len(self.log)


def pool_of(true, quantity=None, low=0.0, high=1.0, neutral=0.0, start=0.5):
    """A pool whose only model is the toy effect, fitted within its range."""
    simulator = Linear(true, quantity or Quantity("amount", neutral, low, high), low, high)
    coordinate = Coordinate("place.toy.amount", (0,), neutral, low, high, unit="N m")
    coordinate = Coordinate(**{**coordinate.__dict__, "precision": shrink(coordinate)})
    candidate = Candidate("toy", "place", "joint", (coordinate,), (False,))
    fitter = Fitter(simulator, (), np.zeros(1))
    empty = scored(fitter, fitter.begin(()), ())
    fit = fitter.begin((coordinate,), np.array([start]))
    (fit,) = fitter.iterate([fit], 10, lambda f: [0])
    model = scored(fitter, fitter.refresh(fit), (candidate,))
    pool = SearchState(fitter, [candidate], Settings(), empty.fit, empty)
    pool.models[frozenset([candidate.label])] = model
    return pool, model


def silent(*args):
    pass


def ended(pool, model):
    (effect,) = model.effects
    (c,) = effect.coordinates
    return bounds.of(pool.fitter.simulator.physics, c, float(model.values_of(effect)[0])), model.fit.values[0]


@pytest.mark.parametrize(("true", "high"), [(0.4, 1.0), (1.7, 2.0), (5.3, 8.0), (20.0, 32.0)])
def test_a_range_grows_until_it_holds_the_truth(true, high):
    pool, model = pool_of(true)
    new = bounds.widened(pool, model, silent)
    bound, value = ended(pool, new)
    assert bound is None and value == pytest.approx(true, abs=0.01)
    assert new.effects[0].coordinates[0].high == high and pool.candidates[0].coordinates[0].high == high
    assert new.effects[0] == model.effects[0]  # the same effect at the same place


def test_beyond_the_largest_range_the_value_is_a_bound():
    pool, model = pool_of(200.0)
    bound, value = ended(pool, bounds.widened(pool, model, silent))
    assert bound.kind == "at least" and value == pytest.approx(100.0) == bound.at


def test_what_a_wider_range_promises_is_known_before_it_is_tried():
    """The error is linear, so the promise is exact; inside of the range nothing is promised."""
    pool, held = pool_of(5.3)
    least = np.sum((pool.fitter.simulator.noise / 0.01) ** 2)  # cost at the truth, start states aside
    promised = bounds.promise(pool, held)
    assert held.fit.cost - promised == pytest.approx(least, abs=0.2 * least)
    assert bounds.promise(*pool_of(0.4)) == 0.0


def test_negative_and_positive_ranges_grow_too():
    pool, model = pool_of(-3.1, low=-1.0)
    assert ended(pool, bounds.widened(pool, model, silent))[1] == pytest.approx(-3.1, abs=0.01)
    pool, model = pool_of(0.15, low=0.5, high=1.5, neutral=1.0, start=1.0)  # a gain halves: it stays positive
    assert ended(pool, bounds.widened(pool, model, silent))[1] == pytest.approx(0.15, abs=0.01)


@pytest.mark.parametrize(
    ("true", "quantity", "kind", "value"),
    [
        (-2.0, Quantity("amount", 0.0, 0.0, 1.0), "off", 0.0),  # no friction below none
        (3.0, Quantity("amount", 0.0, 0.0, 1.0, most=1.0), "end", 1.0),  # physics ends there
        (3.0, Quantity("amount", 0.0, 0.0, 1.0, remembered=True), "at least", 1.0),  # a memory has a size
    ],
)
def test_ends_that_stay(true, quantity, kind, value):
    pool, model = pool_of(true, quantity)
    new = bounds.widened(pool, model, silent)
    bound, at = ended(pool, new)
    assert new is model and bound.kind == kind and at == pytest.approx(value, abs=1e-6)


def test_a_value_at_a_bound_is_no_interval():
    nan = float("nan")
    assert words.quantity("mass", Estimate(33.0, nan, "kg", "at least")) == ("mass", "at least 33.0 kg")
    assert words.quantity("inverse_limit", Estimate(2.0, nan, "1/(N m)", "at least"))[1] == "at most 0.500 N m"
    assert words.quantity("excess", Estimate(0.0, 0.01, "N m", "off"))[1].endswith("(off)")
    spread = bounds.spread_out(np.ones((2, 2)), np.array([3.0, 1.0]), [0])
    assert spread.tolist() == [[1.5**2, 0.0], [0.0, 1.0]]
