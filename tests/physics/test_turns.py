"""Many worlds under implicitfast on a CPU: two batched factorisations at once waited for each other for ever."""

import subprocess
import sys

import pytest

STEPS = """
import jax, jax.numpy as jnp, mujoco
from bayessim_mjx import make
from bayessim_mjx.physics import Physics, control_step
model = make("BallBalance").physics.mj_model
model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
physics = Physics(model, 0.01, make("BallBalance").physics.model_space)
theta = jnp.tile(jnp.asarray(physics.space.nominal, jnp.float32), (256, 1))
worlds = jax.vmap(physics.world)(theta)
step = jax.vmap(lambda w: control_step(physics, w, jnp.zeros(model.nu))[0])
run = jax.jit(lambda worlds: jax.lax.scan(lambda w, _: (step(w), None), worlds, None, 100)[0])
for _ in range(2):
    worlds = jax.block_until_ready(run(worlds))
print(bool(jnp.isfinite(worlds.qpos).all()))
"""


@pytest.mark.slow
def test_many_worlds_step_to_the_end():
    done = subprocess.run([sys.executable, "-c", STEPS], capture_output=True, text=True, timeout=500)
    assert done.stdout.strip() == "True", done.stderr
