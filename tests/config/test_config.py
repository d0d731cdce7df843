"""Layers of settings and the task files: what is given is what is set."""

import copy
import dataclasses
import pickle
from pathlib import Path

import pytest

from bayessim_mjx import config, registry
from bayessim_mjx.config import (
    Config,
    EnvConfig,
    RNDConfig,
    SymmetryConfig,
    WeightSchedule,
    from_dict,
    load,
    read_yaml,
    task_file,
    to_yaml,
)  # fmt: skip
from bayessim_mjx.errors import UserError

CFG = sorted(p.stem for p in config.cfg_folder().glob("*.yaml"))
PARAMS = "task.randomization_params"
MASS = f"{PARAMS}.actor_params.pendulum.rigid_body_properties.mass"


def task_of(stem: str) -> str:
    return "".join(part.capitalize() for part in stem.split("_"))


@pytest.mark.parametrize("stem", CFG)
def test_every_task_file_loads_and_survives_a_round_trip(stem: str, tmp_path: Path) -> None:
    task = task_of(stem)
    assert task_file(task).stem == stem
    loaded = load(task)
    file = tmp_path / "all.yaml"
    file.write_text(to_yaml(loaded.to_dict()))
    assert load(cfg_env=file) == loaded == from_dict(loaded.to_dict())


@pytest.mark.parametrize("stem", CFG)
def test_loading_changes_neither_input_nor_file(stem: str) -> None:
    raw = read_yaml(task_file(task_of(stem)))
    before, text = copy.deepcopy(raw), task_file(task_of(stem)).read_bytes()
    first, second = from_dict(raw, task_of(stem)), from_dict(raw, task_of(stem))
    assert raw == before and task_file(task_of(stem)).read_bytes() == text
    assert first == second


def test_bayessimig_keys_keep_their_names_and_values() -> None:
    b, ant = load("Pendulum").bayessim, load("Ant").bayessim
    assert (b.trainTrajs, b.trainTrajLen, b.summarizerFxn, b.collectPolicy) == (
        10000,
        20,
        "summary_start",
        "policy_random",
    )
    assert (b.components, b.fullCovariance, b.hiddenLayers, b.realTrajs, b.realEvals) == (10, True, (128, 128), 1, 100)
    assert (ant.trainTrajLen, ant.summarizerFxn, ant.collectPolicy) == (50, "summary_corrdiff", "policy_rl_randomized")
    assert len(load("Cartpole").env.realParams["means"][0]) == 13 and len(load("Ant").env.realParams["means"][0]) == 17


def test_layers_in_order(tmp_path: Path) -> None:
    (tmp_path / "e.yaml").write_text("bayessim: {components: 3, trainTrajs: 50, lr: 1e-3}\nseed: 4\n")
    (tmp_path / "t.yaml").write_text("gamma: 0.5\nlearning_rate: 1e-3\nmax_iterations: 7\n")
    c = load(
        "Pendulum",
        cfg_env=tmp_path / "e.yaml",
        cfg_train=tmp_path / "t.yaml",
        flags={"--max_iterations": ("ppo.max_iterations", 9)},
        overrides=["bayessim.trainTrajs=60", "ppo.gamma=0.25"],
    )
    assert (c.bayessim.components, c.bayessim.trainTrajs, c.bayessim.lr, c.seed) == (3, 60, 1e-3, 4)
    assert (c.ppo.gamma, c.ppo.learning_rate, c.ppo.max_iterations) == (0.25, 1e-3, 9)
    assert c.bayessim.hiddenLayers == (128, 128)  # from cfg/pendulum.yaml


def test_cfg_train_may_have_a_ppo_section_but_no_other(tmp_path: Path) -> None:
    (tmp_path / "t.yaml").write_text("ppo: {gamma: 0.5}\n")
    assert load("Ant", cfg_train=tmp_path / "t.yaml").ppo.gamma == 0.5
    (tmp_path / "t.yaml").write_text("ppo: {gamma: 0.5}\nbayessim: {lr: 1.0}\n")
    with pytest.raises(UserError, match=r"t\.yaml: bayessim beside `ppo:`"):
        load("Ant", cfg_train=tmp_path / "t.yaml")


def test_number_of_worlds_is_one_setting() -> None:
    for override in ("env.numEnvs=48", "ppo.num_envs=48"):
        c = load("Cartpole", overrides=[override])
        assert c.env.numEnvs == c.ppo.num_envs == 48
    assert load("Cartpole", overrides=["ppo.num_envs=null"]).ppo.num_envs == 512
    with pytest.raises(UserError, match=r"env\.numEnvs = 1 and ppo\.num_envs = 2 are one setting"):
        from_dict({"env": {"numEnvs": 1}, "ppo": {"num_envs": 2}}, "Ant")
    with pytest.raises(UserError, match="one setting"):
        Config(env=EnvConfig(numEnvs=3))
    both = r"env\.numEnvs and ppo\.num_envs are one setting, but .*numEnvs=4' and .*num_envs=8' give two numbers"
    with pytest.raises(UserError, match=both):
        load("Cartpole", overrides=["env.numEnvs=4", "ppo.num_envs=8"])
    assert load("Cartpole", overrides=["env.numEnvs=4", "ppo.num_envs=4"]).env.numEnvs == 4


