"""The commands, called in this process: bad input is one line and exit code 2, a killed run goes on bit for bit."""

import ast
import collections
import errno
import json
import os
import runpy
import shutil
import signal
import subprocess
import sys
import time
import types
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx import cli, config, diagnose, main, play, registry, train
from bayessim_mjx.env import Env, State
from bayessim_mjx.errors import DivergedError, UserError
from bayessim_mjx.monitor.writer import event_files, records
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.runs import Run, checkpoints, latest_run

SMALL = ["ppo.num_envs=4", "ppo.num_steps=4", "ppo.num_epochs=1", "ppo.num_minibatches=1", "ppo.hidden_actor=[4]"]
SMALL += [
    "ppo.hidden_critic=[4]",
    "ppo.log_interval=1",
    "ppo.save_interval=2",
    "ppo.eval_episodes=4",
    "--max_iterations=4",
]
SMALL += ["env.realParams.means=[[1.5]]", "env.realParams.stds=[[0.0]]", "--headless"]
LOOP = ["bayessim.realIters=2", "bayessim.trainTrajs=32", "bayessim.realEvals=4", "bayessim.components=2"]
LOOP += ["bayessim.hiddenLayers=[4]", "bayessim.trainTrajLen=4", "monitor.posterior_plots=False"]


class Toy(Env):
    """A mass on a line, pushed: quick to compile."""

    name, backend, episode_length, dt, action_size = "Pendulum", "toy", 8, 0.1, 1
    space = ParameterSpace([Parameter("mass", 1.0, 0.5, 2.0)])
    mj_model = mujoco.MjModel.from_xml_string("<mujoco/>")

    def reset(self, key: jax.Array, theta: jax.Array | None = None) -> State:
        mass = (jnp.asarray(self.space.nominal) if theta is None else theta)[0]
        return self._state(jax.random.normal(key, (2,)), mass, jnp.int32(0), jnp.float32(0))

    def step(self, state: State, action: jax.Array) -> State:
        x, mass = state.pipeline_state["x"], state.pipeline_state["mass"]
        x = x + self.dt * jnp.stack([x[1], jnp.clip(action[0], -1, 1) / mass])
        return self._state(x, mass, state.info["steps"] + 1, -jnp.sum(x**2))

    def _state(self, x: jax.Array, mass: jax.Array, steps: jax.Array, reward: jax.Array) -> State:
        zero, late = jnp.float32(0), (steps >= self.episode_length).astype(jnp.float32)
        info = {"terminated": zero, "truncated": late, "final_observation": {"policy": x}, "steps": steps}
        return State({"x": x, "mass": mass}, {"policy": x}, reward, zero, {}, info)


TOY = Toy()


