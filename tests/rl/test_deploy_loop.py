"""examples/deploy_loop.py: an exported policy on MuJoCo C, its log as the library reads it, and what stops it."""

import copy
import importlib.util
import sys
import time
import types
from pathlib import Path

import jax
import numpy as np
import pytest

from bayessim_mjx import policy_check, registry
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.logs import read_logs
from bayessim_mjx.rl import export, networks, normalise
from bayessim_mjx.rl.networks import Policy

pytest.importorskip("onnxruntime")
FILE = Path(__file__).parents[2] / "examples" / "deploy_loop.py"
ENV = registry.make("Pendulum")
FRICTION = 0.15  # N m


@pytest.fixture(scope="module")
def deploy() -> types.ModuleType:
    spec = importlib.util.spec_from_file_location("deploy_loop", FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["deploy_loop"] = module  # dataclasses look there
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def policy() -> Policy:
    config = PPOConfig(hidden_actor=(8,), hidden_critic=(8,))
    actor = networks.init(jax.random.PRNGKey(0), networks.Sizes(3, 3, 1), config)["actor"]
    actor["layers"][-1]["w"] *= 50
    return Policy(actor, normalise.init(3))


@pytest.fixture(scope="module")
def file(policy: Policy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("exported") / "policy.onnx"
    export.write(path, policy, ENV, {"checkpoint": "7"})
    return path


def run(deploy, monkeypatch, *argv) -> int:
    monkeypatch.setattr(sys, "argv", ["deploy_loop.py", *map(str, argv)])
    return deploy.main()


def test_a_second_of_it_is_a_log_with_the_policys_commands(deploy, policy, file, tmp_path, monkeypatch, capsys):
    assert (
        run(deploy, monkeypatch, "--policy", file, "--seconds", 1, "--out", tmp_path, "--fast", "--watchdog", 99) == 0
    )
    assert "20 steps of 50 ms; latency" in capsys.readouterr().out
    (log,) = read_logs(tmp_path, ENV.mj_model)
    np.testing.assert_allclose(log.time, 0.05 * np.arange(20), atol=1e-9)
    seen = np.concatenate([np.cos(log.qpos), np.sin(log.qpos), log.qvel], 1)
    expected = 2.0 * np.clip(policy.act(None, seen), -1, 1)
    np.testing.assert_allclose(log.ctrl, expected, atol=2e-4)
    assert np.std(log.ctrl) > 0.01 and log.metadata["checkpoint"] == 7 and log.metadata["note"] == "ran to its end"


def test_a_task_of_another_package_needs_the_robots_model(deploy, policy, tmp_path, monkeypatch):
    export.write(tmp_path / "own.onnx", policy, ENV, {"task": "Unheard"})
    with pytest.raises(SystemExit, match="Unheard.*give --model FILE"):
        run(deploy, monkeypatch, "--policy", tmp_path / "own.onnx", "--seconds", 0.1, "--out", tmp_path)


def test_a_step_takes_its_time(deploy, file, tmp_path, monkeypatch):
    """On the clock half a second lasts half a second."""
    begun = time.perf_counter()
    assert run(deploy, monkeypatch, "--policy", file, "--seconds", 0.5, "--out", tmp_path, "--watchdog", 99) == 0
    assert time.perf_counter() - begun > 0.5


def test_its_log_shows_that_the_policy_is_deployed_as_exported(deploy, file, tmp_path, monkeypatch, capsys):
    options = ("--seconds", 5, "--spread", 3, "--out", tmp_path, "--fast", "--watchdog", 999, "--max_speed", 99)
    assert run(deploy, monkeypatch, "--policy", file, *options) == 0
    monkeypatch.setattr(deploy, "GOALS", {"speed": 0.5})  # a goal that this policy has no use for
    assert run(deploy, monkeypatch, "--policy", file, *options, "--seed", 1) == 0
    assert ",task:speed," in (tmp_path / "run_1.csv").read_text().splitlines()[0]
    capsys.readouterr()
    assert policy_check.main(["check", str(file), "--logs", str(tmp_path)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "right: observation, 3 entries" in out and "right: action, 1 entry" in out
    assert out.endswith("the deployed policy is as its file says")


def test_a_late_step_is_late_in_the_log_and_for_the_robot(deploy):
    """A block that slides at 1 m/s is where the clock says, although a step takes three times as long."""
    import mujoco

    xml = """<mujoco><option timestep="0.001"/><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/>
      <geom size=".1"/></body></worldbody><actuator><motor name="push" joint="rail"/></actuator></mujoco>"""
    robot = deploy.Robot(mujoco.MjModel.from_xml_string(xml), ["rail"], ["push"], 0, spread=0.0)
    robot.data.qvel[:] = 1.0

    class Slow:
        dt, calls = 0.02, 0

        def __call__(self, q, w):
            self.calls += 1
            time.sleep(0.06 if self.calls == 3 else 0.0)
            return np.zeros(1), np.zeros(1), np.zeros(1)

    rows, _, reason = deploy.loop(Slow(), robot, deploy.Safety({}, 9.0, 9.0, 99), 0.2)
    clock, place = np.array(rows)[:, [0, 4]].T
    assert not reason and len(rows) == 10
    assert np.diff(clock)[2] > 0.058 and place == pytest.approx(clock, abs=0.51e-3)  # half a timestep


def test_it_stops_where_a_limit_is_passed(deploy, file, tmp_path, monkeypatch, capsys):
    options = ("--policy", file, "--fast", "--out", tmp_path, "--watchdog", 99, "--max_speed", 2)
    assert run(deploy, monkeypatch, *options) == 1
    assert "stopped: hinge moves at" in capsys.readouterr().out
    (log,) = read_logs(tmp_path, ENV.mj_model)
    assert abs(log.qvel[-1, 0]) > 2 >= np.abs(log.qvel[:-1]).max() and log.ctrl[-1, 0] == 0


def test_safety_by_hand(deploy):
    safety = deploy.Safety({"a": (-1.0, 1.0)}, 5.0, 2.0, 2)
    fine = {"a": 0.5, "b": 9.0}, {"a": 5.0, "b": -5.0}, np.array([2.0])
    assert safety.state(*fine) is None
    assert "a is at 1.5, allowed is -1 to 1" in safety.state({"a": 1.5, "b": 0.0}, *fine[1:])
    assert "b moves at -6" in safety.state(fine[0], {"a": 0.0, "b": -6.0}, fine[2])
    assert "a moves at nan" in safety.state(fine[0], {"a": np.nan, "b": 0.0}, fine[2])
    assert "an effort of 3" in safety.state(*fine[:2], np.array([-3.0]))
    assert [safety.clock(late, 0.01) is None for late in (0.1, -1.0, 0.1, 0.1)] == [True, True, True, False]


def test_robots_may_order_their_joints_otherwise(deploy):
    import mujoco

    body = "<body><joint name='{}' type='slide'/><geom size='.1'/></body>"
    motors = "".join(f"<motor name='{n}' joint='{n}'/>" for n in "ba")
    xml = f"<mujoco><worldbody>{body.format('b')}{body.format('a')}</worldbody><actuator>{motors}</actuator></mujoco>"
    robot = deploy.Robot(mujoco.MjModel.from_xml_string(xml), ["a", "b"], ["a", "b"], 0)
    robot.write(np.array([3.0, 7.0]))
    assert robot.data.ctrl.tolist() == [7.0, 3.0]
    robot.data.qpos[:] = [0.2, 0.1]
    assert robot.read()[0] == {"a": 0.1, "b": 0.2}


@pytest.mark.slow
def test_what_a_sticking_robot_lacks_is_found_from_the_loops_logs(deploy, tmp_path, monkeypatch):
    """The loop closes: a policy that comes with the package, on a robot with friction that its simulator has not."""
    import bayessim_mjx as bm

    export.write(tmp_path / "policy.onnx", bm.pretrained("Pendulum"), ENV, {})
    robot = copy.deepcopy(ENV.mj_model)
    robot.dof_frictionloss[:] = FRICTION
    robot.opt.disableflags = 0  # the simulator has no constraints, and so no friction
    robot.opt.timestep /= 10
    monkeypatch.setattr(deploy, "_model", lambda *_: robot)
    for seed in range(5):
        options = ("--seed", seed, "--spread", 3, "--noise", 0.001, "--seconds", 6, "--fast", "--watchdog", 999)
        assert run(deploy, monkeypatch, "--policy", tmp_path / "policy.onnx", *options, "--out", tmp_path / "logs") == 0
    found = bm.diagnose("Pendulum", str(tmp_path / "logs"), effects=["coulomb_friction", "viscous_friction"])
    assert "coulomb_friction" in [effect.name for effect in found.effects]
    [level] = [e.parameters["level"] for e in found.effects if e.name == "coulomb_friction"]
    assert abs(level.mean - FRICTION) < 0.1 * FRICTION + 3 * level.sd
