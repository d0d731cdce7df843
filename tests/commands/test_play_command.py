"""Saved policies: found by name, played on every kind of physics, imitated."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import config, play, registry, train
from bayessim_mjx.cli import policies
from bayessim_mjx.env import State
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.runs import checkpoints, latest_run
from tests.commands.toy_runs import SMALL, TOY, Toy, error_of


@pytest.mark.parametrize("flag", ["--max_iterations=3", "--video_interval", "--name", "--resume"])
def test_play_neither_shows_nor_takes_flags_of_training(flag: str, capsys: pytest.CaptureFixture) -> None:
    assert f"{flag.split('=')[0]}: play has no use for it" in error_of(capsys, play.main, flag, "3")
    assert play.main(["--help"]) == 0
    assert flag.split("=")[0] not in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.ci
def test_play_draws_from_the_posterior_in_the_coordinates_that_it_was_saved_in(tmp_path: Path) -> None:
    """A probit posterior's mean is that of its own draws; read as a plain one it was (1.35, 1.99) for (1.50, 1.90)."""
    from bayessim_mjx.distributions import Distribution
    from bayessim_mjx.distributions.charts import to_chart

    settings = config.load("Pendulum", overrides=["bayessim.components=1"])
    env, key = registry.make("Pendulum", config=settings), jax.random.PRNGKey(0)
    centre = np.asarray(to_chart(env.space.to_unit(np.float32([1.5, 1.9])), "probit"))
    posterior = Distribution.from_unit(env.space, [0.0], [centre], 0.05 * np.eye(2)[None], chart="probit")
    checkpoints.save(tmp_path / "1", {"state": {"domain": posterior}}, 1, {})
    drawn = np.asarray(play._physics(settings, env, tmp_path / "1", key, 400)["posterior"]())
    np.testing.assert_array_equal(drawn, posterior.sample(key, 400))
    np.testing.assert_allclose(drawn.mean(0), [1.5, 1.9], atol=0.01)


@pytest.mark.slow
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
        where, _, rest = capsys.readouterr().out.rpartition("exported ")[2].partition(": its actions differ by ")
        assert float(rest.split()[0]) < 1e-5 and Path(where).is_file()
    assert where == "deploy/p.onnx"
    assert play.main(["--checkpoint", str(run.checkpoint(2)), "--episodes", "2", "--hub", "hub"]) == 0
    assert (
        "for a model hub: hub" in capsys.readouterr().out and "| nominal physics |" in Path("hub/README.md").read_text()
    )
    both = ("--checkpoint", str(run.path), "--hub", "other", "--export")
    assert "--hub and --export: give one of them" in error_of(capsys, play.main, *both)


class Noisy(Toy):
    """The toy as randomisation leaves it: with noise, for which a step costs a thousand here."""

    nuisance = "noise"

    def reset(self, key: jax.Array, theta: jax.Array | None = None, course: Any = None) -> State:
        return super().reset(key, theta)

    def _state(self, x: jax.Array, mass: jax.Array, steps: jax.Array, reward: jax.Array) -> State:
        return super()._state(x, mass, steps, reward - 1000.0 * (steps > 0))


@pytest.mark.slow
@pytest.mark.ci
def test_nominal_physics_is_without_noise_where_the_policy_was_trained_so(
    toy: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    assert train.main(["--task", "Pendulum", *SMALL, "--max_iterations=0", "task.randomize=False"]) == 0
    noisy = Noisy()

    def make(name: str, config: config.Config, **_: Any) -> Toy:
        return TOY if config.randomization.get("randomize") is False else noisy

    monkeypatch.setattr(registry, "make", make)
    for more, without in (([], True), (["task.randomize=True"], False)):
        capsys.readouterr()
        assert play.main(["--task", "Pendulum", "--checkpoint", "latest", "--episodes", "3", *more]) == 0
        told = [line.split() for line in capsys.readouterr().out.splitlines() if line]
        rows = {words[0]: words[1] for words in told if words[0] in ("nominal", "prior")}
        assert float(rows["prior"]) < -7000 and (float(rows["nominal"]) > -1000) is without


@pytest.mark.parametrize("where", ["--logdir=elsewhere", "logdir=elsewhere"])
@pytest.mark.slow
def test_play_looks_where_logdir_says(toy: None, capsys: pytest.CaptureFixture, where: str) -> None:
    assert train.main(["--task", "Pendulum", *SMALL, where, "--max_iterations=0"]) == 0
    assert play.main(["--task", "Pendulum", "--checkpoint", "latest", "--episodes", "2", where]) == 0
    assert "checkpoint elsewhere" in capsys.readouterr().out
    assert "no run of 'Pendulum'" in error_of(capsys, play.main, "--task", "Pendulum", "--checkpoint", "latest")


def test_policies_of_a_run_see_theta_in_the_runs_units(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mass of 2 of 1 to 5 kg is -0.5 to a policy that was trained there, whatever the range here."""

    class Wide(Toy):
        space = ParameterSpace([Parameter("mass", 1.0, 1.0, 5.0)])

    run = SimpleNamespace(config=config.load("Pendulum", overrides=["ppo.policy_theta=True", "name=theirs"]))
    monkeypatch.setattr(registry, "make", lambda name, config: Wide() if config.name == "theirs" else TOY)
    here, seen = config.load("Pendulum", overrides=["ppo.policy_theta=True"]), {}
    monkeypatch.setattr(policies, "find_checkpoint", lambda *_: (Path("there"), run))
    monkeypatch.setattr(policies, "load_policy", lambda path, env, config: seen.update(env=env))
    own = policies.privileged(here, TOY, run)[0]
    student = policies.privileged(config.replace(here, ppo={"policy_theta": False, "teacher": "there"}), TOY)[0]
    for env, group in ((own, "policy"), (student, "teacher"), (seen["env"], "policy")):
        assert env.reset(jax.random.PRNGKey(0), jnp.array([2.0])).obs[group][-1] == pytest.approx(-0.5)
    fresh = policies.privileged(here, TOY)[0]
    assert fresh.reset(jax.random.PRNGKey(0), jnp.array([2.0])).obs["policy"][-1] == 1.0
    begun = config.replace(here, bayessim={"policyCheckpt": "there"})
    with pytest.raises(UserError, match="in units of mass 1 to 5, but here the ranges are mass 0.5 to 2; give"):
        policies.warm_start(None, begun, fresh)


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


def test_returns_have_the_digits_of_the_largest_and_a_median():
    """`-0.0632` stood below `-400.4`, and -120 ± 130 for returns that are never positive."""
    skewed, better = np.array([-0.0632, -400.4, -90.0]), np.array([-0.2474, -380.4, -3.0])
    rows = play.returns_table([("nominal", skewed, np.full(3, 200.0)), ("prior", better, np.full(3, 150.0))])
    assert rows[0] == ["nominal", "-160 ± 170", "-90.0", "-400.4", "-0.1", "200"]
    assert rows[1][2:] == ["-3.0", "-380.4", "-0.2", "150"] and len(play.HEADER) == len(rows[0])
    (lost,) = play.returns_table([("nominal", np.full(2, np.nan), np.ones(2))])
    assert lost[2] == "nan"
