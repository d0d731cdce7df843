"""What friction effects refuse, and what of them no MJCF can say."""

import dataclasses

import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from bayessim_mjx.errors import UserError
from tests.effects.test_friction_effects import ARM, NAMES


def test_what_cannot_be_written_says_so():
    spec = mujoco.MjSpec.from_string(ARM)
    for name in ("stribeck_friction", "load_friction", "asymmetric_friction", "quadratic_drag"):
        effect = make(name, where="a")
        assert "use effects.yaml" in effect.edit(spec, {"a": {q.name: 0.1 for q in effect.quantities}})
    spring = make("joint_spring", where="a")
    assert "cubic" in spring.edit(spec, {"a": {"stiffness": 1.0, "cubic": 1.0, "rest": 0.0}})
    assert spring.edit(spec, {"all": {"stiffness": 1.0, "cubic": 0.0, "rest": np.pi}}) is None
    np.testing.assert_allclose(spec.compile().qpos_spring, np.pi, rtol=1e-6)
    assert "has a spring already" in spring.edit(spec, {"a": {"stiffness": 1.0, "cubic": 0.0, "rest": 0.0}})


@pytest.mark.parametrize("name", NAMES)
def test_negative_friction_is_refused(name):
    own = make(name, where="z").space().parameters[0]
    with pytest.raises(UserError, match=f"{own.name}: range begins at -1"):
        dataclasses.replace(make(name, where="z"), parameters=(dataclasses.replace(own, low=-1.0),))
