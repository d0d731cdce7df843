"""MJX with its small factorisations written out: the same steps, and no LAPACK in the program."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx import compat, linalg
from bayessim_mjx.compat import mjx

LINK = """<body pos="0 0 -.3"><joint name="j%d" axis="0 1 %g" damping=".1" frictionloss="%g"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02"/>%s</body>"""


def chain(links, friction, integrator):
    body = ""
    for i in reversed(range(links)):
        body = LINK % (i, 0.3 * i, friction, body)
    xml = f'<mujoco><option integrator="{integrator}" timestep=".004"/><worldbody>{body}</worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.iterations = model.opt.ls_iterations = 20
    return model


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.parametrize("friction", [0.0, 0.05])
@pytest.mark.parametrize("links", [2, 6])
def test_steps_are_those_of_mujoco(links, friction, integrator):
    model = chain(links, friction, integrator)
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    data = mujoco.MjData(model)
    data.qpos[:] = np.linspace(0.5, 1.0, links)
    world = mjx.put_data(model, data)
    step, put = jax.jit(mjx.step), mjx.put_model(model)
    for _ in range(25):
        mujoco.mj_step(model, data)
        world = step(put, world)
    np.testing.assert_allclose(np.asarray(world.qpos), data.qpos, atol=2e-5)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="written out on CPUs")
def test_small_robots_are_stepped_without_lapack_and_large_ones_with():
    def program(links):
        model = chain(links, 0.05, "implicitfast")
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        return jax.jit(mjx.step).lower(mjx.put_model(model), mjx.make_data(model)).as_text()

    assert "lapack" not in program(linalg.UNROLLED) and "lapack" in program(linalg.UNROLLED + 1)


def test_what_is_asked_otherwise_is_jaxs_own():
    a = jnp.array([[2.0, 0.5], [0.5, 1.0]])
    for named in ({}, {"lower": True}):
        own, lower = compat._cho_factor(a, **named)
        triangle = jnp.tril(own) if lower else jnp.triu(own).T
        np.testing.assert_allclose(triangle @ triangle.T, a, rtol=1e-6)
        for b in (jnp.array([1.0, 2.0]), jnp.eye(2)):
            np.testing.assert_allclose(compat._cho_solve((own, lower), b), jnp.linalg.solve(a, b), rtol=1e-5, atol=1e-6)
