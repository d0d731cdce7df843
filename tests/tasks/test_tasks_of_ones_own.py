"""A task named by its file, `path/slider.py:Slider`, or by the entry point of an installed package."""

import json
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from bayessim_mjx import cli, main, registry, runs, trust
from bayessim_mjx.config import load
from bayessim_mjx.errors import UserError
from bayessim_mjx.monitor.opening import opening

SLIDER = '''
import jax.numpy as jnp
import mujoco
from bayessim_mjx.env import Task

XML = """<mujoco model="slider"><option timestep="0.01"/><worldbody><body name="block">
<joint name="rail" type="slide" axis="1 0 0"/><geom size="0.1" mass="2"/></body></worldbody>
<actuator><motor name="push" joint="rail" ctrlrange="-5 5"/></actuator></mujoco>"""


class Slider(Task):
    control_dt = 0.02
    default_episode_length = 50
    observation_names = ("position", "velocity")
    randomization = {"randomization_params": {"actor_params": {"slider": {"rigid_body_properties": {
        "mass": {"range": [0.5, 2.0], "operation": "scaling", "distribution": "uniform"}}}}}}

    def spec(self):
        return mujoco.MjSpec.from_string(XML)

    def initial(self, key):
        return jnp.zeros(1), jnp.zeros(1)

    def command(self, action):
        return 5.0 * action

    def observe(self, world, data, action):
        return {"policy": jnp.concatenate([world.measurement["qpos"], world.measurement["qvel"]])}

    def reward(self, before, after, data, action):
        return -jnp.abs(after.qpos[0]), jnp.zeros((), bool), {}
'''


@pytest.fixture(autouse=True)
def nothing_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(trust, "_named", set())
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def slider(tmp_path: Path) -> str:
    (tmp_path / "slider.py").write_text(SLIDER)
    return "slider.py:Slider"


def config_of(*argv: str) -> Any:
    return cli.config_of(cli.Parser("train", "").parse([*argv]))


def test_a_task_of_a_file_moves_as_newton_says(slider: str) -> None:
    env = registry.make(slider)
    assert env.name == "Slider" and env.space.names == ("block_mass_mult",)
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    state = jax.jit(env.step)(state, np.float32([1.0]))
    assert state.obs["policy"][1] == pytest.approx(5.0 / 2.0 * 0.02, rel=1e-5)  # F / m dt


def test_the_flag_names_it_with_the_settings_beside_it(slider: str, tmp_path: Path) -> None:
    (tmp_path / "slider.yaml").write_text("env: {numEnvs: 8}\nppo: {gamma: 0.9}\n")
    config = config_of("--task", slider, "ppo.gamma=0.8")
    assert config.task == f"{tmp_path / 'slider.py'}:Slider"
    assert (config.env.numEnvs, config.ppo.num_envs, config.ppo.gamma) == (8, 8, 0.8)
    env = registry.make(config.task, config=config)
    assert env.name == "Slider" and opening(config, env, jax.devices()[0])["task"].startswith(config.task)


def test_a_surrogate_without_sensor_noise_is_announced(slider: str) -> None:
    def noted(*overrides: str, **more: Any) -> bool:
        config = config_of("--task", slider, *overrides)
        return "noise" in opening(config, registry.make(slider, config=config), jax.devices()[0], **more)

    assert noted() and noted("real.noise=0")
    assert not noted("real.noise=0.01") and not noted("real.logs=logs") and not noted("bayessim.modelClass=None")
    assert not noted(infers=False)
    own = {"observations": {"range": [0, 0.01], "operation": "additive", "distribution": "gaussian"}}
    mass = {"slider": {"rigid_body_properties": {"mass": {"range": [0.5, 2.0], "operation": "scaling"}}}}
    for params, known in (({}, True), (own, False)):
        section = {"randomization_params": {"actor_params": mass, **params}}
        Path("slider.yaml").write_text(json.dumps({"task": section}))
        assert noted() is known


def test_the_hint_to_resume_allows_the_file_and_the_same_task_may_be_named(slider: str, monkeypatch: Any) -> None:
    monkeypatch.setattr(trust, "_named", set())
    config, heard = config_of("--task", slider), []
    run = runs.Run.create("logs", config.task, "", config, [])
    with pytest.raises(KeyboardInterrupt), cli.running(run, heard.append):
        raise KeyboardInterrupt
    file = Path("slider.py").resolve()
    assert heard == [f"interrupted; go on with --resume {run.path} --allow_code {file}"]
    monkeypatch.setattr(trust, "_named", set())  # another process
    parser = cli.Parser("main", "", resume=True)
    again = cli.resumed_config(parser.parse(["--task", slider, "--resume", str(run.path)]), run.config)
    assert again == run.config and registry.make(again.task, config=again).name == "Slider"
    with pytest.raises(UserError, match="--task would change"):
        cli.resumed_config(parser.parse(["--task", "Pendulum", "--resume", str(run.path)]), run.config)


def test_the_ranges_of_the_class_hold_under_randomize(slider: str) -> None:
    config = config_of("--task", slider, "task.randomize=True")
    assert registry.make(config.task, config=config).space.names == ("block_mass_mult",)
    config = config_of("--task", slider, "task.randomize=False")
    assert registry.make(config.task, config=config).space.names == ()


