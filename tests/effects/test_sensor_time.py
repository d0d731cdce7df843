"""Delays and filters of sensors against fine time: what a true sensor shows, and motions shifted by parts of a step."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.signal import lsim

from bayessim_mjx.effects import make
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics, begin, control_step
from tests.effects.test_sensor_effects import DT, STEPS, XML

SHARP = XML.replace('timestep="0.005"', 'timestep="0.002" integrator="RK4"')  # no errors but the sensors'


def sharp_truth():
    """(qpos, qvel at every fine step `[20 ms / 0.2 ms * STEPS + 1, 2]`, command of every sub-step) from MuJoCo C."""
    model = mujoco.MjModel.from_xml_string(SHARP)
    model.opt.timestep /= 10
    data, t = mujoco.MjData(model), 0.002 * np.arange(10 * STEPS)
    command = np.stack([0.8 * np.sin(15 * t) + 0.3 * np.sin(23 * t), 4.5 * np.sin(17 * t)], axis=1)
    rows = []
    for ctrl in command:
        for _ in range(10):
            rows.append((data.qpos.copy(), data.qvel.copy()))
            data.ctrl = ctrl
            mujoco.mj_step(model, data)
    return *(np.stack(x) for x in zip(*rows, strict=True)), command.reshape(STEPS, 10, 2)


@pytest.fixture(scope="module")
def predicted():
    """Measured qpos and qvel `[25, 4]` of 25 control steps (commands `[25, 10, 2]`) that begin within a log."""
    effects = [make(n, where="all") for n in ("sensor_delay", "sensor_filter")]
    physics = Physics(mujoco.MjModel.from_xml_string(SHARP), DT, ParameterSpace(), effects)

    def body(world, command):
        world, _ = control_step(physics, world, command)
        return world, jnp.concatenate([world.measurement["qpos"], world.measurement["qvel"]])

    return jax.jit(lambda theta, motion, commands: jax.lax.scan(body, begin(physics, theta, motion), commands)[1])


@pytest.mark.parametrize("delay, constant", [(2.5e-3, 0.0), (0.0, 6e-3)])
@pytest.mark.slow
def test_agrees_with_a_sensor_in_fine_time(predicted, delay, constant):
    """The true parameter predicts what a true sensor shows, at 100 to 200 rad/s^2 (an arm has 50).

    To 0.3 mrad, and to 4 mrad/s rms. On a line between control steps velocities would differ by 34 and 44 mrad/s.
    """
    qpos, qvel, command = sharp_truth()
    assert np.abs(np.diff(qvel[::10], axis=0) / 0.002).max(axis=0).min() > 50
    t = 2e-4 * np.arange(len(qpos))
    true = np.concatenate([qpos, qvel], axis=1).T
    if delay:
        late = [np.interp(t - delay, t, x) for x in true]
    else:
        late = [lsim(([1 / constant], [1, 1 / constant]), x, t)[1] for x in true]
    log = np.stack(late, axis=1)[::100]
    arrays = [jnp.asarray(x[10:31], jnp.float32) for x in (log[:, :2], log[:, 2:], command)]
    theta, ahead = (jnp.asarray(x, jnp.float32) for x in ([delay, constant], command[20:45]))
    seen = predicted(theta, Motion(*arrays, start=10), ahead)
    np.testing.assert_allclose(seen[:, :2], log[21:46, :2], atol=3e-4)
    assert np.sqrt(np.mean((seen[:, 2:] - log[21:46, 2:]) ** 2)) < 4e-3


@pytest.mark.parametrize("steps", [0.0, 0.25, 0.5, 1.75])
def test_a_motion_between_rows_is_as_noisy_as_a_row(steps):
    """White positions and velocities keep their variance, to an eighth; a mean of two rows would halve it."""
    physics = Physics(
        mujoco.MjModel.from_xml_string(XML), DT, ParameterSpace(), [make("sensor_delay", where=("a", "b"))]
    )
    rng, rows = np.random.default_rng(0), 20_000
    noise = [jnp.asarray(1e-3 * rng.normal(size=(rows, 2)), jnp.float32), jnp.asarray(rng.normal(size=(rows, 2)) * 0.1)]
    motion = Motion(noise[0], noise[1] * 1e-6, jnp.zeros((rows, 4, 2)), start=6)
    still = np.asarray(motion.shifted(physics.sites[0], jnp.full(2, steps)))[9:-9, :, 0]
    assert np.var(still) == pytest.approx(1e-6, rel=0.05)
    motion = Motion(noise[0], noise[1].astype(jnp.float32), jnp.zeros((rows, 4, 2)), start=6)
    speed = np.asarray(motion.shifted(physics.sites[0], jnp.full(2, steps)))[9:-9, :, 1]
    assert 0.98 * 0.01 < np.var(speed) < 1.15 * 0.01


def test_a_motion_is_shifted_by_each_joints_own_time():
    """q'' constant is exact, ends are held even at speed, and joints are found behind a free joint's quaternion."""
    free = "<worldbody><body><freejoint/><geom/></body>"
    physics = Physics(
        mujoco.MjModel.from_xml_string(XML.replace("<worldbody>", free)),
        DT,
        ParameterSpace(),
        [make("sensor_delay", where=("a", "b"))],
    )
    t = DT * np.arange(12)[:, None]
    inside, steps = np.clip(t, 2 * DT, 9 * DT), np.array([0.0, 0.3])
    curve = [lambda x: 1 + 3 * x - 25 * x**2, lambda x: 3 - 50 * x]
    qpos, qvel = np.repeat(curve[0](inside), 9, 1), np.repeat(curve[1](inside), 8, 1)
    arrays = [jnp.asarray(x, jnp.float32) for x in (qpos, qvel, np.zeros((12, 4, 2)))]
    out = np.asarray(Motion(*arrays, start=6).shifted(physics.sites[0], jnp.asarray(steps, jnp.float32)))
    assert np.array_equal(out[..., 0, 0], arrays[0][:, 7]) and np.array_equal(out[..., 0, 1], arrays[1][:, 6])
    want = np.clip(t[:, 0] + 0.3 * DT, 2 * DT, 9 * DT)
    some = [0, *range(3, 12)]  # beside a held end half of the acceleration shows
    np.testing.assert_allclose(out[some, 1, 0], curve[0](want)[some], atol=1e-6)
    np.testing.assert_allclose(out[3:8, 1, 1], curve[1](want)[3:8], atol=1e-5)
