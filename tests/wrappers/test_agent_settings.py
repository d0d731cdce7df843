"""Every setting of `ppo:` is read back from the agent that was made of it, or refused by its name.

A setting that is added to `PPOConfig`, or to a section in it, fails here until each library reads it back or refuses.
"""

import dataclasses
import math
import typing

import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import config
from bayessim_mjx.config import PPOConfig, RNDConfig, SymmetryConfig
from bayessim_mjx.config.settings import WeightSchedule
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import losses, rnd
from bayessim_mjx.wrappers import agents
from tests.wrappers import read_back
from tests.wrappers.toys import Mirrored, Plain

NEEDED = {"sb3": "stable_baselines3", "rsl_rl": "rsl_rl", "skrl": "skrl"}
ENVS = {"sb3": Plain(), "rsl_rl": Mirrored(), "skrl": Mirrored()}  # with observations of the critic's own, but for SB3

# what the commands do themselves with any agent (train.py), and what says nothing without a setting that is refused
ELSEWHERE = {"max_iterations", "log_interval", "save_interval", "eval_episodes", "memory_cell", "distil_loss"}

COMMON = {
    "num_envs": 6, "num_steps": 4, "num_epochs": 3, "num_minibatches": 2, "gamma": 0.9, "gae_lambda": 0.8,
    "clip_param": 0.3, "use_clipped_value_loss": False, "value_loss_coef": 1.5, "entropy_coef": 0.02,
    "learning_rate": 2e-3, "desired_kl": 0.03, "max_grad_norm": 0.7, "normalize_observations": False,
    "reward_scale": 0.2, "hidden_actor": (7, 5), "hidden_critic": (6,), "activation": "tanh", "init_std": 0.4,
}  # fmt: skip
NOVEL = RNDConfig(
    num_outputs=3, predictor_hidden_dims=(7, 7), target_hidden_dims=(5,), activation="tanh", state_normalization=True,
    reward_normalization=True, weight=2.0, learning_rate=0.05, obs_groups=("critic", "policy"),
    weight_schedule=WeightSchedule(mode="linear", initial_step=2, final_step=10, final_value=0.5),
)  # fmt: skip
DEFAULTS = PPOConfig(rnd=RNDConfig(weight=1.0, weight_schedule=WeightSchedule()), symmetry=SymmetryConfig())
# other than the defaults, which are the second case
CHANGED = {
    "sb3": COMMON | {"normalize_advantage_per_minibatch": True},
    "skrl": COMMON,
    "rsl_rl": COMMON | {
        "normalize_advantage_per_minibatch": True, "rnd": NOVEL,
        "symmetry": SymmetryConfig(use_data_augmentation=True, use_mirror_loss=True, mirror_loss_coeff=2.0),
    },
}  # fmt: skip
REFUSED = {
    "memory": 4, "policy_theta": True, "critic_theta": True, "shared_trunk": True, "segment": 2, "memory_layers": 2,
    "gradient_length": 2, "actor_groups": ("policy",), "critic_groups": ("policy",), "distribution": "beta",
    "std_type": "scalar", "std_range": (0.1, 2.0), "state_dependent_std": True, "teacher": "run",
    "precision": "bfloat16",
    "extensions": ({"extension": "x"},), "action_bound": "tanh", "action_clip": 2.0, "weight_init": "lecun_uniform",
    "symmetry": SymmetryConfig(), "rnd": RNDConfig(weight=1.0), "normalize_advantage_per_minibatch": True,
}  # fmt: skip


def settings(name, **ppo):
    """The whole configuration with these settings of `ppo:`."""
    base = config.load("Cartpole", flags={"--agent": ("agent", name)}, overrides=["ppo.symmetry=null", "env.numEnvs=6"])
    small = {"num_envs": 6, "num_steps": 4, "num_minibatches": 2}
    return dataclasses.replace(base, ppo=dataclasses.replace(PPOConfig(**small), **ppo))


READ = {"sb3": read_back.of_sb3, "rsl_rl": read_back.of_rsl_rl, "skrl": read_back.of_skrl}


def walk(section, prefix=""):
    """{path: (field's type or section, default)} of a section and all within it."""
    hints = typing.get_type_hints(section)
    for field in dataclasses.fields(section):
        yield f"{prefix}{field.name}"
        for inner in (hints[field.name], *typing.get_args(hints[field.name])):
            if dataclasses.is_dataclass(inner):
                yield from walk(inner, f"{prefix}{field.name}.")


