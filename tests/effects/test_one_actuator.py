"""Effects of a single actuator: the gradient at their neutral values, and limits of a tendon."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Drive, Physics, control_step

ONE = """<mujoco><option timestep=".005" gravity="0 0 0"/><worldbody><body>
    <joint name="x" type="slide" {}/><geom size=".1" mass="2"/></body></worldbody>{}</mujoco>"""


def test_the_gradient_at_neutral_is_that_of_the_law():
    """dv/dgain = F dt / m, dv/dbias = dt / m, also by reverse mode: the number is MJX's there, the derivative ours."""
    xml = ONE.format('actuatorfrcrange="-9 9"', '<actuator><motor joint="x"/></actuator>')
    effects = [make(name, where="all") for name in ("actuator_gain", "actuator_bias")]
    p = Physics(mujoco.MjModel.from_xml_string(xml), 0.005, ParameterSpace(), effects)

    def speed(theta):
        return control_step(p, p.world(theta), jnp.array([3.0]))[0].qvel[0]

    got = jax.jit(jax.grad(speed))(jnp.asarray(p.space.nominal, jnp.float32))
    np.testing.assert_allclose(got, [3 * 0.005 / 2, 0.005 / 2], rtol=1e-5)


def test_what_a_limit_of_a_tendon_makes_impossible_is_refused():
    tendon = '<tendon><fixed name="t" actuatorfrcrange="-1 1"><joint joint="x" coef="1"/></fixed></tendon>'
    xml = ONE.format("", tendon + '<actuator><motor name="pull" tendon="t"/></actuator>')
    model = mujoco.MjModel.from_xml_string(xml)
    with pytest.raises(UserError, match="actuator_gain: actuator 'pull' drives a tendon with an actuatorfrcrange"):
        Physics(model, 0.005, ParameterSpace(), [make("actuator_gain", where="all")])
    p = Physics(model, 0.005, ParameterSpace(), [make("actuator_delay", where="all")])
    with pytest.raises(UserError, match="a drive cannot be switched off where a tendon has an actuatorfrcrange"):
        control_step(p, p.world(p.space.nominal), jnp.zeros(1), Drive(enabled=jnp.zeros(1)))
