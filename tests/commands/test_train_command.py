"""PPO alone as a command: a killed run goes on bit for bit, and whatever ends one is said."""

import json
import os
import shutil
import signal
from typing import Any

import jax
import pytest

from bayessim_mjx import train
from bayessim_mjx.errors import DivergedError, UserError
from bayessim_mjx.runs import Run, checkpoints, latest_run
from tests.commands.toy_runs import SMALL, Killed, checkpoint_of, error_of, killed_after, repeated_events


def test_what_the_allocator_refuses_names_the_numbers_to_lower(toy: None, monkeypatch: Any, capsys: Any) -> None:
    def full(*_: Any) -> float:
        raise RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 104593043368 bytes.")

    monkeypatch.setattr(train.Training, "evaluate", full)
    line = error_of(capsys, train.main, "--task", "Pendulum", *SMALL)
    assert "allocating 104593043368 bytes; lower env.numEnvs, ppo.num_steps or bayessim.trainTrajs" in line


@pytest.mark.parametrize("saves", [0, 1])
@pytest.mark.slow
@pytest.mark.ci
def test_train_killed_and_resumed_equals_unkilled(toy: None, monkeypatch: pytest.MonkeyPatch, saves: int) -> None:
    """Also with a learning rate that falls at every second step, and with networks for novelty."""
    learner = ["ppo.num_epochs=2", "ppo.desired_kl=1e-9", "ppo.rnd.weight=1"]
    argv = ["--task", "Pendulum", "--randomize", *SMALL, *learner]
    assert train.main([*argv, "--logdir", "whole"]) == 0
    with monkeypatch.context() as patch, pytest.raises(Killed):
        killed_after(patch, saves)
        train.main([*argv, "--logdir", "killed"])
    killed = latest_run("killed", "Pendulum", with_checkpoint=False)
    assert killed.manifest["status"] == "running" and killed.manifest["latest"] == (2 if saves else None)
    assert train.main(["--resume", str(killed.path), "--headless"]) == 0
    whole, resumed = latest_run("whole", "Pendulum"), Run.open(killed.path)
    assert checkpoint_of(whole, 4) == checkpoint_of(resumed, 4)
    assert whole.manifest["checkpoints"] == resumed.manifest["checkpoints"]
    assert resumed.manifest["status"] == "finished"
    assert not repeated_events(resumed)
    assert not list(resumed.path.glob("checkpoints/*.tmp"))


@pytest.mark.parametrize("at", [2, 3])
def test_ctrl_c_ends_with_a_checkpoint_and_130(
    toy: None, monkeypatch: Any, capsys: pytest.CaptureFixture, at: int
) -> None:
    """Also where an evaluation is due: the resumed run makes up for it."""
    handler = signal.getsignal(signal.SIGINT)  # ignored in background jobs
    argv = ["--task", "Pendulum", *SMALL]
    assert train.main([*argv, "--logdir", "whole"]) == 0
    with monkeypatch.context() as patch:
        progress = train.Training.progress

        def interrupted(self: train.Training, metrics: dict, state: Any) -> None:
            if int(state.iteration) == at:
                os.kill(os.getpid(), signal.SIGINT)
            progress(self, metrics, state)

        patch.setattr(train.Training, "progress", interrupted)
        assert train.main([*argv, "--logdir", "stopped"]) == 130
    run = latest_run("stopped", "Pendulum")
    assert run.manifest["status"] == "interrupted" and run.manifest["latest"] == at
    assert f"--resume {run.path}" in capsys.readouterr().out
    assert train.main(["--resume", str(run.path)]) == 0
    resumed, whole = Run.open(run.path), latest_run("whole", "Pendulum")
    assert checkpoint_of(resumed, 4) == checkpoint_of(whole, 4)
    scores = ({c["step"]: c["evaluation"] for c in r.checkpoints if c["step"] != 3} for r in (resumed, whole))
    assert next(scores) == next(scores)
    assert signal.getsignal(signal.SIGINT) is handler


def test_ctrl_c_after_the_last_iteration_still_evaluates_it(toy: None, monkeypatch: Any) -> None:
    progress = train.Training.progress

    def interrupted(self: train.Training, metrics: dict, state: Any) -> None:
        if int(state.iteration) == 4:
            os.kill(os.getpid(), signal.SIGINT)
        progress(self, metrics, state)

    monkeypatch.setattr(train.Training, "progress", interrupted)
    assert train.main(["--task", "Pendulum", *SMALL]) == 0
    run = latest_run("logs", "Pendulum")
    assert run.manifest["status"] == "finished" and run.checkpoints[-1]["evaluation"] is not None