def at(ppo, path):
    for name in path.split("."):
        ppo = getattr(ppo, name)
    return ppo


def refused(name):
    module = agents.importlib.import_module(f"bayessim_mjx.wrappers.agents.{name}")
    return set(agents.OURS) - set(module.TAKES)


def acts_alike(agent, name):
    """Our policy of its network acts as the library's own, at observations near and far."""
    from tests.wrappers.test_agents import actions

    x = np.random.default_rng(1).normal(size=(32, 3)).astype(np.float32) * 3
    np.testing.assert_allclose(agent.policy().act(None, jnp.asarray(x)), actions(agent, x), atol=2e-5)


@pytest.mark.parametrize("case", ["changed", "fixed", "default"])
@pytest.mark.parametrize("name", NEEDED)
def test_every_setting_is_read_back_from_the_agent(name, case):
    pytest.importorskip(NEEDED[name])
    changes = {"changed": CHANGED[name], "fixed": {"schedule": "fixed"}, "default": {}}[case]
    if case == "default" and name == "rsl_rl":  # sections with nothing set: on, and only logging
        changes = {"rnd": RNDConfig(weight=1.0), "symmetry": SymmetryConfig()}
    whole = settings(name, **changes)
    agent = agents.make(whole, ENVS[name], None)
    found = READ[name](agent)
    if case == "changed":
        acts_alike(agent, name)
    if name == "rsl_rl" and case == "default":
        assert found.pop("rnd.obs_groups") == ("policy",)  # what none means
        assert found.pop("rnd.predictor_hidden_dims") == found.pop("rnd.target_hidden_dims") == (3,)  # -1: as the input
    if whole.ppo.schedule == "fixed":
        found.pop("desired_kl")  # nobody looks at it
    for path, value in found.items():
        if value is not ...:
            given = at(whole.ppo, path)
            assert value == (pytest.approx(given) if isinstance(given, float) else given), path
        if case == "changed" and path != "schedule":  # else it might be the library's own
            assert at(whole.ppo, path) != at(DEFAULTS, path), path


@pytest.mark.parametrize("name", NEEDED)
def test_no_setting_is_forgotten(name):
    pytest.importorskip(NEEDED[name])
    read = set(READ[name](agents.make(settings(name, **CHANGED[name]), ENVS[name], None)))
    left = {path for path in walk(PPOConfig) if path.split(".")[0] not in refused(name) | ELSEWHERE}
    assert left == read
    assert {"rnd.weight_schedule.final_step", "symmetry.mirror_loss_coeff", "gamma"} <= set(walk(PPOConfig))


@pytest.mark.parametrize("name", NEEDED)
def test_what_is_not_taken_is_refused_by_name(name):
    pytest.importorskip(NEEDED[name])
    whole = settings(name)
    for field in sorted(refused(name)):
        ppo = object.__new__(PPOConfig)  # these go together with others, which does not matter here
        for own in dataclasses.fields(PPOConfig):
            object.__setattr__(ppo, own.name, getattr(whole.ppo, own.name))
        object.__setattr__(ppo, field, REFUSED[field])
        other = dataclasses.replace(whole, ppo=whole.ppo)
        object.__setattr__(other, "ppo", ppo)
        with pytest.raises(UserError, match=rf"ppo\.{field} = .*--agent {name} has no such thing; allowed is"):
            agents.check(other, ENVS[name])
    agents.check(whole, ENVS[name])


@pytest.mark.parametrize(
    ("name", "ppo", "words"),
    [
        (
            "rsl_rl",
            {"rnd": RNDConfig(weight=1.0, activation="gelu")},
            "ppo.rnd.activation = 'gelu': --agent rsl_rl takes elu",
        ),
        ("rsl_rl", {"rnd": RNDConfig(weight=1.0, obs_groups=("nose",))}, "ppo.rnd.obs_groups: no group 'nose'"),
        (
            "rsl_rl",
            {"rnd": RNDConfig(weight=1.0, target_hidden_dims=())},
            r"ppo.rnd.target_hidden_dims = \[\].*a hidden layer",
        ),
        ("rsl_rl", {"hidden_actor": ()}, r"ppo.hidden_actor = \[\]: --agent rsl_rl needs a hidden layer"),
        ("sb3", {"num_minibatches": 5}, "ppo.num_minibatches = 5: --agent sb3 takes a divisor of .* = 24"),
        ("sb3", {"num_minibatches": 24}, "ppo.num_minibatches = 24: .* at least two samples"),
        ("sb3", {"activation": "gelu"}, "ppo.activation = 'gelu': --agent sb3 takes elu"),
    ],
)
def test_what_one_library_cannot_do_is_refused(name, ppo, words):
    pytest.importorskip(NEEDED[name])
    with pytest.raises(UserError, match=words):
        agents.check(settings(name, **ppo), ENVS[name])


