"""Windows of recorded logs as real trajectories: what is counted, what is believed, and what the user is told."""

import types
import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import Channels, Log, noise, write_log
from bayessim_mjx.loop import likelihood_refinement
from bayessim_mjx.loop.recorded import apart, recorded
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.physics import Physics
from bayessim_mjx.rollout import replay

CART = """<mujoco><option timestep=".02" gravity="0 0 0"/><worldbody><body name="cart">
  <joint name="x" type="slide" axis="1 0 0" damping="1" stiffness="4"/><geom size=".1" mass="2"/></body></worldbody>
  <actuator><general name="a" joint="x" gainprm="10" ctrlrange="-1 1"/>
  <general name="b" joint="x" gainprm="5" ctrlrange="-1 1"/></actuator></mujoco>"""
SD, ROWS, LENGTH, DT = 0.1, 240, 60, 0.04
MODEL = mujoco.MjModel.from_xml_string(CART)
SPACE = ParameterSpace(
    [
        Parameter(f"gain {m}", 1.0, 0.2, 3.0, operation="scaling", attribute="gain", target=m, kind="actuator")
        for m in "ab"
    ]
)


@pytest.fixture(scope="module")
def env():
    physics = Physics(MODEL, DT, SPACE)
    return types.SimpleNamespace(physics=physics, mj_model=MODEL, space=SPACE, dt=DT, name="cart")


