"""What another library's agent goes on from: also how much its scales have seen."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from toys import Counter  # noqa: E402

from bayessim_mjx.config import load  # noqa: E402
from bayessim_mjx.wrappers import agents  # noqa: E402

NEEDED = {"sb3": "stable_baselines3", "rsl_rl": "rsl_rl", "skrl": "skrl"}
SEEN = {  # (observations that the scale of the policy has seen, their mean)
    "sb3": lambda agent: (agent.env.obs_rms.count, agent.env.obs_rms.mean),
    "rsl_rl": lambda agent: [getattr(agent.runner.alg.get_policy().obs_normalizer, k) for k in ("count", "mean")],
    "skrl": lambda agent: [
        getattr(agent.agent._observation_preprocessor, k) for k in ("current_count", "running_mean")
    ],
}


def made(name: str, seed: int):
    overrides = ["env.numEnvs=8", "ppo.num_steps=8", "ppo.num_minibatches=2", "ppo.num_epochs=2", f"seed={seed}"]
    overrides += ["ppo.hidden_actor=[8]", "ppo.hidden_critic=[5]", "ppo.symmetry=null"]
    return agents.make(load("Cartpole", flags={"--agent": ("agent", name)}, overrides=overrides), Counter(), None)


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
    assert np.max(kept) == np.max(count) >= 2 * 8 * 8  # two iterations of 8 steps of 8 worlds
    np.testing.assert_array_equal(np.asarray(centre), np.asarray(mean))
