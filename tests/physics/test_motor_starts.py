"""Motors ahead of their links at a start: the ring of two inertias on a spring, which is known in closed form."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import load
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Drive, Physics, begin, control_step, past_of

MOTOR, LINK, STIFFNESS, DAMPING = 0.02, 0.03, 40.0, 0.02  # kg m^2, kg m^2, N m/rad, of critical
XML = f"""<mujoco><option timestep=".0005" gravity="0 0 0" integrator="implicitfast"/><worldbody><body>
  <joint name="hinge" axis="0 0 1" armature="{MOTOR}"/>
  <inertial pos="0 0 0" mass="1" diaginertia="{LINK} {LINK} {LINK}"/></body></worldbody>
  <actuator><motor name="m" joint="hinge"/></actuator></mujoco>"""
COUNT, DT, PAST = 40, 0.005, 10


def shown(encoder, ahead):
    """Positions `[COUNT]` that the encoder shows, from rest, the motor `ahead` = (angle, speed) of its link."""
    effect = load("joint_elasticity")("hinge").with_all()
    physics = Physics(mujoco.MjModel.from_xml_string(XML), DT, ParameterSpace(()), (effect,))
    theta = jnp.array([1 / STIFFNESS, DAMPING, encoder])
    rows = 2 * PAST + 1
    motion = Motion(jnp.zeros((rows, 1)), jnp.zeros((rows, 1)), jnp.zeros((rows, physics.substeps, 1)), start=PAST)

    def run():
        world = begin(physics, theta, motion)
        past = past_of(physics, world, motion).replace(ahead=jnp.asarray(ahead))

        def step(world, k):
            world, _ = control_step(physics, past.led(k, world), jnp.zeros(1), Drive())
            return world, world.measurement["qpos"][0]

        return jax.lax.scan(step, past.world, jnp.arange(PAST + COUNT))[1][PAST:]

    return np.asarray(jax.jit(run)())


def ring(encoder, ahead):
    """The same by hand: the relative angle rings, the common motion goes on."""
    (angle, speed), time = ahead, DT * np.arange(1, COUNT + 1)
    whole = MOTOR + LINK
    rate = np.sqrt(STIFFNESS * whole / (MOTOR * LINK))
    decay, damped = DAMPING * rate, rate * np.sqrt(1 - DAMPING**2)
    phase = damped * time
    apart = np.exp(-decay * time) * (angle * np.cos(phase) + (speed + decay * angle) / damped * np.sin(phase))
    # the side that the encoder does not see is moved: the motor from a link at rest, or the link from a motor at rest
    share = -LINK / whole if encoder else MOTOR / whole
    return share * (angle + speed * time) + (LINK if encoder else -MOTOR) / whole * apart


@pytest.mark.parametrize("encoder", [0.0, 1.0])
@pytest.mark.parametrize("ahead", [(0.01, 0.0), (0.0, 0.3), (-0.02, 0.2)])
def test_a_motor_ahead_of_its_link_rings_as_two_inertias_do(encoder, ahead):
    want = ring(encoder, ahead)
    np.testing.assert_allclose(shown(encoder, ahead), want, atol=0.02 * np.abs(want).max())


def test_without_a_motor_of_its_own_nothing_moves():
    assert not shown(0.0, (0.0, 0.0)).any()
