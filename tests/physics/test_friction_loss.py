"""A model's frictionloss without the solver: it moves as MuJoCo C does with its rows."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting import robot
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics, control_step
from bayessim_mjx.physics.native import FrictionLoss, rubbing

DT, TIMESTEP = 0.01, 0.0005
ARM = """
<mujoco>
  <option timestep="0.0005" integrator="implicitfast"/>
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 1 0" damping="0.1" frictionloss="6" solreffriction=".05 1" solimpfriction=".7 .8"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".02" mass="1" contype="0"/>
      <body pos=".5 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.1" frictionloss="2" solreffriction="-1 -60"/>
        <geom type="capsule" fromto="0 0 0 .5 0 0" size=".02" mass="1" contype="0"/>
      </body>
    </body>
  </worldbody>
  {}
  <actuator><motor name="elbow" joint="elbow"/></actuator>
</mujoco>
"""
COMMANDS = 5 * np.sin(8 * DT * np.arange(100))[:, None]


def moved(model, effects=()):
    """`[T, nv]`, angles by our physics."""
    p = Physics(model, DT, ParameterSpace(), effects)

    def body(world, command):
        world, _ = control_step(p, world, command)
        return world, world.qpos

    run = jax.jit(lambda u: jax.lax.scan(body, p.world(jnp.zeros(0)), u)[1])
    return np.asarray(run(jnp.asarray(COMMANDS, jnp.float32)))


def test_it_moves_as_mujocos_rows_do():
    """To 6 % of what friction changes and 15 % of what its softness does: rigid friction is another motion."""
    model = mujoco.MjModel.from_xml_string(ARM.format(""))
    data, truth = mujoco.MjData(model), []
    for row in COMMANDS:
        data.ctrl[:] = row
        mujoco.mj_step(model, data, round(DT / TIMESTEP))
        truth.append(data.qpos.copy())
    names = rubbing(model)
    assert names == ("shoulder", "elbow")
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS)
    assert rubbing(model) == ()  # who switched it off wants none
    own, without = moved(model, [FrictionLoss(names)]), moved(model)
    model.dof_solref[:] = [2 * TIMESTEP, 1.0]
    rigid = moved(model, [FrictionLoss(names)])
    off = np.abs(own - truth).max()
    assert off < 0.06 * np.abs(without - truth).max() and off < 0.15 * np.abs(rigid - truth).max()


def test_a_tendon_that_rubs_keeps_the_solver():
    tendon = '<tendon><fixed frictionloss=".1"><joint joint="shoulder" coef="1"/></fixed></tendon>'
    assert rubbing(mujoco.MjModel.from_xml_string(ARM.format(tendon))) == ()


@pytest.mark.parametrize("names", [(), ("shoulder", "elbow")])
def test_a_robot_without_rows_has_none(names):
    own = dataclasses.replace(robot.robot_of(mujoco.MjModel.from_xml_string(ARM.format(""))), rubbing=names)
    physics = own.physics(DT)
    assert physics.template._impl.nefc == (0 if names else 2)
    assert any(isinstance(e, FrictionLoss) for e in physics.effects) == bool(names)
