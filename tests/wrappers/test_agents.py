"""Other libraries' PPO as agents of `train`: their networks as our policies, saved and taken up again."""

import importlib.util
import os
import signal
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import play, registry, train
from bayessim_mjx.config import load, replace
from bayessim_mjx.errors import UserError
from bayessim_mjx.monitor.writers import read
from bayessim_mjx.runs import Run, latest_run
from bayessim_mjx.wrappers import agents
from bayessim_mjx.wrappers.agents import shared
from tests.wrappers.toys import Counter, Plain

ENVS = {"sb3": Plain(), "rsl_rl": Counter(), "skrl": Counter()}  # both networks of SB3 see the same
NEEDED = {"sb3": "stable_baselines3", "rsl_rl": "rsl_rl", "skrl": "skrl"}
TINY = [
    "env.numEnvs=8", "ppo.num_envs=8", "ppo.num_steps=8", "ppo.num_minibatches=2", "ppo.num_epochs=2",
    "ppo.hidden_actor=[8,6]", "ppo.hidden_critic=[5]", "ppo.init_std=0.5", "ppo.symmetry=null",
]  # fmt: skip


def settings(agent, *more):
    return load("Cartpole", flags={"--agent": ("agent", agent)}, overrides=[*TINY, *more])


def actions(agent, x):
    """What the library itself does at observations x, without noise."""
    if agent.__class__.__name__ == "SB3Agent":
        seen = agent.env.normalize_obs(x) if hasattr(agent.env, "obs_rms") else x
        return agent.model.predict(seen, deterministic=True)[0]
    if agent.__class__.__name__ == "RslRlAgent":
        import torch
        from tensordict import TensorDict

        runner = agent.runner
        runner.alg.eval_mode()
        with torch.no_grad():
            seen = TensorDict({"policy": torch.from_numpy(x), "critic": torch.zeros(len(x), 6)}, batch_size=len(x))
            return runner.alg.get_policy()(seen).clamp(-1, 1).numpy()
    agent.agent.enable_training_mode(False)
    states = jnp.zeros((len(x), 6)) if agent.env.state_space else None
    return np.clip(agent.agent.act(jnp.asarray(x), states, timestep=0, timesteps=1)[1]["mean_actions"], -1, 1)


@pytest.mark.parametrize("name", NEEDED)
def test_a_policy_of_ours_acts_as_the_librarys_network(name, tmp_path):
    pytest.importorskip(NEEDED[name])
    agent = agents.make(settings(name), ENVS[name], None)
    found = agent.learn(2)
    assert agent.iteration == 2 and found["Train/mean_episode_length"] == 5.0
    assert found["Train/mean_reward"] == pytest.approx(5.0, abs=2.5)  # 1 + the action in each of 5 steps
    assert found["Loss/value"] > 0 and np.isfinite(found["Loss/surrogate"])
    x = (np.array([2.0, 0.5, 9.0]) + np.random.default_rng(0).normal(size=(64, 3)) * [1, 0.2, 0]).astype(np.float32)
    ours = agent.policy()
    np.testing.assert_allclose(ours.act(None, jnp.asarray(x)), actions(agent, x), atol=2e-5)
    assert ours.actor["log_std"].shape == (1,) and abs(float(ours.actor["log_std"][0]) - np.log(0.5)) < 0.1
    again = agents.make(settings(name, "seed=7"), ENVS[name], None)
    before = np.asarray(again.policy().act(None, jnp.asarray(x)))
    agent.save(tmp_path)
    again.load(tmp_path)
    after = np.asarray(again.policy().act(None, jnp.asarray(x)))
    np.testing.assert_array_equal(after, ours.act(None, jnp.asarray(x)))
    assert (after != before).any()
    assert np.isfinite(again.learn(1)["Train/mean_reward"])


def test_a_network_by_hand():
    """elu(x W + b) v with observations (x - 1) / 2."""
    config = settings("sb3").ppo
    layers = [(np.array([[2.0]]), np.array([1.0])), (np.array([[0.1]]), np.array([0.0]))]
    policy = shared.policy_of(layers, np.array([-1.0]), config, mean=[1.0], scale=[2.0])
    np.testing.assert_allclose(policy.act(None, jnp.array([[3.0]])), [[0.3]], rtol=1e-5)
    np.testing.assert_allclose(policy.act(None, jnp.array([[-1.0]])), [[0.1 * np.expm1(-1)]], rtol=1e-4)
    plain = shared.policy_of(layers, np.array([-1.0]), config)
    np.testing.assert_allclose(plain.act(None, jnp.array([[3.0]])), [[0.7]], rtol=1e-5)


