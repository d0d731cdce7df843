"""One compiled program for all candidates; second order against MuJoCo C; tangent spaces of quaternions."""

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax import monitoring

from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.diagnosis.fitting.simulator import Simulator
from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.setup import prepare
from bayessim_mjx.physics import tangent
from tests.diagnosis.pendulums import nominal, recorded

FLOATING = """<mujoco><worldbody><body><freejoint/><geom size=".1"/>
  <body><joint type="ball"/><geom size=".1"/><body><joint name="h"/><geom size=".1"/></body></body></body></worldbody>
</mujoco>"""

SIGNALS = ("sensor", "actuator")


@pytest.fixture(scope="module")
def setup(tmp_path_factory):
    logs = recorded(count=3, seconds=2.0, sigma=0.0)
    return prepare(nominal(tmp_path_factory.mktemp("model")), logs, Request(["coulomb_friction", "actuator_delay"]))


@pytest.fixture(scope="module")
def simulator(setup):
    return Simulator(setup.physics, setup.fitter.simulator.windows, lanes=32)


@pytest.mark.slow
def test_one_trace_whatever_is_asked(simulator):
    rng = np.random.default_rng(0)
    theta, windows = simulator.physics.space.nominal, len(simulator.windows)
    before = simulator.rollouts
    still = simulator.run(theta[None])
    thetas = np.array([rng.uniform(p.low, p.high) for p in simulator.physics.space.parameters for _ in range(7)])
    many = simulator.run(thetas.reshape(-1, 7).T)
    moved = simulator.run(theta[None], 0.01 * rng.normal(size=(1, windows, 2)))
    pushed = simulator.run(theta[None], force=np.full((1, windows, simulator.windows.steps, 1), 0.1))
    some = simulator.run(theta[None], windows=np.array([2, 0]))
    assert simulator.programs == 1
    assert simulator.rollouts - before == (1 + 7 + 1 + 1) * windows + 2
    assert still.shape == (1, windows, simulator.windows.steps, 2) and many.shape[0] == 7
    np.testing.assert_allclose(some[0], still[0, [2, 0]], atol=1e-6)
    for other in (many, moved, pushed):
        assert np.isfinite(other).all() and np.abs(other[0] - still[0]).max() > 1e-4


def test_its_own_motion_has_no_error(simulator):
    theta = simulator.physics.space.nominal
    cut = simulator.windows
    errors = simulator.run(theta[None])[0]
    batch = cut.batch.replace(
        qpos=cut.batch.qpos - jnp.asarray(errors[..., :1], jnp.float32),
        qvel=cut.batch.qvel - jnp.asarray(errors[..., 1:], jnp.float32),
    )
    own = Simulator(simulator.physics, dataclasses.replace(cut, batch=batch), lanes=32)
    again = own.run(np.stack([theta, theta * 1.1]))
    assert np.abs(again[0]).max() < 2e-6 < 1e-4 < np.abs(again[1]).max()


def test_rows_that_late_sensors_show_of_the_start_move_with_it(tmp_path):
    """Of a delay of .4 rows the first row is .4 start and .6 of the next state: both move by a change of the start.

    Where what sensors remember stays as recorded, the row keeps .4 of the recorded start's noise, and moves by .6.
    """
    logs = recorded(count=2, seconds=2.0, sigma=0.0)
    physics = prepare(nominal(tmp_path), logs, Request(["sensor_delay"]))
    own = physics.fitter.simulator
    theta = own.physics.space.nominal.copy()
    theta[[i for i, p in enumerate(own.physics.space.parameters) if "sensor_delay" in p.name]] = 0.4 * own.physics.dt
    offset = np.zeros((1, len(own.windows), 2))
    offset[..., 0] = 1e-3
    moved = own.run(theta[None])[0] - own.run(theta[None], offset)[0]
    np.testing.assert_allclose(moved[:, 0, 0], 1e-3, rtol=0.02)


@pytest.mark.slow
@pytest.mark.ci
def test_a_right_simulator_follows_mujoco_at_a_tenth_of_the_step(setup):
    """Errors left are second order in the step, after the start states are estimated."""
    fitter = setup.fitter
    fit = fitter.begin(())
    (fit,) = fitter.iterate([fit], 4, lambda f: ())
    errors = fitter.simulator.run(fitter.theta[None], fit.offsets[None])[0]
    late = 0.5 * fitter.simulator.physics.mj_model.opt.timestep  # s, what a naive reading of the step would leave
    speed = np.asarray(fitter.simulator.windows.batch.qvel)
    assert np.sqrt(np.mean(errors[..., 0] ** 2)) < 0.1 * late * np.sqrt(np.mean(speed**2))


