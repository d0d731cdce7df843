"""Noise of single channels: by dense algebra, by the noise that was added, and where nothing tells it."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.kalman import innovations, measured_noise, riccati
from bayessim_mjx.loop import trajectories
from bayessim_mjx.loop.likelihood import Likelihood, repeated, silent
from bayessim_mjx.loop.state import LoopState
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.physics import Physics
from bayessim_mjx.physics.tangent import difference, noisy
from bayessim_mjx.rollout import replay
from bayessim_mjx.tracking import Record, close

ARM = """<mujoco><option timestep=".02" gravity="0 0 0"/><worldbody><body name="upper">
  <joint name="shoulder" type="hinge" axis="0 0 1" damping=".3"/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".03"
  mass="1"/><body name="lower" pos=".4 0 0"><joint name="elbow" type="hinge" axis="0 0 1" damping=".2"/>
  <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".7"/></body></body></worldbody>
  <actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator></mujoco>"""
SPACE = ParameterSpace(
    [
        Parameter(f"gain {k}", 1.0, 0.3, 3.0, operation="scaling", attribute="gain", target=f"#{k}", kind="actuator")
        for k in (0, 1)
    ]
)
FREE = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
)
COUNT, STEPS = 4, 50


@pytest.fixture(scope="module")
def physics():
    return Physics(mujoco.MjModel.from_xml_string(ARM), 0.04, SPACE)


def recorded(physics, sd, seed=0, theta=(1.3, 0.8)):
    """Trajectories with noise of these standard deviations [4] in q of shoulder and elbow, then their velocities."""
    rng = np.random.default_rng(seed)
    start = 0.3 * rng.uniform(-1, 1, (2, COUNT, 2))
    command = np.repeat(rng.uniform(-1, 1, (COUNT, STEPS // 5, 2)), 5, axis=1)
    motion = replay(physics, *start, command, np.tile(theta, (COUNT, 1)))
    noise = np.asarray(sd) * rng.normal(size=(COUNT, STEPS + 1, 4))
    rows = [np.asarray(motion["qpos"]) + noise[..., :2], np.asarray(motion["qvel"]) + noise[..., 2:]]
    return Record(*(jnp.asarray(x, jnp.float32) for x in (*rows, command)))


def settled(physics, record, told, theta=(1.3, 0.8)):
    found = Likelihood(physics, record, np.ones((COUNT, STEPS)), np.asarray(told, float))
    for _ in range(2):
        found.settle(np.asarray(theta))
    return found


def test_smoothed_noise_is_that_of_the_dense_covariance():
    """y = states + noise, all of it Gaussian: u = S^-1 y, D the diagonal of S^-1, with S the covariance of all y."""
    rng, steps, dt = np.random.default_rng(1), 5, 0.1
    ways = np.eye(2) + 0.3 * rng.normal(size=(1, steps, 2, 2))
    sensor, process, start = np.array([0.3, 0.7]), np.array([0.0, 0.2]), np.array([0.5, 0.4])
    gaps = rng.normal(size=(1, steps, 2))
    gains = riccati(ways, sensor, process, start)
    path = close(Record(jnp.zeros((1, steps + 1, 1)), jnp.zeros((1, steps + 1, 1)), jnp.zeros((1, steps, 1))), 1)
    path = jax.tree.map(jnp.zeros_like, path)  # a path that corrects nothing: its gaps are the measurements themselves
    white = innovations(ways, gaps, path, gains, dt)
    squares, spread = measured_noise(ways, gains, white, dt, np.ones((1, steps)))
    cov, state = np.zeros((2 * steps, 2 * steps)), np.diag(start**2)
    for t in range(steps):
        block = state = ways[0, t] @ state @ ways[0, t].T + np.diag(process**2)
        for later in range(t, steps):
            block = ways[0, later] @ block if later > t else block
            cov[2 * later : 2 * later + 2, 2 * t : 2 * t + 2] = block
            cov[2 * t : 2 * t + 2, 2 * later : 2 * later + 2] = block.T
    inverse = np.linalg.inv(cov + np.kron(np.eye(steps), np.diag(sensor**2)))
    u = (inverse @ gaps[0].ravel()).reshape(steps, 2)
    np.testing.assert_allclose(squares, (u**2).sum(0), rtol=1e-4)
    np.testing.assert_allclose(spread, np.diag(inverse).reshape(steps, 2).sum(0), rtol=1e-4)


def test_one_channel_with_more_noise_than_was_told_leaves_the_others_theirs(physics):
    """The elbow's encoder is 8 times as noisy as was told: one factor for all would be 4.1, for the shoulder too."""
    told, true = np.array([0.02, 0.02, 0.05, 0.05]), np.array([0.02, 0.16, 0.05, 0.05])
    found = settled(physics, recorded(physics, true), told)
    np.testing.assert_allclose(found.noise.sensor, true, rtol=0.15)  # sd of an sd of 200 rows: 5 %
    assert not found.noise.process.any()
    assert found.least == 1.0  # none of the others may become better than was told
    np.testing.assert_array_equal(
        found.shrunk.qpos, found.starts.shrunk(told).qpos
    )  # the noise of starts is the told one


