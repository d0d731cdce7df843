"""What a coarse time step puts into the parameters: told, and right."""

import dataclasses
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting import integrator_choice, robot
from bayessim_mjx.diagnosis.fitting.quadratic import solve
from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.setup import prepare
from bayessim_mjx.diagnosis.summary import again
from bayessim_mjx.diagnosis.summary.again import AtFinerSteps
from tests.diagnosis.pendulums import ARMATURE, DAMPING, FEW, MASS, MODEL, fitted, recorded

SCALE = (1.1, 1.15, 0.95)
COARSE = 0.02  # s, a hundred times the step of the logs


def found_at(fit, **setup):
    return SimpleNamespace(setup=SimpleNamespace(**setup), model=SimpleNamespace(fit=fit, effects=()))


@pytest.mark.slow
@pytest.mark.ci
def test_where_parameters_would_go_at_finer_steps_is_where_the_truth_is(tmp_path, monkeypatch):
    """Ten milliseconds put 1.6 % into the rotor inertia; the other two parameters hardly change. No RK4 here."""
    monkeypatch.setattr(integrator_choice, "simulated", lambda model, logs: np.ones(model.nv, bool))
    path = tmp_path / "pendulum.xml"
    path.write_text(MODEL % (COARSE, "Euler", DAMPING, ARMATURE, 0.0, MASS))
    setup = prepare(robot.of_file(path), recorded(scale=SCALE, sigma=1e-3), Request(FEW))
    fitter, fit = fitted(setup)
    selection = SimpleNamespace(
        estimated=SimpleNamespace(step=lambda r: likeliest(dataclasses.replace(fit, r=r), fitter))
    )
    found = SimpleNamespace(setup=setup, model=SimpleNamespace(fit=fit, effects=()), selection=selection)
    shift = again._shift(found)
    damping, armature, mass = np.abs(fit.values - SCALE)
    assert armature > 0.01
    _, S = fit.quadratic()[0].weighted(fit.weight)
    noise = np.sqrt(np.linalg.inv(S)[1, 1])  # of the estimate: a fit to other noise of the sensors lies elsewhere
    assert noise < armature / 4
    assert abs(fit.values[1] + shift[1] - SCALE[1]) < armature / 4 + noise
    assert abs(shift[0]) < 0.005 and abs(shift[2]) < 0.001


def likeliest(fit, fitter):
    """The step beside white noise alone."""
    g, S = fit.quadratic()[0].weighted(fit.weight)
    precision, pull, low, high = fit.prior()
    return solve(S + np.diag(precision), g + pull, low, high)


def test_known_parameters_are_moved_and_keep_what_is_extrapolated_of_that():
    """A quarter of the step was simulated: a quarter of the shift is extrapolated. An effect's number stays."""
    off = np.sqrt(np.diag(AtFinerSteps(np.array([0.04, -0.3])).covariance(1)))
    assert off == pytest.approx([0.01, 0.3])


def test_shifts_are_told_of_effects_where_they_are_more_than_two_standard_deviations():
    coordinates = [SimpleNamespace(name=n, unit=u) for n, u in (("mass", "kg"), ("stall", "N m"), ("speed", "rad/s"))]
    fit = SimpleNamespace(coordinates=coordinates, values=np.array([1.0, 3.5, 20.0]))
    effect = SimpleNamespace(coordinates=coordinates[1:])
    model = SimpleNamespace(fit=fit, effects=(effect,))
    together = np.diag([1e-6, 1e-4, 1.0])
    (told,) = AtFinerSteps(np.array([0.5, 0.1, 1.9])).notes(model, together)
    assert "stall 3.6 in place of 3.5 N m (their intervals allow for it)" in told
    assert "mass" not in told and "speed" not in told
    assert AtFinerSteps(np.array([0.5, 0.01, 1.9])).notes(model, together) == []


@pytest.mark.parametrize(("integrator", "touching"), [("RK4", False), ("Euler", True)])
def test_nothing_is_simulated_where_it_would_say_nothing(monkeypatch, integrator, touching):
    model = mujoco.MjModel.from_xml_string(MODEL % (COARSE, integrator, DAMPING, ARMATURE, 0.0, MASS))
    found = found_at(None, robot=SimpleNamespace(mj_model=model), physics=None)
    monkeypatch.setattr(again, "contacts", lambda physics: touching)
    assert again.at_finer_steps(found, lambda text, done, total: None) is found