@pytest.mark.parametrize(
    ("agent", "takes", "override", "words"),
    [
        ("sb3", (), "ppo.memory=4", r"ppo.memory = 4: --agent sb3 has no such thing; allowed is 0"),
        ("skrl", (), "ppo.rnd={weight: 0.5}", r"ppo.rnd = .*: --agent skrl has no such thing; allowed is None"),
        ("rsl_rl", ("rnd", "symmetry"), "ppo.action_bound=tanh", "ppo.action_bound = 'tanh'.*allowed is 'clip'"),
        ("skrl", (), "ppo.weight_init=lecun_uniform", "ppo.weight_init = .lecun_uniform.*is .orthogonal."),
        ("sb3", (), "devices=2", "devices = '2': --agent sb3 trains on one device"),
        ("skrl", (), "ppo.activation=gelu", "ppo.activation = 'gelu': --agent skrl takes elu, relu, tanh"),
        ("sb3", (), "bayessim.policyCheckpt=logs", "--checkpoint: --agent sb3 begins with a policy of its own"),
    ],
)
def test_what_a_library_has_not_is_refused_by_name(agent, takes, override, words):
    activations = ("elu", "relu", "tanh")
    with pytest.raises(UserError, match=words):
        agents.refuse(settings(agent, override), takes, activations)
    agents.refuse(settings(agent), takes, activations)


def test_main_trains_with_our_own_ppo_alone(capsys):
    from bayessim_mjx.main import main

    assert main(["--task", "Cartpole", "agent=sb3"]) == 2
    assert "bayessim-mjx train --agent" in capsys.readouterr().err


def test_an_agent_that_is_not_there_is_named():
    with pytest.raises(UserError, match="own, sb3, rsl_rl, skrl"):
        replace(settings("sb3"), agent="rllib")


@pytest.fixture
def counters(monkeypatch, tmp_path):
    """Every task is the counter without a critic's group; runs lie in a folder of their own."""
    monkeypatch.setenv("BAYESSIM_MJX_CACHE", "off")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "make", lambda name, **_: ENVS["sb3"])


SHORT = ["--headless", "--max_iterations", "4", "ppo.save_interval=2", "ppo.log_interval=1", "ppo.eval_episodes=4"]


@pytest.mark.parametrize("name", NEEDED)
def test_a_stopped_run_of_train_goes_on_with_the_same_networks(name, counters, monkeypatch, capsys):
    """The second half is trained from the first half's networks, optimizer and scales; `play` knows the result."""
    pytest.importorskip(NEEDED[name])
    argv = ["--task", "Cartpole", "--agent", name, "--logger", "csv", *SHORT, *TINY[:-1], "env.realParams=null"]
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        evaluate = train.AgentTraining.evaluate

        def killed(self, state):
            if state.iteration == 4:
                raise KeyboardInterrupt
            return evaluate(self, state)

        patch.setattr(train.AgentTraining, "evaluate", killed)
        train._train(argv)  # as `main`, but for the exit code
    run = latest_run("logs", "Cartpole")
    assert run.manifest["latest"] == 2 and [p.name for p in (run.path / "agent").iterdir()] == ["2"]
    loaded = []
    with monkeypatch.context() as patch:
        made = agents.make

        def watched(*given):
            agent = made(*given)
            load = agent.load
            agent.load = lambda folder: (load(folder), loaded.append(agent.policy()))
            return agent

        patch.setattr(agents, "make", watched)
        assert train.main(["--resume", str(run.path), "--headless"]) == 0
    x = jnp.array([[2.0, 0.5, 9.0]])
    before = run.restore(2, {"policy": loaded[0]})[0]["policy"]
    np.testing.assert_array_equal(loaded[0].act(None, x), before.act(None, x))
    resumed = Run.open(run.path)
    assert resumed.manifest["status"] == "finished" and [c["step"] for c in resumed.checkpoints] == [2, 4]
    assert resumed.restore(4, {"policy": before})[0]["policy"].act(None, x) != before.act(None, x)
    steps = [row["step"] for row in read(run.path / "scalars.csv") if row["tag"] == "Train/mean_reward"]
    assert steps == [1, 2, 3, 4]
    assert play.main(["--checkpoint", str(run.path), "--episodes", "4", "--physics", "nominal", "--headless"]) == 0
    assert "return" in capsys.readouterr().out


