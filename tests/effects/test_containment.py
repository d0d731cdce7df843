"""Laws that contain others: with the numbers of the special case, and all else neutral, the motion is the same."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import load, make, names
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics, control_step

XML = """<mujoco><option timestep="0.005"/><worldbody><body><joint name="hinge" axis="0 1 0" damping=".02"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5" mass=".5" contype="0"/></body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator></mujoco>"""
# numbers of the special case; asymmetric friction has each of them twice
AMOUNTS = {"actuator_saturation": 1.2, "coulomb_friction": 0.2, "viscous_friction": 0.1, "rate_limit": 0.05}
LIMITS = {"lugre_friction"}  # its laws are those that it comes close to with stiff bristles
FLOATING = {"directional_drag", "wind"}  # looked at in test_floating_bodies
PAIRS = [(g, s) for g in names() if g not in LIMITS | FLOATING for s in getattr(load(g), "contains", ())]


def swung(name, amount, unit=None):
    """`[T]`, angles; amount: of each number with this unit (None: of the only one), the others neutral."""
    place = "motor" if load(name).kind == "actuator" else "hinge"
    p = Physics(mujoco.MjModel.from_xml_string(XML), 0.02, ParameterSpace(), [make(name, where=place)])
    own = p.blocks[-1].quantities
    alike = [q for q in own if unit is None or q.unit == unit]
    theta = [amount if q in alike and not q.shape else q.neutral for q in own]
    if name == "stribeck_friction":
        theta[1] = 0.0  # its excess has the unit of its level
    commands = jnp.asarray(1.5 * np.sign(np.sin(np.arange(150) / 12)), jnp.float32)

    def step(world, u):
        world, _ = control_step(p, world, u[None])
        return world, world.qpos[0]

    return np.asarray(jax.jit(lambda: jax.lax.scan(step, p.world(jnp.float32(theta)), commands)[1])())


@pytest.mark.parametrize(("general", "special"), PAIRS)
def test_a_special_case_is_the_law_that_contains_it(general, special):
    (unit,) = {q.unit for q in load(special).quantities if not q.optional}
    amount = AMOUNTS[special]
    one, other = swung(special, amount), swung(general, amount, unit)
    np.testing.assert_allclose(other, one, atol=2e-4)
    free = swung("armature", 0.0)
    assert np.abs(one - free).max() > 0.05


def test_every_containment_is_looked_at():
    assert ("speed_torque_limit", "actuator_saturation") in PAIRS and len(PAIRS) >= 5