def test_a_late_sensor_and_a_late_command_are_one(tmp_path):
    """Where all commands or all measurements are late by as much, positions are the same whatever the noise is.

    No row is read from the recording: what a sensor shows at a start is simulated from before it.
    """
    for sigma, delays, most in ((5e-3, (1.0, 3.0), 1e-6), (0.0, (2.5,), 3e-3)):  # between rows a start is interpolated
        logs = recorded(count=2, seconds=2.0, sigma=sigma)
        ready = prepare(nominal(tmp_path), logs, Request(["sensor_delay", "actuator_delay"]))
        own, space = ready.fitter.simulator, ready.physics.space
        sensor, command = (next(i for i, p in enumerate(space.names) if f".{at}_delay." in p) for at in SIGNALS)
        offset = 0.01 * np.random.default_rng(0).normal(size=(2, len(own.windows), 2))
        offset[1] = offset[0]
        for rows in delays:
            thetas = np.stack([space.nominal, space.nominal]).astype(float)
            thetas[0, sensor] = thetas[1, command] = rows * own.windows.dt
            late = own.run(thetas, offset)[:, 1:4, :, 0]  # before a log began no command is known
            assert np.abs(late[0] - late[1]).max() < most < 0.01 < np.abs(late).max()


def test_a_force_is_the_torque_of_a_motor(simulator):
    theta, cut = simulator.physics.space.nominal, simulator.windows
    force = np.full((1, len(cut), cut.steps, 1), 0.05)
    pushed = simulator.run(theta[None], force=force)
    past = cut.batch.around.replace(command=cut.batch.around.command + 0.05)
    batch = cut.batch.replace(command=cut.batch.command + 0.05, around=past)
    motor = Simulator(simulator.physics, dataclasses.replace(cut, batch=batch), lanes=32).run(theta[None])
    assert np.abs(pushed - motor).max() < 1e-5


def test_windows_one_after_the_other_are_one_long_window(tmp_path):
    """Each begins with the state, the drives' and the sensors' memory that the one before it ends with."""
    remembering = ["actuator_delay", "backlash", "coulomb_friction", "sensor_delay"]
    ready = prepare(nominal(tmp_path), recorded(count=2, seconds=2.0, sigma=1e-3), Request(remembering))
    own, physics = ready.fitter.simulator, ready.physics
    rng, first = np.random.default_rng(0), int(own.windows.start[0])
    thetas = np.array([rng.uniform(p.low, p.high, 3) for p in physics.space.parameters]).T
    offsets, of_log = 0.01 * rng.normal(size=(3, own.starts)), np.array([1, 0, 1])

    def cut(starts, length):
        given = own.windows.dt, physics.substeps, length
        return windows.cut(ready.logs, physics.mj_model, *given, limit=9, starts=starts, centred=False)

    steps = own.windows.steps
    chains = cut([(log, first + k * steps) for log in (0, 1) for k in range(3)], steps)
    own.run(thetas[:1])
    compiled = []
    monitoring.register_event_duration_secs_listener(lambda name, seconds, **about: compiled.append(name))
    chained = own.run_on(thetas, offsets, chains, np.arange(6).reshape(2, 3)[of_log])
    assert not [name for name in compiled if "compile" in name]
    long = Simulator(physics, cut([(0, first), (1, first)], 3 * steps), lanes=3)
    np.testing.assert_allclose(chained, long.run_each(thetas, np.arange(3), of_log, offsets), atol=1e-6)
    assert np.abs(chained).max() > 0.1


@pytest.mark.parametrize("size", [1e-3, 0.3])
def test_steps_in_the_tangent_space_are_undone(size):
    model = mujoco.MjModel.from_xml_string(FLOATING)
    rng = np.random.default_rng(1)
    qpos = rng.normal(size=model.nq)
    mujoco.mj_normalizeQuat(model, qpos)
    step = size * rng.uniform(-1, 1, model.nv)
    moved = tangent.integrate(model, jnp.asarray(qpos), jnp.asarray(step))
    back = tangent.difference(model, moved, jnp.asarray(qpos))
    np.testing.assert_allclose(back, step, atol=2e-6)
    np.testing.assert_allclose(tangent.difference(model, -moved, -jnp.asarray(qpos))[3:9], step[3:9], atol=2e-6)
    flipped = moved.at[3:7].multiply(-1.0).at[7:11].multiply(-1.0)  # the same rotations
    np.testing.assert_allclose(tangent.difference(model, flipped, jnp.asarray(qpos)), step, atol=2e-6)


def test_small_steps_are_those_of_mujoco():
    model = mujoco.MjModel.from_xml_string(FLOATING)
    rng = np.random.default_rng(2)
    qpos = rng.normal(size=model.nq)
    mujoco.mj_normalizeQuat(model, qpos)
    step = 0.02 * rng.uniform(-1, 1, model.nv)
    theirs, theirs_back = qpos.copy(), np.zeros(model.nv)
    mujoco.mj_integratePos(model, theirs, step, 1.0)
    np.testing.assert_allclose(tangent.integrate(model, jnp.asarray(qpos), jnp.asarray(step)), theirs, atol=2e-6)
    mujoco.mj_differentiatePos(model, theirs_back, 1.0, qpos, theirs)
    np.testing.assert_allclose(
        tangent.difference(model, jnp.asarray(theirs), jnp.asarray(qpos)), theirs_back, atol=2e-6
    )
