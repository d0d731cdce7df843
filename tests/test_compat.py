"""Programs of arms and hands have options for the compiler, those of others none; both give what the function gives."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.mjx._src import math, solver

from bayessim_mjx import compat
from bayessim_mjx.compat import mjx

ARM = SimpleNamespace(mj_model=SimpleNamespace(body_parentid=[0, 0, 1, 2, 3, 4, 5, 5]))
LEGS = SimpleNamespace(mj_model=SimpleNamespace(body_parentid=[0, 0, *[1, 2, 3, 4], *[1, 6, 7, 8], *[1, 10, 11, 12]]))

HAND = SimpleNamespace(mj_model=SimpleNamespace(body_parentid=[0, *range(8), *range(4, 8), *range(4, 8), *range(4, 8)]))


def doubled(x, more=0.0):
    return 2 * x + more


@pytest.mark.parametrize("env", [ARM, LEGS, SimpleNamespace()])
def test_a_program_is_the_function_also_inside_of_another(env):
    program = compat.program(doubled, env)
    assert program(1.0, more=3.0) == 5.0
    assert jax.jit(lambda x: program(x) + 1)(jnp.ones(())) == 3.0
    assert jnp.array_equal(jax.vmap(program)(jnp.arange(3.0)), 2 * jnp.arange(3.0))
    assert program.lower(1.0).compile()(1.0) == 2.0


def test_only_arms_and_hands_are_compiled_without_fusions(monkeypatch):
    asked = []
    monkeypatch.setattr(compat, "compiler_options", lambda fused: asked.append(fused) or {})
    for env in (LEGS, None, ARM, HAND):
        compat.program(doubled, env)(1.0)
    assert asked == [True, True, False, False]


def test_whether_the_compiler_knows_the_options_is_found_out_also_inside_of_another_program():
    """As where a policy is loaded before anything else was compiled: its shapes are those of a traced beginning."""
    compat.compiler_options.cache_clear()
    jax.eval_shape(lambda x: compat.program(doubled, ARM)(x), jnp.ones(()))
    assert jax.default_backend() != "cpu" or "xla_cpu_use_fusion_emitters" in compat.compiler_options()


def test_a_rotation_is_mjx_s_to_the_bit():
    rng = np.random.default_rng(0)
    axes, angles = rng.normal(size=(50, 3)).astype(np.float32), rng.uniform(-7, 7, 50).astype(np.float32)
    inserted = jax.vmap(lambda axis, angle: jnp.insert(axis * jnp.sin(angle * 0.5), 0, jnp.cos(angle * 0.5)))
    assert math.axis_angle_to_quat is compat._axis_angle_to_quat  # what MJX calls
    np.testing.assert_array_equal(jax.vmap(math.axis_angle_to_quat)(axes, angles), inserted(axes, angles))


BALLS = """<mujoco><option timestep=".004"/><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .1"><freejoint/>
  <geom type="box" size=".1 .1 .02" mass="1" contype="0" conaffinity="0"/>
  <geom type="sphere" size=".05" pos=".1 0 -.05"/><geom type="sphere" size=".05" pos="-.1 .1 -.05"/>
  <geom type="sphere" size=".05" pos="-.1 -.1 -.05"/></body></worldbody></mujoco>"""


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="elsewhere the line search is a scan")
def test_line_searches_that_end_give_the_same_accelerations_as_those_of_full_length(monkeypatch):
    model = mujoco.MjModel.from_xml_string(BALLS)
    put = mjx.put_model(model)
    worlds = jax.vmap(lambda speed: mjx.make_data(model).replace(qvel=speed))(jnp.eye(6) - 0.5)

    def steps(asked):
        return jax.jit(jax.vmap(lambda world: mjx.step(put, mjx.step(put, world)).qacc))(asked)

    found = steps(worlds)
    monkeypatch.setattr(solver, "_while_loop_scan", solver._while_loop_scan.scan)
    np.testing.assert_allclose(found, steps(worlds), rtol=1e-4, atol=1e-3)
    assert np.abs(found).max() > 10  # m/s^2: the floor pushes
