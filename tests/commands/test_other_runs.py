"""Runs of another command or task, and the newest that has no best: refused before anything is opened or written."""

import json
from pathlib import Path
from typing import Any

import jax
import pytest

from bayessim_mjx import cli, config, main, rl, train
from bayessim_mjx.errors import UserError
from bayessim_mjx.runs import Run, latest_run
from tests.commands.toy_runs import SMALL, TOY, Toy, error_of


class Wide(Toy):
    """Two actions, of which the second does nothing."""

    action_size = 2


WIDE = Wide()


def made(task: str, *words: str, best: float | None = None, name: str = "", env: Any = TOY) -> Run:
    """A run of `task` with a checkpoint of a policy of `env`."""
    overrides = {k: v for k, v in (text.split("=") for text in SMALL if text.startswith("ppo."))}
    settings = config.load(task, overrides=[f"{k}={v}" for k, v in overrides.items()])
    run = Run.create("logs", task, name, settings, ["bayessim-mjx", *words, "--task", task])
    policy = rl.policy_of(rl.init(env, settings.ppo, jax.random.PRNGKey(0)))
    run.save(2, {"policy": policy}, evaluation=best)
    run.set_status("interrupted" if best is None else "finished")
    return run


@pytest.mark.parametrize(("own", "other"), [("main", "train"), ("train", "main")])
def test_a_run_of_another_command_is_refused_untouched(toy: None, own: str, other: str, capsys: Any) -> None:
    run = made("Pendulum", own)
    before = (run.path / "run.json").read_text()
    line = error_of(capsys, main.main, other, "--resume", str(run.path))
    assert f"this is a run of {own}, not of {other}; `bayessim-mjx {own} --resume {run.path}` goes on" in line
    further = f"`bayessim-mjx train --domain {run.path} --checkpoint {run.path}`"
    assert (further in line) == (own == "main")
    assert (run.path / "run.json").read_text() == before


@pytest.mark.parametrize("command", ["train", "main"])
def test_a_policy_of_another_task_is_refused_by_its_name_before_there_is_a_run(
    toy: None, command: str, capsys: Any
) -> None:
    run = made("Cartpole", "train", best=1.0, env=WIDE)
    line = error_of(capsys, main.main, command, "--task", "Pendulum", *SMALL, "--checkpoint", str(run.path))
    assert "task_name = 'Cartpole', but the task is 'Pendulum'; give a policy of Pendulum" in line
    assert not Path("logs/Pendulum").exists()


def test_a_policy_of_another_task_with_the_same_numbers_is_told(toy: None, capsys: Any) -> None:
    run = made("Cartpole", "train", best=1.0)
    argv = ["--task", "Pendulum", *SMALL, "--max_iterations", "0", "--checkpoint", str(run.path)]
    assert train.main(argv) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "warning: " in said and "task_name = 'Cartpole', but the task is 'Pendulum': both have as many" in said
    assert latest_run("logs", "Pendulum", with_checkpoint=False).manifest["status"] == "finished"


def test_the_newest_run_without_a_best_names_the_one_that_has_one(toy: None) -> None:
    with_best, newest = made("Pendulum", "train", best=3.0, name="a"), made("Pendulum", "train", name="b")
    with pytest.raises(UserError) as error:
        cli.find_checkpoint("best", "Pendulum", "logs")
    assert f"{newest.path}, the newest run (interrupted), has none; give --checkpoint latest" in str(error.value)
    assert f"or --checkpoint {with_best.path}, the newest run that has a best" in str(error.value)
    assert json.loads((newest.path / "run.json").read_text())["status"] == "interrupted"
