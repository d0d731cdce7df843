"""Extensions of PPO: one of a user's own from reward to checkpoint, how it is found, and what is refused."""

import dataclasses
import importlib.metadata
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig, RNDConfig, from_dict
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import catalogue, losses, networks
from bayessim_mjx.rl.extension import Extension, Learner
from bayessim_mjx.rl.train import _make_chunk, tags
from tests.rl import probes

CONFIG = PPOConfig(
    num_envs=16, num_steps=8, num_epochs=1, num_minibatches=1, hidden_actor=(4,), hidden_critic=(4,), log_interval=2
)


@dataclasses.dataclass(frozen=True)
class Quiet(Extension):
    """Small actions are rewarded, and large means cost something in the loss; it counts the steps that it saw."""

    weight: float = 1.0
    name: ClassVar[str] = "quiet"
    means = ("Loss/quiet",)
    latest = ("Quiet/steps", "Quiet/reward")

    def init(self, key, sizes, config):
        return {"steps": jnp.int32(0), "reward": jnp.zeros_like(sizes.partial)}

    def reward(self, own, data, key, learner):
        bonus = -self.weight * (data["extras"]["action"] ** 2).sum(-1)
        return {"steps": own["steps"] + len(bonus), "reward": own["reward"] + bonus.sum(0)}, bonus, {}

    def attach(self, state, data, normalizer, log_prob, learner):
        return data["extras"]["action"] ** 2

    def loss(self, params, batch, means, learner):
        assert batch.extra["quiet"].shape == batch.action.shape
        value = (means**2).mean()
        return self.weight * value, {"Loss/quiet": value}

    def metrics(self, own, figures, learner):
        return {"Quiet/steps": own["steps"], "Quiet/reward": own["reward"].sum()}


class Still(probes.TimeLimit):
    """No reward of its own, for ever: returns are what an extension adds."""

    episode_length = 50

    def reward(self, obs, action, steps):
        return jnp.zeros(())


STILL = Still()


def key(seed):
    return jax.random.PRNGKey(seed)


def names_of(tree: Any) -> list[str]:
    flat = jax.tree_util.tree_flatten_with_path(tree)[0]
    return [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in flat]


def test_an_own_extension_goes_from_reward_to_checkpoint(monkeypatch):
    """At discount 0 the returns are the extension's reward alone; its state goes on, and its tags are shown."""
    config = dataclasses.replace(CONFIG, gamma=0.0, extensions=(Quiet(0.5),))
    optimise = losses.optimise

    def caught(key, params, opt_state, rate, batch, learner):
        *after, figures = optimise(key, params, opt_state, rate, batch, learner)
        return *after, figures | {"Loss/value": jnp.abs(batch.returns + 0.5 * batch.action[:, 0] ** 2)}

    monkeypatch.setattr(losses, "optimise", caught)
    state, metrics = rl.run(STILL, config, rl.init(STILL, config, key(0)), iterations=2)
    assert metrics["Loss/value"] < 1e-5 and metrics["Train/mean_reward"] != metrics["Train/mean_reward"]  # none ended
    assert metrics["Quiet/steps"] == state.extensions["quiet"]["steps"] == 2 * 8
    assert metrics["Quiet/reward"] == pytest.approx(float(state.extensions["quiet"]["reward"].sum()), rel=1e-6)
    assert metrics["Loss/quiet"] > 0 and set(tags(config)) - set(tags(CONFIG)) == {*Quiet.means, *Quiet.latest}
    assert names_of(state)[-2:] == ["quiet.reward", "quiet.steps"]


def test_a_term_of_the_loss_is_added_and_figures_are_shown():
    @jax.jit
    def both(key, x):
        params = networks.init(key, networks.Sizes(2, 2, 2), CONFIG)
        zeros, mean = jnp.zeros(6), networks.mean_action(params, x, jax.nn.elu)
        batch = losses.Batch(x, x, mean, mean, zeros, zeros, zeros, zeros, extra={"quiet": mean})
        log_std = params["actor"]["log_std"]
        learners = (Learner(None, CONFIG, extensions) for extensions in ((), (Quiet(3.0), Quiet(2.0))))
        return *(losses.loss(params, log_std, batch, learner) for learner in learners), (mean**2).mean()

    (alone, _), (total, figures), size = both(key(0), 10 * jnp.arange(12.0).reshape(6, 2))
    assert size > 1e-3 and figures["Loss/quiet"] == pytest.approx(float(size), rel=1e-6)
    assert total - alone == pytest.approx(5 * float(size), rel=1e-3)


