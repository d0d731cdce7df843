"""Along directions that motion cannot tell, beliefs decide and intervals are wide; what motion tells stays put."""

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
    return prepare(nominal(tmp_path_factory.mktemp("ridges")), logs, FEW)


def model_of(setup, values, *labels):
    """The effects fitted from `values`, the known parameters scaled by the last of them."""
    fitter, job = fitted(setup)
    chosen = [next(c for c in setup.candidates if c.label == label) for label in labels]
    job = fitter.derive(job, [x for c in chosen for x in c.coordinates], np.array(values))
    job.values[: len(fitter.base)] *= values[-1]
    fitter.iterate([job], 10, lambda j: range(len(j.coordinates)))
    return fitter, scored(fitter, fitter.refresh(job), chosen)


def test_a_stronger_motor_on_a_heavier_link_moves_alike_so_beliefs_decide(setup):
    """Torque, masses, damping and friction times one number: the same motion (equation of motion is homogeneous)."""
    fitter, model = model_of(setup, (1.1 * FRICTION, 1.1), "coulomb_friction@hinge", "actuator_gain@motor")
    new, found = weak_directions.settled(fitter, model)
    gain, level = (new.job.names.index(n) for n in ("motor.actuator_gain.gain", "hinge.coulomb_friction.level"))
    assert found.ways.shape[1] and found.simulated.min() == 0.0 < found.differenced.min()
    ratio = new.job.values[:3] / new.job.values[gain]
    np.testing.assert_allclose(ratio, model.job.values[:3] / model.job.values[gain], rtol=0.01)
    np.testing.assert_allclose(new.job.values[level] / new.job.values[gain], FRICTION, rtol=0.05)
    assert abs(np.mean(new.job.values[:3]) - 1.0) < 0.03 < abs(np.mean(model.job.values[:3]) - 1.0)
    assert new.job.r.ravel() @ new.job.r.ravel() < 1.01 * (model.job.r.ravel() @ model.job.r.ravel())
    sd = np.sqrt(np.diag(uncertainty.covariance(fitter, new, found)))
    assert 0.03 < sd[gain] < 0.12  # the link's mass, known to 20 %, is all that holds it
    assert abs(new.job.values[gain] - 1.0) < 1.645 * sd[gain]


def test_what_motion_tells_stays_where_it_is(setup):
    fitter, model = model_of(setup, (FRICTION, 1.0), "coulomb_friction@hinge", "viscous_friction@hinge")
    alone = scored(fitter, model.job, model.effects)
    new, found = weak_directions.settled(fitter, alone)
    level = new.job.names.index("hinge.coulomb_friction.level")
    np.testing.assert_allclose(new.job.values[level], alone.job.values[level], rtol=0.02)
    sd = np.sqrt(np.diag(uncertainty.covariance(fitter, new, found)))
    assert sd[level] < 0.03 * FRICTION
    damping, extra = 0, new.job.names.index("hinge.viscous_friction.damping")
    np.testing.assert_allclose(0.02 * new.job.values[damping] + new.job.values[extra], 0.02 * SCALE[0], rtol=0.03)
