"""ServoPendulum: statics and symmetries of the rig, MuJoCo C as reference, and replay of its own and of real logs."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx import config, registry
from bayessim_mjx.logs import read_logs, segments
from bayessim_mjx.rollout import replay

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
RAW = EXAMPLES.parents[1] / "shared" / "data" / "xl330_servo" / "raw"
STEPS = 40


@pytest.fixture(scope="module")
def env():
    return registry.make("ServoPendulum")


def simulate(model: mujoco.MjModel, commands: np.ndarray, q0: float = 0.0) -> np.ndarray:
    """[T, 4]: time, command, angle, speed of MuJoCo C, one row per control step of 5 ms (two timesteps)."""
    data = mujoco.MjData(model)
    data.qpos[0] = q0
    rows = []
    for u in commands:
        rows.append([data.time, u, data.qpos[0], data.qvel[0]])
        data.ctrl[0] = u
        mujoco.mj_step(model, data, 2)
    return np.array(rows)


def angles(env, theta, command, q0=0.3):
    """[N, T+1] replayed from rest at q0."""
    n = len(theta)
    motion = replay(
        env.physics, np.full((n, 1), q0), np.zeros((n, 1)), np.tile(command[None, :, None], (n, 1, 1)), theta
    )
    return np.asarray(motion["qpos"])[..., 0]


def test_the_settings_file_and_the_task_agree(env) -> None:
    settings = config.load("ServoPendulum")
    assert registry.make("ServoPendulum", config=settings).space == env.space
    assert env.space.names == ("load_mass", "servo_damping", "servo_friction", "servo_armature", "motor_gain")
    assert bool(env.space.contains(jnp.asarray(type(env).real_parameters)))
    assert settings.env.realParams["means"][0] == type(env).real_parameters


def test_replay_equals_mujoco_and_only_ratios_matter(env) -> None:
    command = 4.0 * np.sin(0.2 * np.arange(STEPS)).astype(np.float32)
    theta = env.space.nominal
    moved = angles(env, np.stack([theta, 1.15 * theta, theta * [1, 1, 1.5, 1, 1]]), command)
    truth = simulate(env.mj_model, np.append(command, 0.0), q0=0.3)[:, 2]
    np.testing.assert_allclose(moved[0], truth, atol=2e-5)
    # (mass, damping, friction, armature, gain) times one number: the same motion; one of them alone: not
    np.testing.assert_allclose(moved[1], moved[0], atol=1e-4)
    assert np.abs(moved[2] - moved[0]).max() > 0.005


def test_gravity_stops_the_arm_where_the_motor_holds_it(env) -> None:
    volts, mass, length = 3.0, 0.49, 0.1
    rest = simulate(env.mj_model, np.full(800, volts))[-1]
    load = mass * 9.81 * length * np.sin(rest[2])
    friction = env.mj_model.dof_frictionloss[0]
    assert abs(env.mj_model.actuator_gainprm[0, 0] * volts - load) <= friction * 1.02 and abs(rest[3]) < 1e-3
    hanging = simulate(env.mj_model, np.zeros(400), q0=0.09)[-1]  # friction 0.05 N m holds 0.104 rad
    assert hanging[2] == pytest.approx(0.09, abs=0.005)


def test_reward_is_one_at_rest_on_target(env) -> None:
    world = jax.jit(env.reset)(jax.random.PRNGKey(0)).pipeline_state
    world = world.replace(qpos=jnp.array([0.2]), qvel=jnp.zeros(1))
    on_target = world.replace(task=world.task | {"target": jnp.float32(0.2)})
    reward, terminated, metrics = env.reward(world, on_target, None, jnp.zeros(1))
    assert float(reward) == pytest.approx(1.0) and not bool(terminated) and float(metrics["error"]) < 1e-6
    off = world.replace(task=world.task | {"target": jnp.float32(0.2 - np.pi)})
    assert float(env.reward(world, off, None, jnp.zeros(1))[0]) == pytest.approx(0.0, abs=1e-6)
    assert env.command(jnp.ones(1)) == pytest.approx(7.4)
    targets = [float(env.start(jax.random.PRNGKey(k), world)["target"]) for k in range(3)]
    assert len(set(targets)) == 3 and max(map(abs, targets)) <= 1.2


@pytest.mark.slow
@pytest.mark.ci
def test_a_simulated_log_replays_in_mjx(env, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    commands = np.repeat(rng.uniform(-6, 6, 33), 10)[: 8 * STEPS + 1]
    table = simulate(env.mj_model, commands)
    header = "time,ctrl:motor,qpos:servo"
    np.savetxt(tmp_path / "full.csv", table, "%.9g", ",", header=header + ",qvel:servo", comments="")
    data = segments(read_logs(tmp_path, env.mj_model), STEPS, dt=env.dt)
    assert data["qpos"].shape == (8, STEPS + 1, 1)
    thetas = np.tile(env.space.nominal, (8, 1))
    motion = replay(env.physics, data["qpos0"], data["qvel0"], data["command"], thetas)
    np.testing.assert_allclose(motion["qpos"], data["qpos"], atol=1e-4)
    # an encoder of 4096 steps and no velocity: the estimate still starts the replay within a few mrad
    (tmp_path / "full.csv").unlink()
    counts = 2 * np.pi / 4096
    table[:, 2] = np.round(table[:, 2] / counts) * counts
    np.savetxt(tmp_path / "coarse.csv", table[:, :3], "%.9g", ",", header=header, comments="")
    (log,) = read_logs(tmp_path, env.mj_model)
    coarse = segments(log, STEPS, dt=env.dt)
    motion = replay(env.physics, coarse["qpos0"], coarse["qvel0"], coarse["command"], thetas)
    rms = float(np.sqrt(np.mean((np.asarray(motion["qpos"]) - data["qpos"]) ** 2)))
    assert log.sigma_qpos[0] == pytest.approx(counts / np.sqrt(12), rel=0.5)
    assert rms < 0.015, rms


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.skipif(not RAW.is_dir(), reason="the XL330 logs are not in ../shared/data")
def test_the_real_logs_convert_and_replay(env, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    sys.modules.pop("convert_xl330", None)
    from convert_xl330 import convert

    assert len(convert(tmp_path)) == 16
    logs = read_logs(tmp_path, env.mj_model)
    assert len(logs) == 16 and {log.metadata["operating_condition"] for log in logs} == {
        "kp100",
        "kp200",
        "kp400",
        "kp800",
    }
    assert all(np.abs(log.ctrl).max() <= 7.4 for log in logs)  # the register was signed
    dropped = [log for log in logs if not log.enabled.all()]
    assert len(dropped) == 4 and all(log.time[~log.enabled][0] == pytest.approx(2.0, abs=0.01) for log in dropped)
    assert min(log.sigma_qpos[0] for log in logs) == pytest.approx(2 * np.pi / 4096 / np.sqrt(12), rel=0.01)
    data = segments(logs, STEPS, dt=env.dt)
    off = [i for i, log in enumerate(logs) if not log.enabled.all()]
    assert (data["start"][np.isin(data["run"], off)] + STEPS).max() * env.dt <= 2.0
    pick = slice(None, None, 48)
    data = {k: v[pick] for k, v in data.items()}
    refit = np.float32([0.49, 0.0127, 0.108, 0.0019, 0.0704])  # least squares on these logs, base model
    rms = {}
    for name, theta in (("nominal", env.space.nominal), ("refit", refit)):
        thetas = np.tile(theta, (len(data["qpos"]), 1))
        motion = replay(env.physics, data["qpos0"], data["qvel0"], data["command"], thetas)
        rms[name] = float(np.sqrt(np.mean((np.asarray(motion["qpos"]) - data["qpos"]) ** 2)))
    assert rms["refit"] < 0.07 and rms["refit"] < 0.6 * rms["nominal"], rms
