"""The example of a robot of one's own: its mirror and its physics at once, its loop in small."""

import importlib.util
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

FILE = Path(__file__).resolve().parents[2] / "examples" / "own_task.py"
SHORT = [
    "env.numEnvs=16",
    "ppo.max_iterations=4",
    "ppo.log_interval=2",
    "bayessim.trainTrajs=300",
    "bayessim.realIters=1",
    "bayessim.checkTrajs=0",
]


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("own_task_example", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_balancer_rolls_and_falls_as_it_should(example):
    """Equal torques roll it straight on, opposite ones turn it on the spot; upright is no rest."""
    env = example.Balancer()
    assert set(example.REALITY) == set(env.space.names) and env.action_size == 2
    assert env.mirrors[0].action[0].tolist() == [1, 0] and env.mirrors[0].task == ("command_yaw",)

    def after(left, right, seconds):
        data = mujoco.MjData(env.mj_model)
        data.ctrl[:] = left, right
        mujoco.mj_step(env.mj_model, data, round(seconds / env.mj_model.opt.timestep))
        return data

    straight, turned = after(0.3, 0.3, 0.2), after(-0.3, 0.3, 0.5)
    assert straight.qvel[0] > 0.1 and abs(straight.qvel[5]) < 1e-6 and abs(straight.qpos[1]) < 1e-6
    assert turned.qvel[5] > 1.0 and np.abs(turned.qpos[:2]).max() < 0.01
    assert after(0.01, 0.01, 3.0).xmat[1, 8] < 0.7  # cosine of the trunk's tilt


@pytest.mark.slow
@pytest.mark.ci
def test_the_example_runs(example, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(FILE), *SHORT])
    example.main()
    said = capsys.readouterr().out
    assert "round 1: trained 4, return" in said and "return on the real robot" in said
    for name, truth in example.REALITY.items():
        assert f"{name}: posterior " in said and f"hidden truth {truth}" in said