@pytest.mark.parametrize("stem", CFG)
def test_a_task_and_its_file_say_the_same(stem: str) -> None:
    """The defaults of the task's class and of cfg/<task>.yaml: parameters, surrogate, episode and the task's own."""
    task = task_of(stem)
    bare, filed = registry.make(task), registry.make(task, config=load(task))
    assert bare.space == filed.space and len(bare.space) > 0
    (means,) = load(task).env.realParams["means"]
    assert tuple(means) == tuple(bare.real_parameters)
    assert bare.settings == filed.settings and bare.episode_length == filed.episode_length


def test_every_task_has_a_file() -> None:
    assert {task_of(stem) for stem in CFG} == set(registry.names())


def test_short_names_and_none() -> None:
    c = load(
        "Pendulum", overrides=["bayessim.collectPolicy=ones", "bayessim.modelClass=None", "bayessim.summarizerFxn=corr"]
    )
    assert (c.bayessim.collectPolicy, c.bayessim.modelClass, c.bayessim.summarizerFxn) == (
        "policy_ones",
        None,
        "summary_corr",
    )


def test_a_file_gives_the_parameters_whole_and_an_override_changes_one(tmp_path: Path) -> None:
    (tmp_path / "e.yaml").write_text(
        "task:\n  randomization_params:\n    actor_params:\n      pendulum:\n        rigid_body_properties:\n"
        "          mass: {range: [0.5, 1.5], operation: scaling}\n"
    )
    groups = load("Pendulum", cfg_env=tmp_path / "e.yaml").randomization["randomization_params"]["actor_params"][
        "pendulum"
    ]
    assert list(groups) == ["rigid_body_properties"]
    c = load("Pendulum", overrides=[f"{MASS}.range=[0.1,1.2]", f"{MASS}.distribution=loguniform"])
    groups = c.randomization["randomization_params"]["actor_params"]["pendulum"]
    assert groups["rigid_body_properties"]["mass"]["range"] == (0.1, 1.2)
    assert groups["rigid_shape_properties"]["length"]["range"] == (0.01, 2.0)


def test_real_params_by_name() -> None:
    c = load("Pendulum", overrides=["env.realParams.means=[{pendulum_mass_mult: 1.0, pendulum_length_mult: 0.7}]"])
    assert c.env.realParams["means"][0] == {"pendulum_mass_mult": 1.0, "pendulum_length_mult": 0.7}
    assert c.env.realParams["weights"] == (1.0,)


def test_a_config_is_immutable_hashable_and_picklable() -> None:
    c = load("Pendulum")
    with pytest.raises(dataclasses.FrozenInstanceError):
        c.seed = 3  # type: ignore[misc]
    with pytest.raises(TypeError, match="immutable"):
        c.randomization["randomize"] = False
    with pytest.raises(TypeError, match="immutable"):
        c.env.realParams.update(means=1)
    assert hash(c) == hash(load("Pendulum")) and pickle.loads(pickle.dumps(c)) == c == copy.deepcopy(c)
    changed = config.replace(c, ppo={"gamma": 0.9}, seed=3)
    assert (changed.ppo.gamma, changed.seed, c.seed) == (0.9, 3, 0)
    c.to_dict()["env"]["realParams"]["means"][0][0] = 99.0
    assert c == load("Pendulum")


def test_settings_of_one_task_are_typed_by_its_file() -> None:
    c = load("Cartpole", overrides=["env.resetDist=2"])
    assert c.env["resetDist"] == 2.0 and "resetDist" in c.env and c.env.get("nothing", 5) == 5
    with pytest.raises(UserError, match=r"env\.resetDist = 'far'.*expected a number"):
        load("Cartpole", overrides=["env.resetDist=far"])
    with pytest.raises(UserError, match=r"'env\.resetDist' is unknown"):
        load("Pendulum", overrides=["env.resetDist=2"])


def test_sections_within_a_section_are_off_until_one_of_their_keys_is_given() -> None:
    assert load("Pendulum").ppo.rnd is None and load("Pendulum").ppo.symmetry is None
    schedule = ["ppo.rnd.weight_schedule.mode=step", "ppo.rnd.weight_schedule.final_step=7"]
    keys = ["ppo.rnd.weight=2", *schedule, "ppo.rnd.weight_schedule.final_value=0.5", "ppo.symmetry={}"]
    config = load("Pendulum", overrides=keys)
    assert config.ppo.rnd == RNDConfig(weight=2.0, weight_schedule=WeightSchedule("step", None, 7, 0.5))
    assert config.ppo.symmetry == SymmetryConfig()
    assert from_dict(config.to_dict()) == config and hash(config.ppo) == hash(from_dict(config.to_dict()).ppo)
    assert load("Pendulum", overrides=[*keys, "ppo.rnd=null"]).ppo.rnd is None