def test_noise_as_it_was_told_stays_one_number(physics):
    told = np.array([0.02, 0.02, 0.05, 0.05])
    found = settled(physics, recorded(physics, told), told)
    ratio = found.noise.sensor / told
    np.testing.assert_allclose(ratio, ratio[0])
    assert 1.0 <= ratio[0] < 1.1


def test_a_joint_that_shows_one_value_has_no_say_unless_its_noise_is_told(physics):
    record = recorded(physics, (0.02, 0.0, 0.05, 0.0))
    held = record.replace(qpos=record.qpos.at[..., 1].set(0.3), qvel=record.qvel.at[..., 1].set(0.0))
    told = np.array([0.02, 0.0, 0.05, 0.0])
    found = Likelihood(physics, held, np.ones((COUNT, STEPS)), told)
    assert found.silent.tolist() == [False, True, False, True] and found.seen.tolist() == [True, False, True, False]
    assert found.scale.min() > 1e-4  # states that are not seen are varied by numbers that float32 can tell apart
    known = Likelihood(physics, held, np.ones((COUNT, STEPS)), np.array([0.02, 0.001, 0.05, 0.01]))
    assert known.seen.all() and known.stated[1] == pytest.approx(0.001)


def test_a_sensor_without_noise_that_moves_keeps_its_say(physics):
    record = recorded(physics, np.zeros(4))
    assert not silent(record, physics.mj_model, np.zeros(4)).any()


def test_rows_of_one_count_tell_as_much_as_four_and_noise_tells_in_every_row(physics):
    told = np.array([0.01, 0.01, 0.02, np.inf])
    record, valid = recorded(physics, (0.01, 0.01, 0.02, 0.02)), np.ones((COUNT, STEPS))
    np.testing.assert_array_equal(repeated(record, physics.mj_model, told, valid), np.ones(4))
    count = np.arange(STEPS + 1) // 17 * 0.1  # three counts of 17 rows; between some, resampling leaves a trace
    count = count + 0.0005 * (np.arange(STEPS + 1) % 2)
    held = record.replace(qpos=jnp.asarray(record.qpos).at[:, :, 0].set(jnp.asarray(count, jnp.float32)))
    found = repeated(held, physics.mj_model, told, valid)
    np.testing.assert_allclose(found, [np.sqrt(17 / 4), 1, 1, 1], rtol=1e-6)
    ended = np.where(np.arange(STEPS) < 3, 1.0, 0.0) * valid  # what follows an episode's end repeats, and says nothing
    np.testing.assert_array_equal(repeated(held, physics.mj_model, told, ended), np.ones(4))
    floors = [Likelihood(physics, r, valid, told).floor[0] for r in (record, held)]
    assert floors[1] / floors[0] == pytest.approx(np.sqrt(17 / 4), rel=1e-6)


def test_a_surrogates_orientations_are_as_noisy_as_is_said_and_of_norm_one():
    """Tangent sd .01 in all six, norms 1: noise on all four components made twice of it, and norms of .97 to 1.03."""
    rng, rows, sd = np.random.default_rng(0), 400, 0.01
    quats = rng.normal(size=(1, rows, 4))
    qpos = jnp.asarray(
        np.concatenate([rng.normal(size=(1, rows, 3)), quats / np.linalg.norm(quats, axis=-1, keepdims=True)], -1),
        jnp.float32,
    )
    state = types.SimpleNamespace
    blank = trajectories.no_motion(
        loop := state(
            source=state(noise=sd), settings=state(trainTrajLen=rows - 1, realTrajs=1),
            env=state(physics=state(mj_model=FREE)), key=lambda *_: jax.random.key(3),
        ), 1,
    )  # fmt: skip
    real = state(
        qpos=qpos, qvel=jnp.zeros((1, rows, 6)), command=jnp.zeros((1, rows - 1, 0)), valid=jnp.ones((1, rows - 1))
    )
    empty = dict.fromkeys(f.name for f in dataclasses.fields(LoopState))
    kept = trajectories.stored(loop, LoopState(**empty | {"round": 0, "motion": blank}), real).motion
    np.testing.assert_allclose(np.linalg.norm(kept["qpos"][0, :, 3:], axis=-1), 1.0, atol=1e-5)
    away = np.asarray(jax.vmap(lambda a, b: difference(FREE, a, b))(kept["qpos"][0], qpos[0]))
    np.testing.assert_allclose(away.std(0), sd, rtol=0.12)  # sd of an sd of 400: 3.5 %


def test_noise_of_hinges_is_the_draws_that_it_always_was(physics):
    """Runs without quaternions go on with the same bits."""
    key, qpos = jax.random.key(5), jnp.arange(12.0).reshape(2, 3, 2)
    expected = qpos + 0.1 * jax.random.normal(key, qpos.shape)
    np.testing.assert_array_equal(noisy(physics.mj_model, key, qpos, 0.1), expected)