@pytest.mark.parametrize("error", [DivergedError("the loss is not finite"), ValueError("math domain error")])
def test_a_run_that_fails_says_so(toy: None, monkeypatch: Any, capsys: Any, error: Exception) -> None:
    def fail(self: train.Training, state: Any) -> float:
        raise error

    monkeypatch.setattr(train.Training, "evaluate", fail)
    users = isinstance(error, UserError)
    assert train.main(["--task", "Pendulum", *SMALL]) == (2 if users else 1)
    err = capsys.readouterr().err
    assert ("Traceback" in err and "please report it" in err) != users  # a fault of ours keeps its traceback
    manifest = latest_run("logs", "Pendulum", with_checkpoint=False).manifest
    assert manifest["status"] == "failed" and manifest["error"] == f"{type(error).__name__}: {error}"


def test_a_full_disk_ends_the_run_cleanly_and_it_goes_on(toy: None, monkeypatch: Any, capsys: Any) -> None:
    """The disk fills up before the second checkpoint; with room again the run ends as one that never stopped."""
    argv = ["--task", "Pendulum", *SMALL]
    assert train.main([*argv, "--logdir", "whole"]) == 0
    free, saves = shutil.disk_usage("."), iter([0])
    with monkeypatch.context() as patch:
        usage = lambda path: free if next(saves, None) == 0 else free._replace(free=4096)  # noqa: E731
        patch.setattr(checkpoints.shutil, "disk_usage", usage)
        assert "the disk is full" in error_of(capsys, train.main, *argv, "--logdir", "full")
    run = latest_run("full", "Pendulum")
    assert (run.manifest["status"], run.manifest["error"], run.manifest["latest"]) == ("failed", "the disk is full", 2)
    assert len(list((run.path / "checkpoints").iterdir())) == 1 and not (run.path / ".reserve").exists()
    assert train.main(["--resume", str(run.path)]) == 0
    resumed = Run.open(run.path)
    assert resumed.manifest["status"] == "finished" and "error" not in resumed.manifest
    assert checkpoint_of(resumed, 4) == checkpoint_of(latest_run("whole", "Pendulum"), 4)
    assert not repeated_events(resumed)


def test_resume_says_what_changed_since(toy: None, capsys: pytest.CaptureFixture) -> None:
    assert train.main(["--task", "Pendulum", *SMALL]) == 0
    run = latest_run("logs", "Pendulum")
    assert train.main(["--resume", str(run.path)]) == 0
    assert "changed since" not in capsys.readouterr().out
    file = run.path / "params" / "train.yaml"
    gamma = run.config.ppo.gamma
    file.write_text(file.read_text().replace(f"gamma: {gamma}\n", "gamma: 0.5\n"))
    manifest = json.loads((run.path / "run.json").read_text())
    manifest["versions"]["jax"] = "0.0.1"
    (run.path / "run.json").write_text(json.dumps(manifest))
    assert train.main(["--resume", str(run.path)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    told = [f"ppo.gamma: 0.5, was {gamma}", f"version of jax: {jax.__version__}, was 0.0.1"]
    assert all(f"warning: changed since the run was started: {text}" in out for text in told), out
    assert Run.open(run.path).manifest["resumed"][-1]["changed"] == told


def test_resume_keeps_the_runs_settings(toy: None, capsys: pytest.CaptureFixture) -> None:
    assert train.main(["--task", "Pendulum", *SMALL]) == 0
    run = str(latest_run("logs", "Pendulum").path)
    for argv in (["--seed", "3"], ["ppo.gamma=0.5"], ["--task", "Ant"], ["--randomize"]):
        assert f"{argv[0]} would change" in error_of(capsys, train.main, "--resume", run, *argv)
    capsys.readouterr()
    assert train.main(["--resume", run, "--device", "cpu"]) == 0
    assert "this run had finished" in capsys.readouterr().out


def test_corrupted_checkpoints_of_a_run_to_resume(toy: None, capsys: pytest.CaptureFixture) -> None:
    assert train.main(["--task", "Pendulum", *SMALL]) == 0
    run = latest_run("logs", "Pendulum")
    (run.checkpoint(4) / "index.json").write_text("{")
    assert train.main(["--resume", str(run.path)]) == 0
    assert "going on from the checkpoint of step 2" in capsys.readouterr().err
    (run.path / "params" / "train.yaml").write_text("ppo: {gamma: [")
    assert "train.yaml" in error_of(capsys, train.main, "--resume", str(run.path))
    (run.path / "run.json").write_text("{")
    assert "damaged manifest" in error_of(capsys, train.main, "--resume", str(run.path))


def test_training_goes_on_from_a_policy(toy: None, capsys: pytest.CaptureFixture) -> None:
    assert train.main(["--task", "Pendulum", *SMALL]) == 0
    assert "are new" not in capsys.readouterr().out
    run = latest_run("logs", "Pendulum")
    assert train.main(["--task", "Pendulum", *SMALL, "--checkpoint", "best", "--max_iterations", "0"]) == 0
    again = latest_run("logs", "Pendulum", with_checkpoint=False)
    assert again.path != run.path and again.config.bayessim.policyCheckpt == str(run.checkpoint("best").absolute())
    said = " ".join(capsys.readouterr().out.split())
    assert (
        "checkpoints/" in said
        and f"critic, state of Adam and learning rate ({again.config.ppo.learning_rate:g}) are new" in said
    )
