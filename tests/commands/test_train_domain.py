"""`train --domain`: whose physics the episodes have."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from bayessim_mjx import main, play, train
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.loop.posterior import restored
from bayessim_mjx.runs import Run, latest_run
from bayessim_mjx.wrappers.worlds import domain_of
from tests.commands.toy_runs import LOOP, SMALL, TOY, error_of

ARGV = ["--task", "Pendulum", *SMALL]


@pytest.fixture
def evaluated(toy: None, monkeypatch: pytest.MonkeyPatch) -> list:
    """theta [n, d] of every evaluation of `train`."""
    from bayessim_mjx import rl

    seen, whole = [], rl.evaluate

    def evaluate(env: Any, policy: Any, key: Any, thetas: Any) -> Any:
        seen.append(np.asarray(thetas))
        return whole(env, policy, key, thetas)

    monkeypatch.setattr(rl, "evaluate", evaluate)
    return seen


def test_episodes_have_the_masses_of_the_file_that_is_the_domain(evaluated: list, tmp_path: Path) -> None:
    Distribution.gaussian(TOY.space, [1.7], [0.001]).save(tmp_path / "heavy.npz")
    assert train.main([*ARGV, "--domain", "heavy.npz", "--logdir", "logs"]) == 0
    assert np.abs(np.concatenate(evaluated) - 1.7).max() < 0.01
    run = latest_run("logs", "Pendulum")
    assert run.config.domain == str(tmp_path / "heavy.npz")
    assert run.config.randomization["randomize"] is True
    before = len(evaluated)  # what a run was trained on goes on with it, is played, and is a domain in its turn
    assert train.main([*ARGV, "--domain", str(run.path), "--logdir", "more"]) == 0
    assert np.abs(np.concatenate(evaluated[before:]) - 1.7).max() < 0.01
    drawn = play._physics(run.config, TOY, run.checkpoint("latest"), jax.random.PRNGKey(0), 50)["posterior"]()
    assert np.abs(np.asarray(drawn) - 1.7).max() < 0.01


@pytest.mark.parametrize("domain", ["nominal", "prior"])
def test_nominal_and_prior_are_domains_too(evaluated: list, domain: str) -> None:
    assert train.main([*ARGV, "--domain", domain]) == 0
    spread = np.ptp(np.concatenate(evaluated))
    assert spread == 0 if domain == "nominal" else spread > 0.3


def test_a_runs_posterior_is_a_domain_and_its_settings_hold(evaluated: list) -> None:
    """Task and networks are those of the loop, where nothing else is given."""
    assert main.main([*ARGV, *LOOP, "--logdir", "loop"]) == 0
    loop, before = latest_run("loop", "Pendulum"), len(evaluated)
    argv = ["--domain", str(loop.path), "--max_iterations", "2", "--logdir", "after", "--headless"]
    assert train.main(argv) == 0
    run = latest_run("after", "Pendulum")
    assert run.config.ppo.hidden_actor == (4,) and run.config.env.numEnvs == 4 and run.config.ppo.max_iterations == 2
    posterior = restored(loop.checkpoint("latest"), TOY, loop.config)
    assert posterior is not None
    _, key = jax.random.split(jax.random.PRNGKey(run.config.seed))
    np.testing.assert_array_equal(evaluated[before], posterior.sample(key, 4))
    found = domain_of(TOY, run.path)  # for the wrappers
    assert found is not None
    np.testing.assert_array_equal(found.logits, posterior.logits)


def test_a_resumed_run_keeps_its_domain(evaluated: list, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tests.commands.toy_runs import Killed, killed_after

    Distribution.gaussian(TOY.space, [0.6], [0.001]).save(tmp_path / "light.npz")
    with monkeypatch.context() as patch, pytest.raises(Killed):
        killed_after(patch, 1)
        train.main([*ARGV, "--domain", "light.npz", "--logdir", "logs"])
    killed, before = latest_run("logs", "Pendulum"), len(evaluated)
    assert train.main(["--resume", str(killed.path), "--headless"]) == 0
    assert len(evaluated) > before and np.abs(np.concatenate(evaluated) - 0.6).max() < 0.01
    assert Run.open(killed.path).manifest["status"] == "finished"


def test_what_is_no_domain_is_refused_with_what_is_allowed(toy: None, capsys: Any) -> None:
    line = error_of(capsys, train.main, *ARGV, "--domain", "nowhere")
    assert "--domain nowhere: allowed are nominal, prior, the folder of a run" in line
    assert "--domain /nowhere: allowed are" in error_of(capsys, train.main, *ARGV, "--domain", "/nowhere")
    assert "/: neither a run nor a checkpoint of one" in error_of(capsys, train.main, *ARGV, "--domain", "/")
    line = error_of(capsys, train.main, *ARGV, "--domain", "nominal", "--randomize")
    assert "--randomize and --domain nominal: give one of them" in line
    Path("domain.yaml").write_text("domain: somewhere.npz")
    line = error_of(capsys, main.main, *ARGV, *LOOP, "--cfg_env", "domain.yaml")
    assert "domain = 'somewhere.npz': main draws from its own posterior" in line
