"""The outer loop as a command: a killed run goes on bit for bit, also a real process that is killed."""

import json
import os
import signal
import subprocess
import sys
import time
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayessim_mjx import cli, config, loop, main, play, registry
from bayessim_mjx.runs import Run, latest_run
from tests.commands.toy_runs import LOOP, SMALL, Killed, checkpoint_of, killed_after, repeated_events


def test_main_stops_only_after_the_rounds_checkpoint() -> None:
    """A stop that is asked for during inference comes while the round is reported, before it is saved."""
    calls: list = []
    wall = types.SimpleNamespace(mark=lambda: 7)
    session = types.SimpleNamespace(part=lambda *_: None, flush=lambda: None, wall=wall)
    session.round = lambda *_: calls.append("round")
    run = types.SimpleNamespace(save=lambda step, tree, *, meta, **_: calls.append((step, meta["seconds"])))
    stop = cli.Stop()
    parts = types.SimpleNamespace(finished=lambda state: state.round == 2)
    watched = main.Watched(session, stop, run, parts)
    watched.part(0, "simulate")
    assert "end of this round, which may take minutes" in stop.when
    watched.save(4, {"state": types.SimpleNamespace(round=1)}, meta={})
    assert calls.pop() == (4, 7) and stop.when == "after this step"  # the next round trains
    stop.requested = True
    watched.round(None, None)
    with pytest.raises(KeyboardInterrupt):
        watched.save(5, {"state": types.SimpleNamespace(round=1)}, meta={})
    watched.save(10, {"state": types.SimpleNamespace(round=2)}, meta={})  # the last one: none is left
    assert calls == ["round", (5, 7), (10, 7)]


def test_ctrl_c_while_main_compiles_says_that_nothing_was_written(toy: None, monkeypatch: Any, capsys: Any) -> None:
    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(loop, "make", stopped)
    assert main.main(["main", "--task", "Pendulum", *SMALL, *LOOP]) == 130
    assert "interrupted while compiling: nothing was written" in capsys.readouterr().out
    assert not Path("logs/Pendulum").exists()


@pytest.mark.slow
@pytest.mark.ci
def test_main_killed_and_resumed_equals_unkilled(toy: None, monkeypatch: Any, capsys: pytest.CaptureFixture) -> None:
    argv = ["--task", "Pendulum", *SMALL, *LOOP]
    assert main.main([*argv, "--logdir", "whole"]) == 0
    whole = latest_run("whole", "Pendulum")
    last = whole.manifest["latest"]
    for saves in (0, 1, 3):  # before the first one, within the first and the second round
        with monkeypatch.context() as patch, pytest.raises(Killed):
            killed_after(patch, saves)
            main.main([*argv, "--logdir", "killed"])
        run = latest_run("killed", "Pendulum", with_checkpoint=False)
        assert main.main(["--resume", str(run.path), "--headless"]) == 0
        resumed = Run.open(run.path)
        assert checkpoint_of(resumed, last) == checkpoint_of(whole, last), saves
        assert [c["evaluation"] for c in resumed.checkpoints] == [c["evaluation"] for c in whole.checkpoints]
        assert not repeated_events(resumed)
        assert [json.loads(line)["round"] for line in (run.path / "rounds.jsonl").read_text().splitlines()] == [1, 2]
    capsys.readouterr()
    assert main.main(["--resume", str(whole.path), "--headless"]) == 0
    out = capsys.readouterr().out
    assert "this run had finished" in out and "posterior/prior sd" in out  # and the table of parameters
    assert play.main(["--checkpoint", str(whole.path), "--episodes", "3"]) == 0
    assert "posterior" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(("summary", "model"), [("learned", "MDNN"), ("signatory_2", "MDRFF")])
def test_main_learns_from_every_kind_of_summary(toy: None, summary: str, model: str) -> None:
    """The toy's mass is 1.5 of 0.5 to 2: a thousand short trajectories are enough to favour it over the prior."""
    more = [f"bayessim.summarizerFxn={summary}", f"bayessim.modelClass={model}", "bayessim.trainTrajs=1000"]
    more += ["bayessim.hiddenLayers=[32]", "bayessim.trainTrajLen=8", "bayessim.ensemble=2", "bayessim.realIters=1"]
    assert main.main(["--task", "Pendulum", *SMALL, *LOOP, *more]) == 0
    run = latest_run("logs", "Pendulum")
    (row,) = [json.loads(line) for line in (run.path / "rounds.jsonl").read_text().splitlines()]
    assert row["scores"]["gain_over_prior"] > 0.2 and row["checks"]["misfit"]["p"] > 0.01