def test_a_run_of_it_lies_under_its_name_and_asks_before_it_runs_the_file(slider: str, monkeypatch: Any) -> None:
    config = config_of("--task", slider)
    run = runs.Run.create("logs", config.task, "", config, [])
    assert run.path.parent == Path("logs/Slider") and runs.find_runs("logs", config.task)[0].path == run.path
    monkeypatch.setattr(trust, "_named", set())  # another process
    again = runs.Run.open(run.path).config
    assert again == config
    with pytest.raises(UserError, match=r"task .*slider\.py:Slider.*runs only where you name it.*--allow_code"):
        registry.make(again.task, config=again)
    cli.Parser("main", "").parse(["--allow_code", "slider.py"])
    assert registry.make(again.task, config=again).name == "Slider"


@pytest.mark.parametrize(
    ("task", "text", "words"),
    [
        ("none.py:Slider", SLIDER, ["no file", "none.py"]),
        ("slider.py:Slidr", SLIDER, ["no class 'Slidr'", "it has: Slider"]),
        ("slider.py", SLIDER, ["--task 'slider.py'", "slider.py:Slider"]),
        ("slider.py:XML", SLIDER, ["no subclass of bayessim_mjx.Task"]),
        ("slider.py:Slider", SLIDER.replace("def observe", "def look"), ["lacks the methods observe"]),
        ("slider.py:Slider", SLIDER.replace("control_dt = 0.02", ""), ["lacks `control_dt`"]),
        (
            "slider.py:Slider",
            SLIDER.replace('("position", "velocity")', '("position", "velocity", "force")'),
            ["Slider has 3 observation_names for an observation of 2 numbers"],
        ),
        ("slider.py:Slider", "import nonsense\n", ["slider.py, line 1", "nonsense"]),
        ("slider.py:Slider", "def (:\n", ["slider.py, line 1", "SyntaxError"]),
    ],
)
def test_what_is_no_task_is_one_line(task: str, text: str, words: list[str], tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "slider.py").write_text(text)
    assert main.main(["train", "--task", task]) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ") and err.count("\n") == 1 and all(word in err for word in words), err


def test_an_error_in_its_methods_names_the_line(tmp_path: Path) -> None:
    text = SLIDER.replace("-jnp.abs(after.qpos[0])", "-jnp.abs(after.position)")
    (tmp_path / "slider.py").write_text(text)
    line = 1 + text[: text.index("after.position")].count("\n")
    with pytest.raises(UserError, match=rf"slider\.py:Slider, line {line} in `reward`: AttributeError: .*position"):
        registry.make("slider.py:Slider")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("-jnp.abs(after.qpos[0]), jnp.zeros((), bool), {}", "-jnp.abs(after.qpos[0])",
         ["`reward` returned a number, but has to return (reward, terminated, metrics)"]),
        ("-jnp.abs(after.qpos[0]), jnp", "-jnp.abs(after.qpos), jnp",
         ["`reward` returned (an array of shape [1], a number, {})"]),
        ('{"policy": jnp.concatenate([world.measurement["qpos"], world.measurement["qvel"]])}',
         'world.measurement["qpos"]', ["`observe` returned an array of shape [1]", '{"policy": observation}']),
        ("jnp.zeros(1), jnp.zeros(1)", "jnp.zeros(1), jnp.zeros(2)",
         ["`initial` returned (an array of shape [1], an array of shape [2])", "of 1 and 1 numbers"]),
        ("jnp.zeros((), bool), {}", "jnp.zeros(()), {}", ["`terminated` of `reward` is float32, but has to be bool"]),
        ("5.0 * action", "5.0 * action[0]", ["`command` returned a number", "a vector of 1"]),
    ],
)  # fmt: skip
def test_a_method_that_returns_something_else_is_named(old: str, new: str, words: list[str], tmp_path: Path) -> None:
    assert old in SLIDER
    (tmp_path / "slider.py").write_text(SLIDER.replace(old, new))
    with pytest.raises(UserError) as error:
        registry.make("slider.py:Slider")
    assert all(word in str(error.value) for word in ["task Slider: ", *words]), error.value


def test_a_package_registers_tasks_by_entry_points(tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    (tmp_path / "own_package_of_tasks.py").write_text(SLIDER)
    (tmp_path / "own_package_of_tasks.yaml").write_text("ppo: {gamma: 0.7}\n")
    info = tmp_path / "own_package-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own-package\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[bayessim_mjx.tasks]\nSlider = own_package_of_tasks:Slider\nBroken = own_package_of_tasks:Nothing\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert main.main(["--list_tasks"]) == 0 and "Slider" in capsys.readouterr().out.split()
    config = config_of("--task", "slider")
    assert (config.task, config.ppo.gamma) == ("Slider", 0.7)
    assert registry.make("Slider", config=config).space.names == ("block_mass_mult",)
    assert load("Slider").ppo.gamma == 0.7
    with pytest.raises(UserError, match=r"'Broken': its entry point .*own_package_of_tasks:Nothing cannot be imported"):
        registry.make("Broken")
    sys.modules.pop("own_package_of_tasks", None)
