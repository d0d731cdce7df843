"""Isaac Lab's flags of `play`: how many worlds at once, and the policy that comes with the package."""

import re
from pathlib import Path

import pytest

from bayessim_mjx import cli, play, train
from bayessim_mjx.rl import pretrained
from bayessim_mjx.runs import latest_run
from tests.commands.toy_runs import SMALL, error_of


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize(
    ("settings", "worlds"),
    [
        (["ppo.memory=3", "ppo.num_minibatches=4"], 2),  # minibatches are of whole sequences
        (["ppo.num_steps=5", "ppo.num_minibatches=20"], 1),  # as Brax has them: many minibatches of many worlds
    ],
)
def test_worlds_of_play_are_none_of_training(toy: None, capsys: pytest.CaptureFixture, settings: list, worlds: int):
    assert train.main(["--task", "Pendulum", *SMALL, "--max_iterations=0", *settings]) == 0
    run = str(latest_run("logs", "Pendulum").path)
    capsys.readouterr()
    returns = {}
    for flag in ("--num_envs", "--episodes"):
        assert play.main(["--checkpoint", run, flag, str(worlds), "--physics", "nominal"]) == 0
        out = capsys.readouterr().out
        assert f"{worlds} episodes each" in out
        returns[flag] = re.findall(r"nominal +(\S+)", out)
    assert returns["--num_envs"] == returns["--episodes"]
    assert play.main(["--checkpoint", run, "--num_envs", "0", "--physics", "nominal"]) == 0
    assert "4 episodes each" not in capsys.readouterr().out  # 0 says nothing: bayessim.realEvals
    assert "--num_envs: -1: must be from 0" in error_of(capsys, play.main, "--checkpoint", run, "--num_envs", "-1")
    assert "--episodes: 0: must be from 1" in error_of(capsys, play.main, "--checkpoint", run, "--episodes", "0")


def test_zero_worlds_are_those_of_the_settings() -> None:
    """BayesSimIG's default."""
    of = lambda *argv: cli.config_of(cli.Parser("train", "").parse(["--task", "Cartpole", *argv]))  # noqa: E731
    assert of("--num_envs", "0") == of() and of("--num_envs", "0", "env.numEnvs=7").env.numEnvs == 7
    assert of("--num_envs", "9").env.numEnvs == 9


@pytest.mark.slow
@pytest.mark.ci
def test_the_policy_that_comes_with_the_package_is_played(capsys: pytest.CaptureFixture) -> None:
    argv = ["--use_pretrained_checkpoint", "--task", "pendulum", "--physics", "nominal", "--episodes", "64"]
    assert play.main([*argv, "--device", "cpu"]) == 0
    out = capsys.readouterr().out
    facts = pretrained.about("Pendulum")["return"]
    mean = float(re.findall(r"nominal +(-?[\d.]+)", out)[0])
    assert abs(mean - facts["mean"]) < 4 * facts["sd"] / 64**0.5  # resting, it gets -1200
    assert "the policy that comes with the package" in out and "posterior" not in out


@pytest.mark.slow
@pytest.mark.ci
def test_it_is_exported_and_its_files_lie_under_logdir(capsys: pytest.CaptureFixture) -> None:
    pytest.importorskip("onnx", reason="the extra [export] is not installed")
    argv = ["--use_pretrained_checkpoint", "--task", "Cartpole", "--logdir", "mine"]
    assert play.main([*argv, "--export"]) == 0
    assert Path("mine/Cartpole/exported/pretrained.onnx").is_file()
    assert "exported mine/Cartpole/exported/pretrained.onnx" in capsys.readouterr().out
    assert play.main([*argv, "--hub", "hub", "--episodes", "2", "--physics", "nominal"]) == 0
    assert pretrained.about("Cartpole")["command"] in Path("hub/README.md").read_text()


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--task", "Ant"], "none comes for Ant; policies come for Pendulum, Cartpole, BallBalance. bayessim-"),
        ([], "give --task NAME; policies come for Pendulum"),
        (["--task", "Cartpole", "--checkpoint", "best"], "and --checkpoint best: give one of them"),
        (["--task", "Cartpole", "ppo.memory=4"], "ppo.memory=4: the policy that comes with the package has settings"),
        (["--task", "Cartpole", "--cfg_train", "f.yaml"], "--cfg_train: the policy that comes with the package"),
    ],
)
def test_what_it_cannot_be_played_with_is_said(argv: list, words: str, capsys: pytest.CaptureFixture) -> None:
    assert words in error_of(capsys, play.main, "--use_pretrained_checkpoint", *argv)
