"""Along directions that motion cannot tell, beliefs decide and intervals are wide; what motion tells stays put."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bayessim_mjx.diagnosis.selection import uncertainty, weak_directions
from bayessim_mjx.diagnosis.selection.models import scored
from bayessim_mjx.diagnosis.setup import prepare
from tests.diagnosis.pendulums import FEW, fitted, nominal, recorded

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole diagnoses and fits

SCALE = (1.1, 1.05, 0.95)
FRICTION = 0.03


@pytest.fixture(scope="module")
def setup(tmp_path_factory):
    logs = recorded(scale=SCALE, friction=FRICTION)
    return prepare(nominal(tmp_path_factory.mktemp("ridges")).stated(("5%",)), logs, FEW)


def model_of(setup, values, *labels):
    """The effects fitted from `values`, the known parameters scaled by the last of them."""
    fitter, fit = fitted(setup)
    chosen = [next(c for c in setup.candidates if c.label == label) for label in labels]
    fit = fitter.derive(fit, [x for c in chosen for x in c.coordinates], np.array(values))
    scale = np.where(np.arange(len(fit.values)) < len(fitter.base), values[-1], 1.0)
    fit = replace(fit, values=scale * fit.values)
    (fit,) = fitter.iterate([fit], 10, lambda f: range(len(f.coordinates)))
    return fitter, scored(fitter, fitter.refresh(fit), chosen)


def test_a_stronger_motor_on_a_heavier_link_moves_alike_so_beliefs_decide(setup):
    """Torque, masses, damping and friction times one number: the same motion (equation of motion is homogeneous)."""
    fitter, model = model_of(setup, (1.1 * FRICTION, 1.1), "coulomb_friction@hinge", "actuator_gain@motor")
    new, found = weak_directions.settled(fitter, model)
    gain, level = (new.fit.names.index(n) for n in ("motor.actuator_gain.gain", "hinge.coulomb_friction.level"))
    assert found.ways.shape[1] and found.simulated.min() == 0.0 < found.differenced.min()
    ratio = new.fit.values[:3] / new.fit.values[gain]
    np.testing.assert_allclose(ratio, model.fit.values[:3] / model.fit.values[gain], rtol=0.01)
    np.testing.assert_allclose(new.fit.values[level] / new.fit.values[gain], FRICTION, rtol=0.05)
    assert abs(np.mean(new.fit.values[:3]) - 1.0) < 0.03 < abs(np.mean(model.fit.values[:3]) - 1.0)
    assert new.fit.r.ravel() @ new.fit.r.ravel() < 1.01 * (model.fit.r.ravel() @ model.fit.r.ravel())
    sd = np.sqrt(np.diag(uncertainty.covariance(fitter, new, found)))
    assert 0.05 / 3**0.5 * 0.7 < sd[gain] < 0.05  # mass, damping and rotor inertia, known to 5 % each, hold it
    assert abs(new.fit.values[gain] - 1.0) < 2.5 * sd[gain]  # the mass is two standard deviations off its data sheet


def test_what_motion_tells_stays_where_it_is(setup):
    fitter, model = model_of(setup, (FRICTION, 1.0), "coulomb_friction@hinge", "viscous_friction@hinge")
    alone = scored(fitter, model.fit, model.effects)
    new, found = weak_directions.settled(fitter, alone)
    level = new.fit.names.index("hinge.coulomb_friction.level")
    np.testing.assert_allclose(new.fit.values[level], alone.fit.values[level], rtol=0.02)
    sd = np.sqrt(np.diag(uncertainty.covariance(fitter, new, found)))
    assert sd[level] < 0.03 * FRICTION
    damping, extra = 0, new.fit.names.index("hinge.viscous_friction.damping")
    np.testing.assert_allclose(0.02 * new.fit.values[damping] + new.fit.values[extra], 0.02 * SCALE[0], rtol=0.03)


def test_a_law_that_does_no_more_far_away_is_told_nearer_by():
    """Friction that holds a joint still: the cost rises beside the fit and stays there, bounded below by 0 friction."""

    def cost(values):
        return 1e4 * (1.0 + np.tanh((values[0] / 0.05) ** 2))

    it = object.__new__(weak_directions._Profile)
    it.ways, it.weak, it.less, it.fit = np.ones((1, 1)), np.array([0]), 1.0, SimpleNamespace(values=np.zeros(1))
    it._room = lambda way: (-0.1, 3.0)
    it.costs = lambda points, fixed: (np.array([cost(p) for p in points]), points)
    curvature = np.array([1e4 / 0.05**2])
    assert it._along([(weak_directions.RULES.reach,)])[1][0] == 0.0
    (reaches,) = it._reaches(curvature, cost(np.zeros(1)))
    assert 0.01 < reaches[0] < 0.05
    np.testing.assert_allclose(it._along([reaches])[1], curvature, rtol=0.2)
