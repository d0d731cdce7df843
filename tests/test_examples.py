"""Every script of examples/ runs, with small settings; those of other libraries where these are installed."""

import functools
import json
import re
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_mjx import config, registry

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
ELSEWHERE = {"deploy_loop": "rl/test_deploy_loop.py", "own_task": "tasks/test_own_task_example.py"}
HERE = (
    "quickstart", "diagnose_pendulum", "hidden_reward", "convert_xl330", "adapt_servo", "sb3_under_posterior",
    "rsl_rl_under_posterior",
)  # fmt: skip
TINY = [
    "env.numEnvs=8", "ppo.num_steps=16", "ppo.max_iterations=2", "bayessim.trainTrajs=200", "bayessim.realEvals=4",
    "bayessim.checkTrajs=0", "bayessim.ensemble=1", "bayessim.refine=off", "bayessim.realIters=1",
]  # fmt: skip
Run = Callable[..., str]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, tmp_path: Path) -> Run:
    """Runs a script as `python examples/NAME.py ARGUMENTS`, with tiny settings; what it printed."""
    load = config.load
    small = lambda *given, overrides=(), **more: load(*given, overrides=[*TINY, *overrides], **more)  # noqa: E731

    def ran(name: str, *argv: object) -> str:
        monkeypatch.setattr(config, "load", small)
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *map(str, argv)])
        monkeypatch.syspath_prepend(str(EXAMPLES))
        monkeypatch.chdir(tmp_path)
        runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
        return capsys.readouterr().out

    return ran


def test_each_script_has_a_test_that_runs_it() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == {*HERE, *ELSEWHERE}
    for name, file in ELSEWHERE.items():
        assert f"{name}.py" in (ROOT / "tests" / file).read_text()


@pytest.mark.slow
@pytest.mark.ci
def test_quickstart(run: Run) -> None:
    out = run("quickstart")
    assert out.count("posterior") == out.count("hidden truth") == 2 and "pendulum_mass_mult: " in out


@pytest.mark.slow
@pytest.mark.ci
def test_diagnose_pendulum(run: Run, tmp_path: Path) -> None:
    out = run("diagnose_pendulum", "--out", tmp_path, "--effects", "coulomb_friction,actuator_gain", "--headless")
    said = out[out.index("verdict:") :]  # behind the first guesses, which masses explain as well
    level, gain = (float(re.search(rf"{x} (\S+) ±", said)[1]) for x in ("hinge: level", "torque: gain"))
    assert level == pytest.approx(0.15, rel=0.1) and gain == pytest.approx(0.7, rel=0.05)  # what is hidden
    assert (tmp_path / "found" / "report.html").is_file() and "a policy of the plain simulator" in out


@pytest.mark.slow
@pytest.mark.ci
def test_hidden_reward(run: Run) -> None:
    out = run("hidden_reward", "--iterations", 2)
    assert "PPO alone: return" in out and "with novelty: return" in out


@pytest.mark.slow
@pytest.mark.ci
def test_logs_of_a_servo_are_converted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two logs in the form of Rhoban's, of a servo in MuJoCo."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import convert_xl330

    logs = convert_xl330.convert(tmp_path / "csv", _recorded(tmp_path / "raw"))
    first = np.genfromtxt(logs[0], delimiter=",", names=True)
    assert len(logs) == 2 and first["ctrlmotor"][1] == pytest.approx(-100 / 885 * 7.4)  # a register without sign
    sys.modules.pop("convert_xl330")


@pytest.mark.slow
@pytest.mark.ci
def test_a_servo_is_adapted_to(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    raw = _recorded(tmp_path / "raw")
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import convert_xl330

    monkeypatch.setattr(convert_xl330, "RAW", raw)
    monkeypatch.setattr(convert_xl330, "convert", functools.partial(convert_xl330.convert, raw=raw))
    out = run("adapt_servo", "--out", tmp_path, "ppo.max_iterations=0")  # other tests train
    assert "2 logs in" in out and "posterior mean" in out and (tmp_path / "posterior.png").stat().st_size > 10_000
    sys.modules.pop("convert_xl330")


def _recorded(folder: Path) -> Path:
    """Two JSON files: a servo swings at a duty of +-100 of 885."""
    folder.mkdir()
    model = registry.make("ServoPendulum").mj_model
    for k in range(2):
        data, entries = mujoco.MjData(model), []
        for i in range(500):
            duty = int(100 * np.sign(np.sin(0.05 * (k + 1) * i - 0.1)))
            data.ctrl[0] = duty / 885 * 7.4
            entry = {"timestamp": data.time, "load": duty % 65536, "position": data.qpos[0], "torque_enable": True}
            rest = dict.fromkeys(("goal_position", "speed", "input_volts", "temp"), 0.0)
            entries.append(entry | rest)
            mujoco.mj_step(model, data, max(1, round(0.01 / model.opt.timestep)))
        run = {"kp": 100 * (k + 1), "trajectory": "swing", "vin": 7.4, "mass": 0.5, "length": 0.1, "entries": entries}
        (folder / f"{k}.json").write_text(json.dumps(run))
    return folder


@pytest.mark.slow
def test_sb3_under_posterior(run: Run, tmp_path: Path) -> None:
    """Trained, saved, loaded, evaluated, filmed."""
    pytest.importorskip("stable_baselines3")
    given = ("--task", "Cartpole", "--num_envs", 8, "--out", tmp_path / "sb3")
    out = run("sb3_under_posterior", *given, "--domain", "prior", "--timesteps", 1024)
    assert "return of 8 episodes" in out and (tmp_path / "sb3" / "model.zip").is_file()
    played = run("sb3_under_posterior", *given, "--play", "--video")
    assert "return of 8 episodes" in played


@pytest.mark.slow
def test_rsl_rl_under_posterior(run: Run, tmp_path: Path) -> None:
    """With curiosity and symmetry; it writes TensorBoard's files and a checkpoint."""
    pytest.importorskip("rsl_rl")
    run("rsl_rl_under_posterior", "--num_envs", 8, "--iterations", 2, "--domain", "prior", "--out", tmp_path / "rsl")
    assert list((tmp_path / "rsl").glob("model_*.pt"))
