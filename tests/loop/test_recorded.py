"""Logs made by MuJoCo C with hidden numbers, and what the loop makes of them: replays, features, posteriors."""

import dataclasses
import json
import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_mjx import config, main, registry
from bayessim_mjx.effects import make
from bayessim_mjx.loop import sources
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics
from bayessim_mjx.rollout import recording, remembered, replay
from bayessim_mjx.runs import latest_run
from bayessim_mjx.tasks.pendulum import XML

STEP = 0.05  # s, the pendulum's control step and timestep
SIGMA = {"qpos:hinge": 1e-3, "qvel:hinge": 5e-3}  # of the encoder; it is told to the loop

CART = """
<mujoco><option gravity="0 0 0" timestep="0.01"/><worldbody><body>
  <joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/>
</body></worldbody><actuator><motor name="push" joint="x"/></actuator></mujoco>
"""


@pytest.mark.slow
@pytest.mark.ci
def test_a_replay_begins_in_the_truth_behind_what_was_measured_and_with_the_past_commands():
    """A mass of 1 kg at rest, control steps of two sub-steps of 10 ms; by hand."""
    effects = [make("joint_offset", where="x"), make("sensor_gain", where="x"), make("actuator_delay", where="push")]
    physics = Physics(mujoco.MjModel.from_xml_string(CART), 0.02, ParameterSpace(), effects)
    assert remembered(physics) == 15  # three times the longest delay, 0.1 s
    assert remembered(Physics(mujoco.MjModel.from_xml_string(CART), 0.02, ParameterSpace())) == 0
    theta = np.float32([[0.1, 1.0, 0.0], [0.0, 1.1, 0.0], [0.1, 1.1, 0.0], [0.0, 1.0, 0.03], [0.0, 1.0, 0.03]])
    start, rest, command = np.float32([[0.3], [1.0], [1.2], [0.0], [0.5]]), np.zeros((5, 1)), np.zeros((5, 2, 1))
    bare = replay(physics, start, rest, command, theta)
    np.testing.assert_allclose(bare["qpos"][..., 0], np.tile(start, (1, 3)), atol=1e-6)
    past = np.zeros((5, 31, 1))
    past[3:, :15] = 1.0  # 1 N until the start; what comes after it in the log is no past
    past[3:, 15:] = 7.0
    near = recording(physics, np.zeros((5, 31, 1)) + 0.4, np.zeros((5, 31, 1)), past)
    seen = replay(physics, start, rest, command, theta, near)
    np.testing.assert_allclose(seen["qpos"][:3, :, 0], np.tile(start[:3], (1, 3)), atol=1e-6)
    # 30 ms of 1 N are still on their way: 10 mm/s after each sub-step of them
    np.testing.assert_allclose(seen["qvel"][3:, :, 0], [[0.0, 0.02, 0.03]] * 2, atol=1e-6)
    np.testing.assert_allclose(seen["qpos"][3:, :, 0], start[3:] + [0.0, 3e-4, 9e-4], atol=1e-6)


@dataclasses.dataclass(frozen=True)
class Hidden:
    """What the logs are made with: rod of mass [kg] and length [m], zero of the encoder, delays, gains of the drive."""

    mass: float = 1.2
    length: float = 0.8
    offset: float = 0.0  # rad
    actuator_delay: float = 0.0  # s
    sensor_delay: int = 0  # control steps
    kp: float = 0.0  # N m/rad of a position loop on the shown angle; 0: commands are torques
    kd: float = 0.1  # N m s/rad


def pendulum_of(hidden: Hidden) -> mujoco.MjModel:
    """The task's rod with another mass and length, by hand: inertia m l^2 / 12 at l / 2."""
    m, half, own = hidden.mass, hidden.length / 2, hidden.mass * hidden.length**2 / 12
    xml = XML.replace(
        '<inertial mass="1" pos="0 0 0.5" diaginertia="0.08333333333 0.08333333333 1e-8"/>',
        f'<inertial mass="{m}" pos="0 0 {half}" diaginertia="{own} {own} 1e-8"/>',
    )
    assert xml != XML
    return mujoco.MjModel.from_xml_string(xml)


