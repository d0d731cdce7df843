"""A bias beside a spring is another angle of rest; dry friction beside the same spring is not."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis.evidence import laws
from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.selection.models import scored
from bayessim_mjx.diagnosis.selection.screen import screen
from bayessim_mjx.diagnosis.selection.search_state import SearchState
from bayessim_mjx.diagnosis.setup import prepare
from tests.diagnosis.pendulums import fitted, nominal, recorded

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # a whole fit


def test_what_a_named_law_can_do_by_itself_is_told_as_hidden_beside_it(tmp_path):
    setup = prepare(nominal(tmp_path), recorded(), Request(["joint_spring", "actuator_bias", "coulomb_friction"]))
    fitter, fit = fitted(setup)
    base = scored(fitter, fit, ())
    pool = SearchState(fitter, setup.candidates, setup.settings, fit, base)
    pool.screened = screen(fitter, fit, setup.candidates, setup.settings.screened, secants=pool.secants)
    own = {c.effect: c for c in setup.candidates}
    spring = own["joint_spring"]
    values = {"stiffness": 0.1, "cubic": 0.0, "rest": 0.3}
    start = [next(v for name, v in values.items() if name in c.name) for c in spring.coordinates]
    sprung = scored(fitter, fitter.refresh(fitter.derive(fit, spring.coordinates, np.array(start))), (spring,))
    assert laws.by_effects(pool, sprung) == (own["actuator_bias"].label,)
    dry = own["coulomb_friction"]
    rubbing = fitter.derive(fit, dry.coordinates, np.array([0.03, 0.0]))
    assert laws.by_effects(pool, scored(fitter, fitter.refresh(rubbing), (dry,))) == ()
    assert laws.by_effects(pool, base) == ()