def log_of(env, seed, sd=SD, late=0):
    """(one recording of ROWS control steps of the linear system, its theta)."""
    rng = np.random.default_rng([5, seed])
    theta = np.asarray(SPACE.from_unit(jnp.asarray(rng.uniform(size=2), jnp.float32)))
    command = np.repeat(rng.uniform(-1, 1, (1, ROWS // 5, 2)), 5, axis=1)
    motion = replay(env.physics, *rng.uniform(-1, 1, (2, 1, 1)), command, theta[None])
    qpos, qvel = (np.asarray(motion[k][0], float) for k in ("qpos", "qvel"))
    qvel = np.concatenate([np.repeat(qvel[:1], late, axis=0), qvel[: len(qvel) - late]])
    qpos, qvel = qpos + sd * rng.normal(size=qpos.shape), qvel + sd * rng.normal(size=qvel.shape)
    time, ctrl = DT * np.arange(ROWS + 1), np.concatenate([command[0], command[0, -1:]])
    told = np.full(1, max(sd, 1e-6))
    return Log(f"run{seed}", time, ctrl, qpos, qvel, True, Channels.of(MODEL), told, told), theta


def source_of(env, tmp_path, logs, stride=None, trajectories=1):
    paths = []
    for log in logs:
        path = tmp_path / f"{log.name}.npz"
        write_log(path, log)
        path.with_suffix(".yaml").write_text(
            f'sigma: {{"qpos:x": {log.sigma_qpos[0]}, "qvel:x": {log.sigma_qvel[0]}}}\n'
        )
        paths.append(str(path))
    settings = types.SimpleNamespace(trainTrajLen=LENGTH, realTrajs=trajectories, collectPolicy="policy_replay")
    real = types.SimpleNamespace(logs=tuple(paths), map=None, segment_length=None, segment_stride=stride)
    config = types.SimpleNamespace(real=real, bayessim=settings, seed=0)
    source = recorded(config, env, lambda states, command: jnp.concatenate([states.mean(0), command.mean(0)]))
    return source, types.SimpleNamespace(env=env, source=source, settings=settings)


@pytest.mark.parametrize(("length", "stride"), [(60, 15), (60, 60), (50, 30), (7, 3), (10, 40)])
def test_real_trajectories_share_no_row_of_motion(length, stride):
    run = np.repeat([0, 1], [20, 13])
    start = stride * np.concatenate([np.arange(20), np.arange(13)])
    mixed = np.random.default_rng(0).permutation(len(run))
    kept = apart(run[mixed], start[mixed], length)
    for r in (0, 1):
        own = np.sort(start[mixed][kept & (run[mixed] == r)])
        assert own[0] == 0 and np.diff(own).min() >= length
        assert np.diff(own).max() < length + stride  # no room is wasted


def test_overlapping_segments_are_simulated_and_count_once(env, tmp_path):
    """A stride of a quarter of the length made the posterior half as wide: the same rows in four trajectories."""
    log, theta = log_of(env, 0)
    with pytest.warns(UserWarning, match="segment_stride=15 of 60 steps.*13 are simulated, the 4 that share no time"):
        dense, loop = source_of(env, tmp_path, [log], stride=15)
    plain, other = source_of(env, tmp_path, [log])
    assert len(dense.pool) == 13 and dense.supply == plain.supply == 4
    each = []
    for parts in (loop, other):
        likelihood = likelihood_refinement._likelihood(parts, types.SimpleNamespace(motion=None), 4)
        assert likelihood.count == 2 * ROWS  # every measured row once
        likelihood.settle(theta)
        each.append(np.sqrt(np.diag(likelihood.laplace[1])))
    np.testing.assert_allclose(*each, rtol=0.02)
    with (
        pytest.raises(UserError, match="4 segments of 60 steps.*share no time.*realTrajs=5"),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        source_of(env, tmp_path, [log], stride=15, trajectories=5)


@pytest.mark.slow
def test_posteriors_of_overlapping_segments_are_as_sure_as_they_may_be(env, tmp_path):
    """12 truths, two numbers each: z is 1 +- .14 on the mean; with the rows counted four times it was 1.7."""
    z = []
    for seed in range(12):
        log, theta = log_of(env, seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _, loop = source_of(env, tmp_path, [log], stride=15)
        likelihood = likelihood_refinement._likelihood(loop, types.SimpleNamespace(motion=None), 4)
        likelihood.settle(theta)
        mean, cov = likelihood.laplace
        z.append((mean - likelihood._z(theta)) / np.sqrt(np.diag(cov)))
    assert 0.65 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_a_late_velocity_is_no_measurement_of_the_loop(env, tmp_path):
    """A control step late: left out of the likelihood and of the features, and the user is told."""
    logs = [log_of(env, k, sd=0.005, late=1)[0] for k in range(2)]
    with pytest.warns(UserWarning, match=r"real.logs: qvel:x is .* \+(4|5)\d ms late.*positions are used instead"):
        source, loop = source_of(env, tmp_path, logs)
    likelihood = likelihood_refinement._likelihood(loop, types.SimpleNamespace(motion=None), 4)
    assert likelihood.seen.tolist() == [True, False]
    assert not any(name == "deviation of x speed" for name in source.channels.states)
    index = source.order[:2]
    qpos, qvel = (jnp.asarray(source.data[k])[index] for k in ("qpos", "qvel"))
    assert source.features(index, qpos, qvel).shape == (2, 1 + 2 + 2)  # mean deviation, commands, first state
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        on_time, _ = source_of(env, tmp_path, [replace(log_of(env, 7, sd=0.005)[0], name="good")])
    assert on_time.fast.all()


def test_noise_is_pooled_over_the_logs_that_show_it(env):
    """One log of three shows two counts: the rms over all would be 1 / sqrt(3) of its noise."""
    log = log_of(env, 0)[0]
    still = replace(log, sigma_qpos=np.zeros(1))
    assert noise([log, still, still])["qpos"] == pytest.approx(SD)
    assert noise([still, still])["qpos"] == 0.0


def test_measured_features_move_with_the_noise_alone(env, tmp_path):
    """Draws of simulated features: the first is that of `simulate`, and positions are as noisy as is told."""
    source, _ = source_of(env, tmp_path, [log_of(env, 1)[0]])
    thetas = jnp.ones((2, 2))
    found = source.measured(jax.random.key(0), thetas, None, 3)
    assert found.shape == (2, 3, 2 + 2 + 2) and float(jnp.abs(found[:, 1] - found[:, 2]).max()) > 0