@pytest.mark.parametrize(("schedule", "factor"), [("adaptive", 1.5), ("fixed", 1.0)])
def test_the_learning_rate_of_sb3_moves_where_its_schedule_is_adaptive(schedule, factor, tmp_path):
    """Up in each iteration, as no update of the policy is nearly so large as this KL; a resumed agent goes on."""
    pytest.importorskip(NEEDED["sb3"])
    whole = settings("sb3", schedule=schedule, learning_rate=1e-4, desired_kl=100.0)
    agent = agents.make(whole, ENVS["sb3"], None)
    agent.learn(2)
    figures = agent.learn(1)
    assert figures["Loss/learning_rate"] == pytest.approx(1e-4 * factor**2)
    agent.save(tmp_path)
    again = agents.make(whole, ENVS["sb3"], None)
    again.load(tmp_path)
    assert again.rate == pytest.approx(1e-4 * factor**3)


def test_observations_of_the_critics_own_are_refused_where_they_would_be_dropped():
    pytest.importorskip(NEEDED["sb3"])
    with pytest.raises(UserError, match="--agent sb3: Mirrored has observations of its own for the critic.*skrl"):
        agents.check(settings("sb3"), Mirrored())


def test_a_symmetry_that_the_task_has_not_is_refused():
    pytest.importorskip(NEEDED["rsl_rl"])
    with pytest.raises(UserError, match="ppo.symmetry: Counter declares no mirror"):
        agents.check(settings("rsl_rl", symmetry=SymmetryConfig()), Plain())


@pytest.mark.parametrize("mode", ["constant", "step", "linear"])
def test_rsl_rls_weight_takes_the_course_that_ours_takes(mode):
    """In the reward of a control step, at steps before, in and behind the change."""
    pytest.importorskip(NEEDED["rsl_rl"])
    own = {"constant": {}, "step": {"final_step": 6, "final_value": 0.5}}
    linear = {"initial_step": 3, "final_step": 9, "final_value": 5.0}
    novel = RNDConfig(weight=2.0, weight_schedule=WeightSchedule(mode=mode, **own.get(mode, linear)))
    agent = agents.make(settings("rsl_rl", rnd=novel), ENVS["rsl_rl"], None)
    theirs = agent.runner.alg.rnd
    for step in (1, 5, 6, 7, 20):
        weight = theirs.weight_scheduler(step=step, **theirs.weight_scheduler_params)
        assert weight == pytest.approx(float(rnd.weight(novel, jnp.int32(step))) * ENVS["rsl_rl"].dt), step


def test_a_resumed_agent_goes_on_with_the_clock_of_the_weight(tmp_path):
    pytest.importorskip(NEEDED["rsl_rl"])
    whole = settings("rsl_rl", rnd=RNDConfig(weight=1.0))
    agent = agents.make(whole, ENVS["rsl_rl"], None)
    agent.learn(3)
    agent.save(tmp_path)
    again = agents.make(whole, ENVS["rsl_rl"], None)
    again.load(tmp_path)
    assert agent.runner.alg.rnd.update_counter == again.runner.alg.rnd.update_counter == 3 * whole.ppo.num_steps


def test_the_value_loss_of_all_of_them_is_a_plain_mean_of_squares():
    """So that one coefficient means the same: SB3's is `mse_loss`; ours at an error of 2."""
    ours = losses.value_loss(jnp.array([0.0]), jnp.array([0.0]), jnp.array([2.0]), None)
    assert float(ours) == 4.0
    torch = pytest.importorskip("torch")
    assert float(torch.nn.functional.mse_loss(torch.zeros(1), torch.full((1,), 2.0))) == 4.0


def test_spreads_beyond_skrls_limits_act_as_they_were_set():
    """Its default clips the logarithm at 2."""
    pytest.importorskip(NEEDED["skrl"])
    agent = agents.make(settings("skrl", init_std=math.exp(3.0)), ENVS["skrl"], None)
    obs = jnp.zeros((4000, 3))
    noise, _ = agent.agent.act(obs, jnp.zeros((4000, 6)), timestep=0, timesteps=1)
    assert float(jnp.std(noise)) == pytest.approx(math.exp(3.0), rel=0.05)