def test_what_cannot_train_leaves_no_run_folder(counters, monkeypatch, capsys):
    """A library that is not installed, and a setting that it has not."""
    monkeypatch.setitem(sys.modules, "bayessim_mjx.wrappers.agents.sb3", None)
    assert train.main(["--task", "Cartpole", "--agent", "sb3", "--headless"]) != 0
    if importlib.util.find_spec("skrl"):
        assert train.main(["--task", "Cartpole", "--agent", "skrl", "ppo.memory=4", "--headless"]) == 2
        assert "ppo.memory = 4: --agent skrl has no such thing" in capsys.readouterr().err
    assert not Path("logs").exists()


class Steady:
    """An agent without a library: its policy always gives 0, and its file says how often it was saved."""

    def __init__(self, at=None):
        self.iteration, self.saves, self.loaded, self.at = 0, 0, None, at or {}

    def learn(self, iterations):
        self.iteration += iterations
        self.at.get(self.iteration, lambda: None)()
        return {"Train/mean_reward": 5.0, "Train/mean_episode_length": 5.0, "Loss/value": 1.0}

    def policy(self):
        layers = [(np.zeros((3, 2)), np.zeros(2)), (np.zeros((2, 1)), np.zeros(1))]
        return shared.policy_of(layers, np.zeros(1), settings("sb3").ppo)

    def save(self, folder):
        self.saves += 1
        (folder / "first").write_text(str(self.saves))
        self.at.get(f"save {self.saves}", lambda: None)()
        (folder / "second").write_text(str(self.saves))

    def load(self, folder):
        self.loaded = [(folder / name).read_text() for name in ("first", "second")]


def steady(monkeypatch, agent):
    monkeypatch.setattr(agents, "check", lambda config, env: None)
    monkeypatch.setattr(agents, "make", lambda config, env, domain: agent)
    return agent


STEADY = ["--task", "Cartpole", "--agent", "sb3", "--logger", "csv", *SHORT, *TINY[:-1], "env.realParams=null"]


def test_a_checkpoint_of_ctrl_c_is_evaluated_when_the_run_goes_on(counters, monkeypatch):
    """It lies where one is due: without an evaluation it could never become the best."""
    steady(monkeypatch, Steady({2: lambda: os.kill(os.getpid(), signal.SIGINT)}))
    assert train.main(STEADY) == 130
    run = latest_run("logs", "Cartpole")
    assert [(c["step"], c["kind"]) for c in run.checkpoints] == [(2, "periodic")]
    agent = steady(monkeypatch, Steady())
    assert train.main(["--resume", str(run.path), "--headless"]) == 0
    assert agent.loaded is not None
    found = {(c["step"], c["kind"]) for c in Run.open(run.path).checkpoints}
    assert {(2, "evaluated"), (4, "evaluated")} <= found


def gone():
    raise KeyboardInterrupt


@pytest.mark.parametrize("moment", ["while files are written", "between two versions"])
def test_a_kill_at_any_moment_leaves_a_whole_checkpoint(moment, counters, monkeypatch):
    """The same step is saved twice, by Ctrl-C and after its evaluation; the second time ends in a kill."""
    steady(monkeypatch, Steady({2: lambda: os.kill(os.getpid(), signal.SIGINT)}))
    assert train.main(STEADY) == 130
    run = latest_run("logs", "Cartpole")
    with monkeypatch.context() as patch:
        if moment == "between two versions":
            rename = Path.rename
            patch.setattr(Path, "rename", lambda own, to: gone() if own.suffix == ".new" else rename(own, to))
            steady(monkeypatch, Steady())
        else:
            steady(monkeypatch, Steady({"save 1": gone}))
        assert train.main(["--resume", str(run.path), "--headless"]) == 130
    agent = steady(monkeypatch, Steady())
    assert train.main(["--resume", str(run.path), "--headless"]) == 0
    assert agent.loaded == ["1", "1"]
    assert sorted(p.name for p in (run.path / "agent").iterdir()) == ["2", "4"]
