"""`train --resume RUN --max_iterations N`: a finished run goes on as if it had been asked for N at once."""

import json
from typing import Any

import pytest

from bayessim_mjx import config, main, train
from bayessim_mjx.runs import Run, latest_run
from tests.commands.toy_runs import SMALL, Killed, checkpoint_of, error_of, killed_after, repeated_events

# a learning rate that falls at every second step, networks for novelty, a ramp of their weight over 20 control steps;
# logs and checkpoints every third iteration, so that 4 is the end of neither
LEARNER = ["ppo.num_epochs=2", "ppo.desired_kl=1e-9", "ppo.rnd.weight=1", "ppo.log_interval=3", "ppo.save_interval=3"]
RAMP = "ppo.rnd.weight_schedule={mode: linear, initial_step: 0, final_step: 20, final_value: 0.1}"
ARGV = ["--task", "Pendulum", "--randomize", *SMALL, *LEARNER]


def changed(run: Run) -> list[str]:
    """Which settings are not those of the manifest; the code's commit is another matter."""
    return [text for text in run.changes() if not text.startswith(("git ", "version "))]


def values(run: Run, tag: str) -> dict[int, float]:
    """{step: value} of a tag in the run's scalars.jsonl."""
    rows = map(json.loads, (run.path / "scalars.jsonl").read_text().splitlines())
    return {row["step"]: row["value"] for row in rows if row["tag"] == tag}


@pytest.mark.slow
@pytest.mark.ci
def test_four_iterations_resumed_to_eight_are_eight(toy: None, capsys: pytest.CaptureFixture) -> None:
    argv = [*ARGV, RAMP, "monitor.writers=[jsonl]"]
    assert train.main([*argv, "--logdir", "whole", "--max_iterations", "8"]) == 0
    assert train.main([*argv, "--logdir", "parts"]) == 0
    first = latest_run("parts", "Pendulum")
    assert first.manifest["latest"] == 4 and first.manifest["status"] == "finished"
    given = first.config
    assert train.main(["--resume", str(first.path), "--max_iterations", "8", "--headless"]) == 0
    whole, run = latest_run("whole", "Pendulum"), Run.open(first.path)
    assert checkpoint_of(whole, 8) == checkpoint_of(run, 8)  # all arrays: optimiser, critic, normalisers, rate, clocks

    assert run.config == config.replace(given, ppo={"max_iterations": 8})
    assert run.manifest["settings"] == run.config.to_dict() and not changed(run)
    assert {k: run.manifest[k] for k in ("status", "latest")} == {"status": "finished", "latest": 8}
    assert [{k: e[k] for k in ("step", "from", "to")} for e in run.manifest["prolonged"]] == [
        {"step": 4, "from": 4, "to": 8}
    ]
    scores = {c["step"]: c["evaluation"] for c in run.checkpoints}
    for c in whole.checkpoints:
        assert scores.get(c["step"], c["evaluation"]) == c["evaluation"]
    assert run.manifest["best"] == max(scores, key=lambda step: scores[step])
    rewards, all_at_once = (values(r, "Eval/mean_reward") for r in (run, whole))
    assert sorted(rewards) == [3, 4, 6, 8] and {s: rewards[s] for s in all_at_once} == all_at_once
    assert not repeated_events(run)
    capsys.readouterr()
    assert train.main(["--resume", str(run.path)]) == 0
    assert "this run had finished" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.ci
def test_a_prolonged_run_that_is_killed_remembers_how_far_it_was_to_go(toy: None, monkeypatch: Any) -> None:
    assert train.main(ARGV) == 0
    run = latest_run("logs", "Pendulum")
    with monkeypatch.context() as patch, pytest.raises(Killed):
        killed_after(patch, 1)
        train.main(["--resume", str(run.path), "--max_iterations", "8"])
    assert Run.open(run.path).manifest["latest"] == 6
    assert train.main(["--resume", str(run.path)]) == 0
    again = Run.open(run.path)
    assert again.manifest["latest"] == 8 and again.config.ppo.max_iterations == 8 and not changed(again)
    assert not repeated_events(again)


def test_how_many_iterations_a_run_may_go_on_to(toy: None, capsys: pytest.CaptureFixture) -> None:
    assert train.main(ARGV) == 0
    run = str(latest_run("logs", "Pendulum").path)
    for total in ("4", "3", "0"):
        line = error_of(capsys, train.main, "--resume", run, "--max_iterations", total)
        assert f"--max_iterations {total}: the run has done 4 PPO iterations already; give more" in line
    assert "must be at most" in error_of(capsys, train.main, "--resume", run, "--max_iterations", str(10**12))
    assert "which ppo.gamma=0.5 would" in error_of(
        capsys, train.main, "--resume", run, "--max_iterations", "8", "ppo.gamma=0.5"
    )
    manifest = Run.open(run).manifest
    assert "prolonged" not in manifest and manifest["settings"]["ppo"]["max_iterations"] == 4


def test_rounds_of_the_loop_keep_their_iterations(capsys: pytest.CaptureFixture) -> None:
    run = Run.create("logs", "Pendulum", "", config.load("Pendulum"), "main").path
    line = error_of(capsys, main.main, "--resume", str(run), "--max_iterations", "9")
    assert "all rounds of a run have the same number" in line
    assert f"bayessim-mjx train --domain {run} --checkpoint {run} --max_iterations 9" in line