def write_logs(folder: Path, hidden: Hidden, sigma: dict[str, float] = SIGMA, count: int = 6, rows: int = 121) -> Path:
    """Runs of 6 s about the hanging position, by MuJoCo C, as CSV with metadata."""
    folder.mkdir()
    model, rng = pendulum_of(hidden), np.random.default_rng(7)
    time = STEP * np.arange(rows)
    for i in range(count):
        data = mujoco.MjData(model)
        data.qpos[0] = np.pi + rng.uniform(-1.2, 1.2)
        waves = [np.sin(w * time + p) for w, p in zip(rng.uniform(0.7, 3.2, 3), rng.uniform(0, 6, 3), strict=True)]
        steps = np.repeat(rng.uniform(-1, 1, rows // 4 + 1), 4)[:rows]
        command = 0.4 * sum(waves) + 0.8 * steps if not hidden.kp else np.pi + 0.3 * sum(waves) + 0.2 * steps
        shown = []
        for k in range(rows):
            shown.append((data.qpos[0] + hidden.offset, data.qvel[0]))
            if hidden.kp:
                angle = data.qpos[0] + hidden.offset
                ctrl = np.clip(hidden.kp * (command[k] - angle) - hidden.kd * data.qvel[0], -2, 2)
            else:  # mean over the step of the staircase that is late
                whole, part = divmod(hidden.actuator_delay / STEP, 1.0)
                late = command[np.maximum(k - int(whole) - np.array([0, 1]), 0)]
                ctrl = (1 - part) * late[0] + part * late[1]
            data.ctrl[0] = ctrl
            mujoco.mj_step(model, data)
        assert np.abs(np.array(shown)[:, 1]).max() < 8  # where the task clips speeds
        measured = np.array(shown)[np.maximum(np.arange(rows) - hidden.sensor_delay, 0)]
        measured = measured + rng.normal(size=measured.shape) * list(sigma.values())
        table = np.column_stack([time, command, measured])
        header = "time,ctrl:torque,qpos:hinge,qvel:hinge"
        np.savetxt(folder / f"run{i}.csv", table, delimiter=",", header=header, comments="")
        text = "sigma: {" + ", ".join(f'"{k}": {max(v, 1e-9)}' for k, v in sigma.items()) + "}\n"
        if hidden.kp:
            text += f"controller: {{law: position, kp: {hidden.kp}, kd: {hidden.kd}, limit: 2.0}}\n"
        (folder / f"run{i}.yaml").write_text(text)
    return folder


@pytest.mark.slow
def test_features_are_those_of_the_controller_that_the_log_declares(tmp_path: Path) -> None:
    """At the nominal parameters a log of targets is its own replay; read as torques it deviated by radians."""
    exact = dict.fromkeys(SIGMA, 0.0)
    folder = write_logs(tmp_path / "logs", Hidden(mass=1.0, length=1.0, kp=30.0), exact, count=2, rows=61)
    settings = config.load(
        "Pendulum",
        overrides=[f"real.logs={folder}", "bayessim.trainTrajLen=20", "bayessim.realTrajs=6", "bayessim.realIters=1"],
    )
    env = registry.make("Pendulum", config=settings)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*ctrlrange")  # a target in rad is no torque beyond 2 N m
        source = sources.make_source(settings, env)
    assert isinstance(source, sources.Recorded) and source.law is not None
    assert np.ptp(source.data["qpos"]) > 0.5
    np.testing.assert_allclose(source.data["expected_qpos"], source.data["qpos"], atol=2e-4)
    np.testing.assert_allclose(source.data["expected_qvel"], source.data["qvel"], atol=2e-3)
    # the replay that the posterior predictive shows is the same; of the second segment asked for, six times
    again = source.repeated(1, None, np.tile(np.float32(env.space.nominal), (6, 1)))  # type: ignore[arg-type]
    np.testing.assert_allclose(again["qpos"][5], source.data["qpos"][source.order[1]], atol=2e-4)


BUDGET = [
    "ppo.num_envs=4", "ppo.num_steps=4", "ppo.num_epochs=1", "ppo.num_minibatches=1", "ppo.hidden_actor=[4]",
    "ppo.hidden_critic=[4]", "ppo.eval_episodes=4", "--max_iterations=1", "bayessim.realEvals=4",
    "bayessim.realIters=1", "bayessim.realTrajs=6", "bayessim.trainTrajs=6000", "bayessim.trainTrajLen=20",
    "bayessim.hiddenLayers=[64,64]", "bayessim.ensemble=2", "bayessim.components=3", "bayessim.checkTrajs=100",
    "bayessim.refine=off", "monitor.posterior_plots=False", "monitor.video=False", "--headless", "--seed", "1",
    "task.randomization_params.actor_params.pendulum.rigid_body_properties.mass.range=[0.7,1.7]",
    "task.randomization_params.actor_params.pendulum.rigid_shape_properties.length.range=[0.6,1.2]",
]  # fmt: skip
CASES = {
    "offset and actuator delay": (
        Hidden(offset=0.06, actuator_delay=0.08),
        "[{effect: joint_offset, where: hinge}, {effect: actuator_delay, where: torque}]",
        {"hinge.joint_offset.offset": 0.06, "torque.actuator_delay.delay": 0.08},
    ),
    "sensor delay": (
        Hidden(sensor_delay=1),
        "[{effect: sensor_delay, where: hinge, high: 0.1}]",
        {"hinge.sensor_delay.delay": 0.05},
    ),
    "position controller": (
        Hidden(kp=6.0, offset=-0.05),
        "[{effect: joint_offset, where: hinge}]",
        {"hinge.joint_offset.offset": -0.05},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_main_gives_back_what_the_logs_were_made_with(case: str, tmp_path: Path, monkeypatch) -> None:
    """Segments begin in the middle of logs: `main real.logs=` finds mass, length and what is hidden, |z| < 2 each.

    With the posterior of all segments judged and widened as users have it: without, a delay's |z| was up to 2.5.
    """
    monkeypatch.chdir(tmp_path)
    hidden, effects, expected = CASES[case]
    folder = write_logs(tmp_path / "logs", hidden)
    assert main.main(["--task", "Pendulum", *BUDGET, f"effects={effects}", f"real.logs={folder}"]) == 0
    (row,) = (latest_run("logs", "Pendulum").path / "rounds.jsonl").read_text().splitlines()
    found = json.loads(row)["posterior"]
    truth = {"pendulum_mass_mult": hidden.mass, "pendulum_length_mult": hidden.length, **expected}
    assert found.keys() == truth.keys()
    for name, value in truth.items():
        assert abs(found[name]["mean"] - value) < 2 * found[name]["sd"], (name, found[name])
        assert found[name]["contraction"] > 0.9, (name, found[name])  # and is known from the logs
