"""What another library's agent goes on from: also how much its scales have seen."""

import numpy as np
import pytest

from bayessim_mjx import registry, train
from bayessim_mjx.config import load
from bayessim_mjx.runs import Run, latest_run
from bayessim_mjx.wrappers import agents
from tests.wrappers.toys import Counter

NEEDED = {"sb3": "stable_baselines3", "rsl_rl": "rsl_rl", "skrl": "skrl"}
SEEN = {  # (observations that the scale of the policy has seen, their mean)
    "sb3": lambda agent: (agent.env.obs_rms.count, agent.env.obs_rms.mean),
    "rsl_rl": lambda agent: [getattr(agent.runner.alg.get_policy().obs_normalizer, k) for k in ("count", "mean")],
    "skrl": lambda agent: [
        getattr(agent.agent._observation_preprocessor, k) for k in ("current_count", "running_mean")
    ],
}


SMALL = ["env.numEnvs=8", "ppo.num_steps=8", "ppo.num_minibatches=2", "ppo.num_epochs=2", "ppo.symmetry=null"]
SMALL += ["ppo.hidden_actor=[8]", "ppo.hidden_critic=[5]"]


class Alone(Counter):
    """The counter without observations of the critic's own, which not every library takes."""

    def _state(self, *given):
        state = super()._state(*given)
        seen = {"policy": state.obs["policy"]}
        return state.replace(obs=seen, info={**state.info, "final_observation": seen})


def made(name: str, seed: int):
    settings = load("Cartpole", flags={"--agent": ("agent", name)}, overrides=[*SMALL, f"seed={seed}"])
    return agents.make(settings, Alone(), None)


@pytest.mark.parametrize("name", NEEDED)
def test_a_resumed_agents_scale_has_seen_what_it_had_seen(name, tmp_path):
    """Without it, the first observations after a resume would weigh as much as all before."""
    pytest.importorskip(NEEDED[name])
    agent = made(name, 0)
    agent.learn(2)
    agent.save(tmp_path)
    again = made(name, 7)
    again.load(tmp_path)
    (count, mean), (kept, centre) = SEEN[name](agent), SEEN[name](again)
    assert np.asarray(kept).max() == np.asarray(count).max() >= 2 * 8 * 8  # two iterations of 8 steps of 8 worlds
    np.testing.assert_array_equal(np.asarray(centre), np.asarray(mean))


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("name", ["sb3", "skrl"])
def test_a_finished_run_of_an_agent_goes_on(name, monkeypatch, tmp_path):
    """`train --resume RUN --max_iterations N`: from the networks and scales that it had finished with."""
    pytest.importorskip(NEEDED[name])
    monkeypatch.setenv("BAYESSIM_MJX_CACHE", "off")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "make", lambda name, **_: Alone())
    argv = ["--task", "Cartpole", "--agent", name, "--headless", "--max_iterations", "2", "ppo.save_interval=2"]
    argv += ["ppo.log_interval=1", "ppo.eval_episodes=4", "env.realParams=null", *SMALL]
    assert train.main(argv) == 0
    run = latest_run("logs", "Cartpole")
    loaded = []
    made = agents.make

    def watched(*given):
        agent = made(*given)
        load = agent.load
        agent.load = lambda folder: (load(folder), loaded.append((folder.name, np.max(SEEN[name](agent)[0]))))
        return agent

    monkeypatch.setattr(agents, "make", watched)
    assert train.main(["--resume", str(run.path), "--max_iterations", "3", "--headless"]) == 0
    [(folder, seen)] = loaded
    assert folder == "2" and seen >= 2 * 8 * 8
    again = Run.open(run.path)
    assert [c["step"] for c in again.checkpoints] == [2, 3] and again.config.ppo.max_iterations == 3