def test_states_lie_in_checkpoints_under_their_own_names():
    """As they did before extensions were told from the learner: older checkpoints stay readable."""
    env = probes.Walk()
    env.dt = 1.0
    config = dataclasses.replace(CONFIG, rnd=RNDConfig(weight=1.0), extensions=(Quiet(),))
    names = names_of(jax.eval_shape(lambda: rl.init(env, config, key(0))))
    parts = list(dict.fromkeys(name.partition(".")[0] for name in names))
    assert parts == [
        "params", "opt_state", "normalizer", "learning_rate", "env_states", "episodes", "key", "iteration",
        "env_steps", "quiet", "rnd",
    ]  # fmt: skip
    assert {"rnd.target.0.w", "rnd.predictor.0.b", "rnd.states.mean", "rnd.episodes.partial", "rnd.steps"} <= {*names}


def test_tags_that_were_not_announced_are_refused():
    class Chatty(Quiet):
        latest = ()

    config = dataclasses.replace(CONFIG, extensions=(Chatty(),))
    state = jax.eval_shape(lambda: rl.init(STILL, config, key(0)))
    with pytest.raises(UserError, match=r"Quiet/reward, Quiet/steps: the tags .* `means` and `latest` announce"):
        jax.eval_shape(_make_chunk(STILL, config), state, (None,), np.int32(1))


def installed(monkeypatch, **points):
    found = [importlib.metadata.EntryPoint(k, v, catalogue.ENTRY_POINTS) for k, v in points.items()]
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: found)


def test_installed_extensions_are_found_by_entry_point(monkeypatch):
    installed(monkeypatch, quiet=f"{__name__}:Quiet", nothing="no_such_package:X", number="math:pi")
    config = from_dict({"ppo": {"extensions": [{"extension": "quiet", "weight": 2.0}]}}, "Pendulum")
    assert catalogue.active(config.ppo) == (Quiet(2.0),)
    as_object = dataclasses.replace(CONFIG, extensions=(Quiet(2.0),))
    assert as_object.to_dict()["extensions"] == config.to_dict()["ppo"]["extensions"]
    for given, words in (
        ({"extension": "loud"}, "no extension 'loud'; installed are: nothing, number, quiet"),
        ({"extension": "quiet", "wait": 1}, "'quiet' has no setting 'wait'; allowed are weight"),
        ({"extension": "nothing"}, "'nothing': its package cannot be imported: No module named"),
        ({"extension": "number"}, r"'number' is 3.14.*: expected a class with @dataclass\(frozen=True\)"),
    ):
        with pytest.raises(UserError, match=words):
            catalogue.active(dataclasses.replace(CONFIG, extensions=(given,)))


def named(name: Any, **more: Any) -> Extension:
    return dataclasses.dataclass(frozen=True)(type("Own", (Extension,), {"name": name, **more}))()


@pytest.mark.parametrize(
    "own, words",
    [
        ((Quiet(1.0), Quiet(2.0)), "'quiet' is there twice"),
        ((named("params"),), "Own.name = 'params': expected a word that is not one of params, opt_state"),
        ((named("two words"),), "Own.name = 'two words': expected a word"),
        ((named("rnd"),), "Own.name = 'rnd': there is one already"),
        ((Learner(None, CONFIG),), "is no object of a subclass of bayessim_mjx.rl.Extension"),
        ((named("own", incompatible_with={"gamma": "rewards must not be discounted"}),), "ppo.gamma = 0.99: rewards"),
        ((named("own", incompatible_with={"quiet": "it is loud"}), Quiet()), "'own' with 'quiet': it is loud"),
    ],
)
def test_what_does_not_keep_the_contract_is_refused(own, words):
    with pytest.raises(UserError, match=words):
        catalogue.active(dataclasses.replace(CONFIG, extensions=own))


@pytest.mark.parametrize(
    "settings, words",
    [
        ({"extensions": ["quiet"]}, "ppo.extensions: 'quiet': expected {extension: NAME"),
        ({"extensions": [{"name": "quiet"}]}, "expected {extension: NAME"),
        ({"extensions": (Quiet(),), "teacher": "somewhere"}, "a student has no use for ppo.extensions"),
        ({"symmetry": {}, "teacher": "somewhere"}, "ppo.teacher = .*: a student has no use for ppo.symmetry"),
        ({"symmetry": {}, "critic_theta": True}, "ppo.critic_theta = True: theta has no mirror image"),
        ({"symmetry": {}, "policy_theta": True}, "ppo.policy_theta = True: theta has no mirror image"),
        ({"symmetry": {}, "memory": 4}, "ppo.memory = 4: not with ppo.symmetry"),
    ],
)
def test_settings_that_do_not_go_together_are_refused_when_they_are_read(settings, words):
    with pytest.raises(UserError, match=words):
        dataclasses.replace(CONFIG, **settings)
