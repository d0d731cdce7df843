"""Motion by the effects and by MuJoCo C, and fits of one to the other."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.optimize import least_squares

from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics, control_step

CONTROL = 0.02  # s


def physics(xml, effects):
    return Physics(mujoco.MjModel.from_xml_string(xml), CONTROL, ParameterSpace(), effects)


def moved(world, thetas, command, qpos=None, qvel=None):
    """Positions `[N, T+1, nq]` in the worlds `thetas` `[N, d]` under the same commands `[T, nu]`, from a reset."""
    model = world.mj_model
    start = [np.zeros(size) if x is None else x for x, size in ((qpos, model.nq), (qvel, model.nv))]
    return np.asarray(_episodes(world)(np.float32(thetas), *map(np.float32, start), np.float32(command)))


@functools.lru_cache
def _episodes(physics):
    def one(theta, qpos, qvel, command):
        def step(world, row):
            world, _ = control_step(physics, world, row)
            return world, world.measurement["qpos"]

        world = physics.world(theta, qpos, qvel)
        return jnp.concatenate([world.measurement["qpos"][None], jax.lax.scan(step, world, command)[1]])

    return jax.jit(jax.vmap(one, in_axes=(0, None, None, None)))


def truth(model, command, qpos=None, qvel=None, push=None):
    """The same by MuJoCo C `[T+1, nq]`; `push(model, data)` acts in every timestep."""
    data = mujoco.MjData(model)
    data.qpos[:] = 0 if qpos is None else qpos
    data.qvel[:] = 0 if qvel is None else qvel
    out = [data.qpos.copy()]
    for row in command:
        data.ctrl[:] = row
        for _ in range(round(CONTROL / model.opt.timestep)):
            if push is not None:
                mujoco.mj_forward(model, data)
                push(model, data)
            mujoco.mj_step(model, data)
        out.append(data.qpos.copy())
    return np.array(out)


def edited(xml, effect, values):
    """The model with the effect written natively."""
    spec = mujoco.MjSpec.from_string(xml)
    assert effect.edit(spec, values) is None
    return spec.compile()


def recovered(simulate, real, start, scale, rows):
    """Least squares from `start` `[d]`; `simulate(thetas [rows, d])` runs a fixed number of worlds at once."""
    start, scale = np.asarray(start, float), np.asarray(scale, float)

    def batch(points):
        points = np.asarray(points) * scale
        return simulate(np.concatenate([points, np.repeat(points[:1], rows - len(points), 0)]))[: len(points)]

    def jacobian(x):
        steps = 1e-3 * np.eye(len(x))
        apart = batch(np.concatenate([x + steps, x - steps])).reshape(2, len(x), -1)
        return (apart[0] - apart[1]).T / 2e-3

    return least_squares(lambda x: (batch([x])[0] - real).ravel(), start / scale, jacobian, max_nfev=15).x * scale