def interrupted_round(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C while the first round is reported."""
    from bayessim_mjx.monitor.session import Session

    whole = Session.round

    def round_(self: Session, info: Any, policy: Any) -> None:
        whole(self, info, policy)
        if info.round == 0:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Session, "round", round_)


@pytest.mark.slow
def test_main_interrupted_in_a_round_keeps_the_round(toy: None, monkeypatch: Any) -> None:
    with monkeypatch.context() as patch:
        interrupted_round(patch)
        assert main.main(["--task", "Pendulum", *SMALL, *LOOP]) == 130
    run = latest_run("logs", "Pendulum")
    assert run.manifest["status"] == "interrupted" and run.checkpoints[-1]["evaluation"] is not None
    assert run.manifest["best"] == run.manifest["latest"] == 5
    assert main.main(["--resume", str(run.path), "--headless"]) == 0
    assert not repeated_events(run) and Run.open(run.path).manifest["status"] == "finished"


def write_pendulum_logs(folder: Path) -> None:
    """Six runs of 3 s on the pendulum with mass 1.4 and length 0.7, as CSV."""
    from bayessim_mjx.rollout import replay

    env = registry.make("Pendulum", config=config.load("Pendulum"))
    clock, starts = np.arange(61) * env.dt, np.linspace(-2.5, 2.5, 6)[:, None]
    command = 2.0 * np.sin(np.outer(np.linspace(1.0, 4.0, 6), clock[:-1]))[..., None]
    motion = replay(env.physics, starts, np.zeros_like(starts), command, np.tile([1.4, 0.7], (6, 1)))
    actuator, joint = env.mj_model.actuator(0).name, env.mj_model.joint(0).name
    header = f"time,ctrl:{actuator},qpos:{joint},qvel:{joint}"
    folder.mkdir()
    for i in range(6):
        columns = [clock, np.append(command[i], command[i][-1]), motion["qpos"][i], motion["qvel"][i]]
        np.savetxt(folder / f"run{i}.csv", np.column_stack(columns), delimiter=",", header=header, comments="")


@pytest.mark.parametrize("command", [["main"], ["train"], ["gap-loop"]])
def test_the_help_of_another_command_is_not_that_of_this_one(command: list[str], capsys: pytest.CaptureFixture) -> None:
    assert main.main([*command, "logs", "--help"]) == 2
    out = capsys.readouterr()
    assert "'logs' is a command of its own: " in out.err and not out.out


def test_a_model_in_the_place_of_a_task_is_refused_with_the_way_on(capsys: pytest.CaptureFixture) -> None:
    assert main.main(["gap-loop", "--model", "robot.xml", "--diagnosis", "found"]) == 2
    assert "--task file.py:Class" in capsys.readouterr().err


@pytest.mark.slow
def test_a_real_process_on_logs_survives_sigkill(tmp_path: Path) -> None:
    """kill -9 after the first checkpoint, --resume: the last checkpoint is that of an unkilled run, and it plays."""
    write_pendulum_logs(tmp_path / "recorded")
    argv = ["--task", "Pendulum", *SMALL, *LOOP, "--seed", "3"]
    argv += ["real.logs=recorded", "bayessim.realTrajs=2", "bayessim.checkTrajs=0"]
    start = [sys.executable, "-m", "bayessim_mjx.main"]
    environment = {**os.environ, "BAYESSIM_MJX_CACHE": str(tmp_path / "cache")}
    subprocess.run([*start, *argv, "--logdir", "whole"], env=environment, check=True, capture_output=True)
    whole = latest_run("whole", "Pendulum")

    with subprocess.Popen([*start, *argv, "--logdir", "killed"], env=environment, stdout=subprocess.DEVNULL) as process:
        manifest = lambda: list(Path("killed").glob("*/*/run.json"))  # noqa: E731
        while not (manifest() and json.loads(manifest()[0].read_text())["checkpoints"]):
            assert process.poll() is None
            time.sleep(0.02)
        process.kill()
    killed = latest_run("killed", "Pendulum")
    assert process.returncode == -signal.SIGKILL and killed.manifest["status"] == "running"
    assert killed.manifest["latest"] < whole.manifest["latest"]

    again = subprocess.run([*start, "--resume", str(killed.path)], env=environment, check=True, capture_output=True)
    assert "warning: real.logs: the logged commands act" in again.stdout.decode() and b"Warning" not in again.stderr
    resumed, last = Run.open(killed.path), whole.manifest["latest"]
    assert checkpoint_of(resumed, last) == checkpoint_of(whole, last)
    assert [c["evaluation"] for c in resumed.checkpoints] == [c["evaluation"] for c in whole.checkpoints]
    assert not repeated_events(resumed)
    assert resumed.manifest["best"] == last  # under logs only the newest evaluation counts
    played = [sys.executable, "-m", "bayessim_mjx.play", "--checkpoint", str(killed.path), "--physics", "posterior"]
    subprocess.run([*played, "--episodes", "3"], env=environment, check=True, capture_output=True)
