"""Fits without a condition, on windows whose error bends with the parameter: one linear step is not enough."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting.candidates import Candidate, Coordinate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.selection import heldout
from bayessim_mjx.diagnosis.selection.models import scored, told_alone
from bayessim_mjx.diagnosis.selection.numbers import EFFORT
from tests.diagnosis.rigid import Rigid

MOTION = np.sin(np.arange(8 * 20) * 0.7).reshape(8, 20)  # of eight windows
GROUP = np.repeat(np.arange(4), 2)


class Bent(Rigid):
    """Windows whose error is (what theta does in truth - what it does) MOTION; conditions differ in their truth."""

    def __init__(self, true, roughness=0.0, felt=1.0, bend=0.4, start=0.0):
        self.bend, self.start = bend, start
        self.true, self.roughness, self.felt = np.asarray(true)[GROUP], roughness, np.broadcast_to(felt, 4)[GROUP]
        noise = 0.01 * np.random.default_rng(0).normal(size=MOTION.shape)
        self.noise, self.physics, self.rollouts = (
            noise,
            SimpleNamespace(mj_model=SimpleNamespace(opt=SimpleNamespace(timestep=0.01))),
            0,
        )
        self.windows = Windows()

    def run(self, thetas, offsets, own=None):
        own = np.arange(len(MOTION)) if own is None else own
        theta = np.asarray(thetas)[:, :1]
        self.rollouts += len(theta)
        rough = self.roughness * np.sin(1e5 * theta)
        size = self.felt[own] * (self.true[own] - theta - self.bend * theta**2 + rough)
        error = size[..., None] * MOTION[own] + self.noise[own] + self.start - offsets[..., 0, None]
        return np.stack([error, np.zeros_like(error)], -1)

    def run_each(self, thetas, of_theta, of_window, offsets):
        each = zip(np.asarray(thetas)[of_theta], of_window, offsets, strict=True)
        return np.concatenate([self.run(theta[None], x[None, None], [w])[0] for theta, w, x in each])


class Windows:
    sigma_q, sigma_v, spread, steps = np.array([0.01]), np.array([np.inf]), np.array([0.03, 0.1]), 20
    measured, blocks = np.ones(1), False
    group = GROUP

    def __len__(self):
        return len(MOTION)


def fitted(simulator):
    coordinate = Coordinate("place.toy.amount", (0,), 0.0, -5.0, 5.0, unit="N m")
    fitter = Fitter(simulator, (), np.zeros(1))
    (fit,) = fitter.iterate([fitter.begin((coordinate,), np.array([0.7]))], 20, lambda f: [0], 1e-9)
    fit = replace(fitter.refresh(fit), weight=np.ones(8))
    return fitter, scored(fitter, fit, (Candidate("toy", "place", "joint", (coordinate,), (False,)),))


def alone(fitter, model, condition):
    """The estimate by descent to the end without a condition."""
    fit = replace(model.fit, weight=1.0 * (condition != GROUP), cost=np.inf, history=())
    return fitter.iterate([fit], 40, lambda f: [0], 0.0)[0].values[0]


def test_fits_without_a_condition_come_to_their_end_where_one_linear_step_does_not():
    fitter, model = fitted(Bent((0.2, 0.4, 0.9, 4.0)))
    before = fitter.simulator.rollouts
    new = heldout.refitted(fitter, model)
    made = fitter.simulator.rollouts - before  # of all windows, as long as a step promises something
    assert 4 < made <= 4 * EFFORT.rounds
    exact = np.array([alone(fitter, model, g) for g in range(4)])
    linear, again = np.abs(model.estimates[:, 0] - exact), np.abs(new.estimates[:, 0] - exact)
    assert linear.max() > 0.05 and again.max() < linear.max() / 5
    assert new.fit is model.fit and np.array_equal(new.cost, model.cost)


def test_on_rough_costs_estimates_differ_between_conditions_as_the_data_do():
    """Descent would stop at the next of many small minima, and the jackknife would call that knowledge."""
    fitter, smooth = fitted(Bent((0.3, 0.5, 0.7, 0.9)))
    expected = heldout.refitted(fitter, smooth)
    rough, model = fitted(Bent((0.3, 0.5, 0.7, 0.9), roughness=0.003))
    found = heldout.refitted(rough, replace(model, fit=replace(model.fit, A=smooth.fit.A)))
    np.testing.assert_allclose(found.estimates - found.fit.values, expected.estimates - expected.fit.values, atol=0.01)


def test_a_condition_that_alone_tells_the_parameter_keeps_its_linear_steps():
    fitter, model = fitted(Bent((0.5, 0.5, 0.5, 0.8), felt=(1e-4, 1e-4, 1e-4, 1.0)))
    assert told_alone(fitter, model.fit) == [False, False, False, True]
    new = heldout.refitted(fitter, model)
    assert new.estimates[3] == model.estimates[3]
    assert new.estimates[:3, 0] == pytest.approx(model.fit.values[0], abs=0.01)


def test_what_the_other_conditions_hardly_tell_is_not_held_against_a_model():
    """Three quiet conditions tell the parameter to .16 and the fourth shows it: the model is right, and costs noise."""
    fitter, model = fitted(Bent((0.5, 0.5, 0.5, 0.5), felt=(0.03, 0.03, 0.03, 0.08), bend=0.0))
    assert told_alone(fitter, model.fit) == [False] * 4
    last = GROUP == 3
    off = model.estimates[3, 0] - model.fit.values[0]
    assert model.plain[last].sum() > model.cost[last].sum()
    fitted_alone = np.sum(model.fit.r[last] ** 2)
    assert model.cost[last].sum() >= fitted_alone - 1e-6 and abs(off) > 0