@pytest.fixture(autouse=True)
def quiet(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("BAYESSIM_MJX_CACHE", "off")
    monkeypatch.delenv("BAYESSIM_MJX_DEBUG", raising=False)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every task is the toy."""
    monkeypatch.setattr(registry, "make", lambda name, **_: TOY)


def error_of(capsys: pytest.CaptureFixture, run: Any, *argv: str) -> str:
    """The one line on stderr of a command that has to refuse."""
    assert run(list(argv)) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ") and err.count("\n") == 1 and "Traceback" not in err
    return err


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--task", "Pendulm"], ["'Pendulm'", "Did you mean Pendulum", "Allowed: Ant, "]),
        (["--tsk", "Pendulum"], ["'--tsk'", "Did you mean --task"]),
        (["--task", "Pendulum", "--num_envs", "many"], ["--num_envs", "'many'"]),
        (["--task", "Pendulum", "--num_envs", "0"], ["env.numEnvs = 0", "--num_envs", "at least 1"]),
        (["--task", "Pendulum", "--task"], ["--task", "expected one argument"]),
        (["--task", "Pendulum", "word"], ["'word'", "section.key=value"]),
        (["--task", "Pendulum", "bayessim.component=5"], ["bayessim.component", "Did you mean bayessim.components"]),
        (["--task", "Pendulum", "--device", "tpu:7"], ["device = 'tpu:7'", "available: cpu:0"]),
        (["--task", "Pendulum", "--device", "abacus"], ["device = 'abacus'", "cuda:0"]),
        (["--task", "Pendulum", "--device", "auto:1"], ["device = 'auto:1'", "expected auto, cpu, gpu"]),
        (["--task", "Pendulum", "--cfg_env", "nowhere.yaml"], ["nowhere.yaml", "cannot be read"]),
        (["--task", "Pendulum", "--name", "../up"], ["name = '../up'"]),
        (["--resume", "nowhere"], ["nowhere: not a run folder"]),
        (["--task", "Pendulum", "--checkpoint", "nowhere"], ["--checkpoint nowhere: no such folder"]),
        (["--task", "Pendulum", "--use_last_checkpoint"], ["no run of 'Pendulum' with a checkpoint"]),
        (["--task", "Pendulum", "--use_last_checkpoint", "--checkpoint", "best"], ["give one of them"]),
        (["--task", "Pendulum", "--num_envs", "\u0663"], ["--num_envs", "'\u0663'"]),
        (["--task", "Pendulum", "--seed", "9" * 20], ["seed = 99999999999999999999", "at most 4294967295"]),
        (["--task", "Pendulum", "--num_envs", str(10**13)], ["env.numEnvs = 10000000000000", "--num_envs", "at most"]),
        (["--task", "Pendulum", "--num_envs", "4", "ppo.num_envs=8"], ["--num_envs", "num_envs=8", "one setting"]),
        ([], ["no task", "--list_tasks"]),
    ],
)
@pytest.mark.parametrize("command", [main.main, train.main])
def test_bad_input_is_one_line(command: Any, argv: list[str], words: list[str], capsys: Any, toy: None) -> None:
    line = error_of(capsys, command, *argv)
    assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("env.realParams.means=[[1.0, 5.0]]", ["env.realParams.means", "length", "5", "[0.01, 2]"]),
        ("env.realParams.means=[[1.0, 0.5, 3.0]]", ["env.realParams.means", "3"]),
        ("env.realParams.means=[{mass: 1.0}]", ["mass"]),
        ("real.logs=[empty]", ["empty"]),
    ],
)
def test_bad_real_side_is_one_line(override: str, words: list[str], capsys: Any, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    line = error_of(capsys, main.main, "--task", "Pendulum", override)
    assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("command", "override", "words"),
    [
        (main.main, "ppo.teacher=/nope", ["ppo.teacher = '/nope'", "train --distil"]),
        (train.main, "bayessim.components=5", ["bayessim.components: train has no use for it"]),
        (train.main, "real.logs=[a]", ["real.logs: train has no use for it"]),
    ],
)
def test_settings_of_another_command_are_refused(command: Any, override: str, words: list[str], capsys: Any) -> None:
    line = error_of(capsys, command, "--task", "Pendulum", override)
    assert all(word in line for word in words), line


def test_what_the_allocator_refuses_names_the_numbers_to_lower(toy: None, monkeypatch: Any, capsys: Any) -> None:
    def full(*_: Any) -> float:
        raise RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 104593043368 bytes.")

    monkeypatch.setattr(train.Training, "evaluate", full)
    line = error_of(capsys, train.main, "--task", "Pendulum", *SMALL)
    assert "allocating 104593043368 bytes; lower env.numEnvs, ppo.num_steps or bayessim.trainTrajs" in line


def test_what_means_nothing_here_is_one_note(capsys: Any, tmp_path: Path, toy: None) -> None:
    (tmp_path / "f.yaml").write_text("sim: {substeps: 2}\nenv: {envSpacing: 2}\n")
    assert train.main(["--task", "Pendulum", *SMALL, "--cfg_env", "f.yaml", "--max_iterations", "0"]) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "mean nothing" in line]
    assert line == "note: f.yaml: left out, as they mean nothing here: sim, env.envSpacing"


def test_help_and_task_list_need_no_task(capsys: pytest.CaptureFixture) -> None:
    for command in (main.main, train.main, play.main):
        assert command(["--help"]) == 0
        assert "section.key=value" in capsys.readouterr().out
    assert main.main(["--list_tasks"]) == 0
    assert {"Pendulum", "Cartpole", "Ant"} <= set(capsys.readouterr().out.split())


@pytest.mark.parametrize("name", main.COMMANDS)
def test_one_console_script_takes_all_commands(name: str, capsys: pytest.CaptureFixture, monkeypatch: Any) -> None:
    monkeypatch.setattr(sys, "argv", ["/usr/bin/bayessim-mjx"])
    for written in {name, name.replace("_", "-")}:
        assert main.main([written, "--help"]) == 0
        usage = capsys.readouterr().out.split("\n\n")[0]
        assert usage.startswith(f"usage: bayessim-mjx {name.replace('_', '-')} ")


def test_a_command_that_does_not_exist_is_one_line(capsys: pytest.CaptureFixture) -> None:
    line = error_of(capsys, main.main, "gap-lop", "--task", "Pendulum")
    assert "command 'gap-lop' is unknown. Did you mean gap-loop?" in line and "calibrate, diagnose" in line


def test_version(capsys: pytest.CaptureFixture) -> None:
    for command in (main.main, play.main, diagnose.main):
        assert command(["--version"]) == 0
        assert f"jax {jax.__version__}, mujoco {mujoco.__version__})" in capsys.readouterr().out


def test_flags_are_read_before_jax_is_imported() -> None:
    slow = "{'jax', 'mujoco', 'numpy', 'rich', 'yaml'} & set(sys.modules)"
    for call in (["diagnose", "--help"], ["--version"], ["nothing"]):
        code = f"import sys; from bayessim_mjx.main import main; main({call}); assert not ({slow}), {slow}"
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_help_fits_into_80_columns(monkeypatch: Any, capsys: pytest.CaptureFixture) -> None:
    from bayessim_mjx import calibrate, diagnose, gap_loop

    monkeypatch.setenv("COLUMNS", "80")
    for command in (main, train, play, calibrate, diagnose, gap_loop):
        assert command.main(["--help"]) == 0
        usage, *lines = capsys.readouterr().out.splitlines()
        assert usage.startswith(f"usage: python -m {command.__name__} ") and max(map(len, [usage, *lines])) <= 80
        flags = [line for line in lines if line.startswith("  -")]
        assert all(len(line.split()) > 2 or lines[lines.index(line) + 1].startswith(" " * 8) for line in flags), flags


def test_every_ancestor_flag_is_known() -> None:
    flags = "--task --num_envs --seed --max_iterations --headless --video --video_length --video_interval --checkpoint"
    flags += " --use_last_checkpoint --logdir --cfg_env --cfg_train --device"
    for prog in ("main", "train", "play"):
        assert set(flags.split()) <= set(cli.Parser(prog, "")._option_string_actions)


def test_seed_minus_one_is_drawn_and_recorded() -> None:
    args = cli.Parser("main", "").parse(["--task", "pendulum", "--seed", "-1", "ppo.gamma=0.5"])
    config = cli.config_of(args)
    assert 0 <= config.seed < 10_000 and config.task == "Pendulum" and config.ppo.gamma == 0.5


@pytest.mark.parametrize("flag", ["--max_iterations=3", "--video_interval", "--name", "--resume"])
def test_play_neither_shows_nor_takes_flags_of_training(flag: str, capsys: pytest.CaptureFixture) -> None:
    assert f"{flag.split('=')[0]}: play has no use for it" in error_of(capsys, play.main, flag, "3")
    assert play.main(["--help"]) == 0
    assert flag.split("=")[0] not in capsys.readouterr().out


def checkpoint_of(run: Run, step: int) -> list:
    """Names, shapes and checksums of everything in a checkpoint."""
    return json.loads((run.checkpoint(step) / "index.json").read_text())["parts"]


def repeated_events(run: Run) -> list:
    """(folder, tag, step) that the run's TensorBoard events hold more than once, in all folders."""
    folders = [run.path, *(run.path / name for name in ("bsim", "rl", "rl_time"))]
    count = collections.Counter(
        (folder.name, value.tag, event.step)
        for folder in folders
        for file in event_files(folder)
        for _, event in records(file)
        for value in event.summary.value
    )
    assert count
    return [key for key, n in count.items() if n > 1]


class Killed(BaseException):
    """Nothing catches it: what is on the disk now is what a SIGKILL leaves."""


def killed_after(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Run.save: complete `count` times, then die in the middle of the next one (half a folder, old manifest)."""
    whole, done = Run.save, []

    def save(self: Run, step: int, tree: Any, **options: Any) -> Path:
        if len(done) == count:
            (self.path / "checkpoints" / f"{step:09d}.1.tmp" / "state").mkdir(parents=True)
            raise Killed
        done.append(step)
        return whole(self, step, tree, **options)

    monkeypatch.setattr(Run, "save", save)


@pytest.mark.parametrize("saves", [0, 1])
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


def test_only_what_the_user_can_mend_is_one_line(capsys: pytest.CaptureFixture) -> None:
    """Exit codes: 2 for a user's error and for what the system refuses, 1 with the traceback for a bug."""

    def ends(error: BaseException) -> tuple[int, str]:
        def run(argv: Any) -> int:
            raise error

        return cli.command(run)([]), capsys.readouterr().err

    assert ends(UserError("x = 3:\nallowed: 4")) == (2, "error: x = 3: allowed: 4\n")
    assert ends(PermissionError(errno.EACCES, "Permission denied", "out")) == (
        2, f"error: [Errno {errno.EACCES}] Permission denied: 'out'\n",
    )  # fmt: skip
    assert ends(KeyboardInterrupt())[0] == 130 and ends(SystemExit(0)) == (0, "")
    for bug in (ValueError("math domain error"), FloatingPointError("x"), KeyError("k"), SystemExit("bye")):
        code, err = ends(bug)
        assert code == 1 and "Traceback" in err and "please report it" in err.splitlines()[-1]


def test_main_stops_only_after_the_rounds_checkpoint() -> None:
    """A stop that is asked for during inference comes while the round is reported, before it is saved."""
    calls: list = []
    wall = types.SimpleNamespace(mark=lambda: 7)
    session = types.SimpleNamespace(round=lambda *_: calls.append("round"), flush=lambda: None, wall=wall)
    run = types.SimpleNamespace(save=lambda step, tree, *, meta, **_: calls.append((step, meta["seconds"])))
    stop = cli.Stop()
    parts = types.SimpleNamespace(settings=types.SimpleNamespace(realIters=2))
    watched = main.Watched(session, stop, run, parts)
    stop.requested = True
    watched.round(None, None)
    with pytest.raises(KeyboardInterrupt):
        watched.save(5, {"state": types.SimpleNamespace(round=1)}, meta={})
    watched.save(10, {"state": types.SimpleNamespace(round=2)}, meta={})  # the last round: nothing is left to stop
    assert calls == ["round", (5, 7), (10, 7)]


def test_a_path_that_no_system_takes_is_one_line(capsys: pytest.CaptureFixture) -> None:
    xml = "<mujoco><worldbody><body><joint name='j'/><geom size='.1'/></body></worldbody>"
    Path("arm.xml").write_text(xml + "<actuator><motor name='m' joint='j'/></actuator></mujoco>")
    line = error_of(capsys, diagnose.main, "--model", "arm.xml", "--data", "a" * 300)
    assert "a" * 300 in line and "too long" in line


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


def test_play_draws_from_the_posterior_in_the_coordinates_that_it_was_saved_in(tmp_path: Path) -> None:
    """A probit posterior's mean is that of its own draws; read as a plain one it was (1.35, 1.99) for (1.50, 1.90)."""
    from bayessim_mjx.distributions import Distribution
    from bayessim_mjx.distributions.charts import to_chart
    from bayessim_mjx.runs import checkpoints

    settings = config.load("Pendulum", overrides=["bayessim.components=1"])
    env, key = registry.make("Pendulum", config=settings), jax.random.PRNGKey(0)
    centre = np.asarray(to_chart(env.space.to_unit(np.float32([1.5, 1.9])), "probit"))
    posterior = Distribution.from_unit(env.space, [0.0], [centre], 0.05 * np.eye(2)[None], chart="probit")
    checkpoints.save(tmp_path / "1", {"state": {"domain": posterior}}, 1, {})
    drawn = np.asarray(play._physics(settings, env, tmp_path / "1", key, 400)["posterior"])
    np.testing.assert_array_equal(drawn, posterior.sample(key, 400))
    np.testing.assert_allclose(drawn.mean(0), [1.5, 1.9], atol=0.01)


@pytest.mark.slow
@pytest.mark.ci
def test_play_prints_returns_of_latest_best_run_and_path(toy: None, capsys: pytest.CaptureFixture) -> None:
    assert train.main(["--task", "Pendulum", *SMALL]) == 0
    run = latest_run("logs", "Pendulum")
    for which in ("latest", "best", str(run.path), str(run.checkpoint(2))):
        capsys.readouterr()
        assert play.main(["--task", "Pendulum", "--checkpoint", which, "--episodes", "3"]) == 0
        rows = {line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines() if line}
        assert {"nominal", "prior", "real"} <= set(rows) and float(rows["nominal"][0]) < 0
    assert "have nominal, prior, real" in error_of(
        capsys, play.main, "--checkpoint", str(run.path), "--physics=posterior"
    )
    line = error_of(capsys, play.main, "--checkpoint", str(run.path), "ppo.hidden_actor=[5]")
    assert "policy.actor" in line and "settings that it was made with" in line
    assert "give --task NAME" in error_of(capsys, play.main, "--checkpoint", "latest")
    assert "p.pt: the file's name has to end with .onnx" in error_of(
        capsys, play.main, "--checkpoint", str(run.path), "--export", "p.pt"
    )
    pytest.importorskip("onnxruntime", reason="the extra [export] is not installed")
    for flags in ([], ["deploy/p.onnx"]):
        assert play.main(["--checkpoint", str(run.checkpoint(2)), "--export", *flags]) == 0
        where, _, rest = capsys.readouterr().out.rpartition("exported ")[2].partition(": differs by ")
        assert float(rest.split()[0]) < 1e-5 and Path(where).is_file()
    assert where == "deploy/p.onnx"


@pytest.mark.parametrize("where", ["--logdir=elsewhere", "logdir=elsewhere"])
def test_play_looks_where_logdir_says(toy: None, capsys: pytest.CaptureFixture, where: str) -> None:
    assert train.main(["--task", "Pendulum", *SMALL, where, "--max_iterations=0"]) == 0
    assert play.main(["--task", "Pendulum", "--checkpoint", "latest", "--episodes", "2", where]) == 0
    assert "checkpoint elsewhere" in capsys.readouterr().out
    assert "no run of 'Pendulum'" in error_of(capsys, play.main, "--task", "Pendulum", "--checkpoint", "latest")


@pytest.mark.parametrize("name", [p.name for p in sorted((Path(__file__).parents[1] / "examples").glob("*.py"))])
def test_examples_say_what_they_are(name: str, monkeypatch: Any, capsys: pytest.CaptureFixture) -> None:
    file = Path(__file__).parents[1] / "examples" / name
    monkeypatch.syspath_prepend(file.parent)
    monkeypatch.setattr(sys, "argv", [name, "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(file), run_name="__main__")
    first = ast.get_docstring(ast.parse(file.read_text()))
    assert end.value.code in (None, 0) and first is not None
    assert first.split()[:6] == capsys.readouterr().out.partition("\n\n")[2].split()[:6]


def test_training_goes_on_from_a_policy(toy: None) -> None:
    assert train.main(["--task", "Pendulum", *SMALL]) == 0
    run = latest_run("logs", "Pendulum")
    assert train.main(["--task", "Pendulum", *SMALL, "--checkpoint", "best", "--max_iterations", "0"]) == 0
    again = latest_run("logs", "Pendulum", with_checkpoint=False)
    assert again.path != run.path and again.config.bayessim.policyCheckpt == str(run.checkpoint("best").absolute())


@pytest.mark.slow
@pytest.mark.ci
def test_a_teacher_that_sees_theta_is_imitated_by_a_student_that_does_not(toy: None, capsys: Any) -> None:
    argv = ["--task", "Pendulum", "--randomize", *SMALL]
    assert train.main([*argv, "ppo.policy_theta=True", "--logdir", "teachers"]) == 0
    teacher = latest_run("teachers", "Pendulum")
    assert play.main(["--checkpoint", str(teacher.path), "--episodes", "3"]) == 0
    assert train.main([*argv, "--distil", str(teacher.path)]) == 0
    student = latest_run("logs", "Pendulum")
    assert Path(student.config.ppo.teacher or "") == teacher.checkpoint("best").absolute()
    assert train.main(["--resume", str(student.path), "--headless"]) == 0
    capsys.readouterr()
    assert play.main(["--checkpoint", str(student.path), "--episodes", "3", "--physics", "nominal"]) == 0
    assert "nominal" in capsys.readouterr().out
    assert "no such folder" in error_of(capsys, train.main, *argv, "--distil", "nowhere")


@pytest.mark.slow
@pytest.mark.ci
def test_main_killed_and_resumed_equals_unkilled(toy: None, monkeypatch: Any, capsys: pytest.CaptureFixture) -> None:
    argv = ["--task", "Pendulum", *SMALL, *LOOP]
    assert main.main([*argv, "--logdir", "whole"]) == 0
    whole = latest_run("whole", "Pendulum")
    last = whole.manifest["latest"]
    for saves in range(5):  # before the first one, within and between rounds
        with monkeypatch.context() as patch, pytest.raises(Killed):
            killed_after(patch, saves)
            main.main([*argv, "--logdir", "killed"])
        run = latest_run("killed", "Pendulum", with_checkpoint=False)
        assert main.main(["--resume", str(run.path), "--headless"]) == 0
        resumed = Run.open(run.path)
        assert checkpoint_of(resumed, last) == checkpoint_of(whole, last), saves
        assert [c["evaluation"] for c in resumed.checkpoints] == [c["evaluation"] for c in whole.checkpoints]
        assert not repeated_events(resumed)
        assert [json.loads(line)["round"] for line in (run.path / "rounds.jsonl").read_text().splitlines()] == [0, 1]
    capsys.readouterr()
    assert main.main(["--resume", str(whole.path), "--headless"]) == 0
    out = capsys.readouterr().out
    assert "this run had finished" in out and "contraction" in out  # and the table of parameters
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
@pytest.mark.ci
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


@pytest.mark.slow
@pytest.mark.ci
def test_a_real_process_on_logs_survives_sigkill(tmp_path: Path) -> None:
    """kill -9 after the first checkpoint, --resume: the last checkpoint is that of an unkilled run, and it plays."""
    write_pendulum_logs(tmp_path / "recorded")
    argv = ["--task", "Pendulum", *SMALL, *LOOP, "real.logs=recorded", "bayessim.realTrajs=2", "--seed", "3"]
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
    assert play.main(["--checkpoint", str(killed.path), "--episodes", "3", "--physics", "posterior"]) == 0
