"""Layers of settings, strictness, and the task files: every mistake is one error that names its place."""

import copy
import dataclasses
import os
import pickle
import warnings
from pathlib import Path

import mujoco
import pytest

from bayessim_mjx import config, memory, registry
from bayessim_mjx.config import (
    Config,
    EnvConfig,
    PPOConfig,
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
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import nuisance

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


TOO_MUCH = {
    "ppo.num_envs=1000000": r"num_envs = 1000000 \(env\.numEnvs\) worlds, ppo\.num_steps = 64: needs at least 3\.31 GB",
    "ppo.memory=100000": r"ppo\.memory = 100000: needs at least 360 GB",
    "ppo.hidden_actor=[9000, 100000]": r"ppo\.hidden_actor = \[9000, 100000\]: needs at least 10\.8 GB",
    "bayessim.trainTrajs=50000000": r"bayessim\.trainTrajs = 50000000: needs at least 2 GB",
    "bayessim.hiddenLayers=[20000, 20000]": r"hiddenLayers = \[20000, 20000\]: needs at least 19\.2 GB",
    "bayessim.components=100000": r"components = 100000 of each of .* 5 \* 1 posteriors: needs at least 1\.87 GB",
}


@pytest.mark.parametrize("override", TOO_MUCH)
def test_what_cannot_fit_into_memory_is_refused_with_the_least_that_it_needs(override: str, monkeypatch) -> None:
    """4 * N (60 + T 12) bytes for worlds, 12 bytes a weight (Adam), 40 a summary."""
    monkeypatch.setattr(memory, "installed", lambda: 1.5e9)
    with pytest.raises(UserError, match=TOO_MUCH[override] + r" of memory, and there are 1\.5 GB"):
        load("Pendulum", overrides=[override, "ppo.num_minibatches=1"])
    monkeypatch.setattr(memory, "installed", lambda: 1e12)
    load("Pendulum", overrides=[override, "ppo.num_minibatches=1"])


def test_memory_is_what_the_system_and_its_container_have(monkeypatch, tmp_path: Path) -> None:
    physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for content, expected in (("max\n", physical), ("1000\n", 1000.0)):
        (tmp_path / "memory.max").write_text(content)
        monkeypatch.setattr(memory, "GROUP", tmp_path / "memory.max")
        assert memory.installed() == expected


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


BAD = {
    "bayessim.componets=5": r"override 'bayessim.componets=5'.*mean bayessim\.components or .*Allowed: .*trainTrajs",
    "componets=5": r"Did you mean bayessim\.components\?",
    "pp.gamma=1": r"key 'pp' is unknown.*ppo",
    "env.numEnv=5": r"Did you mean env\.numEnvs\?",
    "ppo.gamma=abc": r"ppo\.gamma = 'abc' \(override.*expected a number",
    "ppo.gamma=1.5": r"ppo\.gamma = 1\.5 \(override.*at most 1",
    "ppo.gamma=.nan": r"ppo\.gamma = nan.*expected a number",
    "ppo.learning_rate=0": r"must be greater than 0",
    "ppo.clip_param=True": r"ppo\.clip_param = True.*expected a number",
    "ppo.num_minibatches=100000": r"ppo\.num_minibatches = 100000 is more than the batch",
    "ppo.activation=sigmod": r"ppo\.activation = 'sigmod'.*allowed are elu",
    "ppo=5": r"ppo = 5 .*expected a section",
    "ppo.rnd=5": r"ppo\.rnd = 5 .*expected a section",
    "ppo.rnd.wait=1": r"key 'ppo\.rnd\.wait' is unknown. Did you mean ppo\.rnd\.weight\?",
    "ppo.rnd.weight=-1": r"ppo\.rnd\.weight = -1\.0 \(override.*at least 0",
    "ppo.rnd.target_hidden_dims=[64, 0]": r"ppo\.rnd\.target_hidden_dims = \[64, 0\]: widths are 1 or more, or -1",
    "ppo.rnd.weight_schedule.mode=cosine": r"mode = 'cosine'.*allowed are constant, step, linear",
    "ppo.rnd.weight_schedule.mode=linear": r"weight_schedule\.initial_step is missing: mode linear needs it",
    "ppo.rnd.weight_schedule={mode: linear, initial_step: 9, final_step: 9, final_value: 0}": r"step = 9 must be",
    "ppo.symmetry.use_mirror_loss=3": r"ppo\.symmetry\.use_mirror_loss = 3.*expected True or False",
    "bayessim.hiddenLayers=5": r"expected a list of whole numbers",
    "bayessim.hiddenLayers=[8,x]": r"bayessim\.hiddenLayers\[1\] = 'x'.*whole number",
    "bayessim.collectPolicy=rnd": r"allowed are policy_random, policy_ones",
    "bayessim.modelClass=MDN": r"bayessim\.modelClass = 'MDN': allowed are MDNN.*None, plain uniform randomisation$",
    "bayessim.modelClass=MDNN_x": r"bayessim\.modelClass = 'MDNN_x': allowed are MDNN, MDRFF",
    "bayessim.modelClass=MDRFF_Cosine": r"bayessim\.modelClass = .MDRFF_Cosine.: allowed are MDNN, MDRFF",
    "bayessim.coordinates=cosine": r"coordinates = 'cosine' .*allowed are plain, truncated, probit, logit",
    "bayessim.proposal=snpe": r"proposal = 'snpe' .*allowed are prior, apt, truncated, division",
    "bayessim={proposal: apt, coordinates: logit}": r"'apt': no correction in bayessim\.coordinates = 'logit'; take",
    "bayessim.ensemble=0": r"ensemble = 0 .*at least 1",
    "bayessim.temperature=0": r"temperature = 0\.0 .*greater than 0",
    "monitor.console=False": r"'monitor\.console' is unknown",
    "monitor.tensorboard=False": r"'monitor\.tensorboard' is unknown",
    "real.logs=3": r"real\.logs = 3 .*expected a list of texts",
    "real.map=3": r"real\.map = 3 .*expected text",
    "effects=3": r"effects = 3 .*expected a list of sections",
    "effects=[3]": r"effects\[0\] = 3 .*expected a section",
    "task.randomization_params=3": r"task\.randomization_params = 3 .*expected a section",
    "bayessim.ftune=maybe": r"expected True or False",
    "seed=99999999999999999999": r"seed = 9{20} \(override.*at most 4294967295",
    "bayessim.components=1e12": r"bayessim\.components = 1000000000000 \(override.*at most 100000",
    "bayessim.trainTrajs=1e12": r"bayessim\.trainTrajs = 1000000000000 \(override.*at most 1000000000",
    "bayessim.trainTrajs=1": r"bayessim\.trainTrajs = 1 \(override.*at least 10",
    "bayessim.modelClass=MDRFF_RBF_1e999": r"MDRFF_RBF_1e999': the bandwidth 1e999 is no positive finite number",
    "bayessim.summarizerFxn=corrdiff_\u0663": r"allowed are summary_start",
    "ppo.memory=1e12": r"ppo\.memory = 1000000000000 \(override.*at most 100000",
    "ppo.num_envs=1e13": r"ppo\.num_envs = 10000000000000 \(override.*at most 1000000000",
    "ppo.init_std=.inf": r"ppo\.init_std = inf \(override.*expected a number, and a finite one",
    "real.map=/nope": r"real\.map = '/nope': there are no logs to map",
    "seed=1.5": r"seed = 1\.5 .*whole number",
    "seed=-2": r"seed = -2 .*at least 0",
    "seed=": r"seed = None .*whole number",
    "ppo.gamma": r"expected section\.key=value",
    "ppo.gamma=[1,": r"the value is not valid YAML",
    "task.randomise=True": r"Did you mean task\.randomize",
    "env.realParams.mean=[[1]]": r"Did you mean env\.realParams\.means",
    f"{MASS}.range=[3,2]": r"mass\.range = \[3\.0, 2\.0\] \(override .*low < high",
    f"{MASS}.range=[1]": r"expected \[low, high\]",
    f"{MASS}.operation=scalling": r"Did you mean scaling\?",
    MASS.replace("mass", "mas") + ".range=[0,1]": r"Did you mean task.*rigid_body_properties\.mass\?",
}


@pytest.mark.parametrize("override", BAD)
def test_a_bad_override_is_one_line_with_the_remedy(override: str) -> None:
    with pytest.raises(UserError, match=BAD[override]) as caught:
        load("Pendulum", overrides=[override])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("bayessim:\n  lr: [1\n", r"f\.yaml, line \d: not valid YAML"),
        ("bayessim: {lr: 1}\nbayessim: {lr: 2}\n", r"f\.yaml, line 2: not valid YAML.*duplicate"),
        ("\tseed: 1\n", r"f\.yaml, line 1: not valid YAML"),
        ("- 1\n- 2\n", r"f\.yaml: expected sections"),
        ("just text\n", r"f\.yaml: key 'just text' is unknown"),
        ("seed: ${nothing}\n", r"f\.yaml: \$\{nothing\}: there is no nothing in the file"),
        (
            "bayessim: {tranTrajs: 3}\n",
            r"f\.yaml: key 'bayessim\.tranTrajs' is unknown. Did you mean bayessim\.trainTrajs",
        ),
    ],
)
def test_a_bad_file_is_named_with_its_line(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "f.yaml").write_text(text)
    with pytest.raises(UserError, match=message):
        load("Pendulum", cfg_env=tmp_path / "f.yaml")


def test_missing_binary_and_folder_files(tmp_path: Path) -> None:
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe\x00\x81")
    for path in (tmp_path / "none.yaml", tmp_path / "b.yaml", tmp_path):
        with pytest.raises(UserError, match=path.name):
            load("Pendulum", cfg_env=path)


def test_a_file_of_another_task_is_refused(tmp_path: Path) -> None:
    (tmp_path / "f.yaml").write_text(to_yaml(load("Ant").to_dict()))
    with pytest.raises(UserError, match="task_name = 'Ant', but the task is 'Pendulum'"):
        load("Pendulum", cfg_env=tmp_path / "f.yaml")


def test_paths_of_the_real_side_are_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    c = load("Pendulum", overrides=["real.logs=[runs, ../b.csv]", "real.map=map.yaml"])
    assert c.real.logs == (str(tmp_path / "runs"), str(tmp_path.parent / "b.csv"))
    assert c.real.map == str(tmp_path / "map.yaml")
    assert load("Pendulum", overrides=["real.logs=runs"]).real.logs == (str(tmp_path / "runs"),)
    monkeypatch.chdir(tmp_path.parent)
    assert from_dict(c.to_dict()) == c


def test_an_override_may_add_effects_and_gravity_but_no_unknown_group() -> None:
    c = load(
        "Pendulum",
        overrides=[
            f"{PARAMS}.effects.actuator_delay.all.delay.range=[0,0.1]",
            f"{PARAMS}.effects.coulomb_friction.hinge={{}}",
            f"{PARAMS}.option.gravity={{range: [-1, 1], operation: additive}}",
        ],
    )
    section = c.randomization["randomization_params"]
    assert section["effects"] == {
        "actuator_delay": {"all": {"delay": {"range": (0, 0.1)}}},
        "coulomb_friction": {"hinge": {}},
    }
    assert section["option"]["gravity"]["range"] == (-1, 1) and "pendulum" in section["actor_params"]
    with pytest.raises(UserError, match=r"Did you mean task\.randomization_params\.effects"):
        load("Pendulum", overrides=[f"{PARAMS}.efects.actuator_delay.all.delay.range=[0,0.1]"])


@pytest.mark.parametrize("task", ["Pendulum", "Cartpole", "Ant"])
def test_a_section_as_bayessimig_writes_it_loads(task: str, tmp_path: Path) -> None:
    """It has `color` beside the groups, no frequency, and schedules that are constant."""
    section = load(task).to_dict()["task"]
    section["randomization_params"].pop("frequency")
    (actor,) = section["randomization_params"]["actor_params"].values()
    actor["color"] = True
    (tmp_path / "f.yaml").write_text(to_yaml({"task": section}))
    with pytest.warns(UserWarning, match="mean nothing here: color$"):
        from_file = load(task, cfg_env=tmp_path / "f.yaml")
    assert registry.make(task, config=from_file).space == registry.make(task).space


def test_limits_hold_without_files_too() -> None:
    with pytest.raises(UserError, match=r"ppo\.gamma = 2\.0: must be at most 1"):
        PPOConfig(gamma=2.0)
    with pytest.raises(UserError, match=r"ppo\.hidden_actor\[0\] = 'a'"):
        PPOConfig(hidden_actor=("a",))  # type: ignore[arg-type]


def test_sections_within_a_section_are_off_until_one_of_their_keys_is_given() -> None:
    assert load("Pendulum").ppo.rnd is None and load("Pendulum").ppo.symmetry is None
    schedule = ["ppo.rnd.weight_schedule.mode=step", "ppo.rnd.weight_schedule.final_step=7"]
    keys = ["ppo.rnd.weight=2", *schedule, "ppo.rnd.weight_schedule.final_value=0.5", "ppo.symmetry={}"]
    config = load("Pendulum", overrides=keys)
    assert config.ppo.rnd == RNDConfig(weight=2.0, weight_schedule=WeightSchedule("step", None, 7, 0.5))
    assert config.ppo.symmetry == SymmetryConfig()
    assert from_dict(config.to_dict()) == config and hash(config.ppo) == hash(from_dict(config.to_dict()).ppo)
    assert load("Pendulum", overrides=[*keys, "ppo.rnd=null"]).ppo.rnd is None


ISAAC = {  # as BayesSimIG's files are made: other simulators' keys beside those that count here
    "Humanoid": """
env: {numEnvs: 4096, envSpacing: 5, episodeLength: 1000, isFlagrun: False, powerScale: 1.0, upWeight: 0.1,
  realParams: {weights: [1.0], means: [[1.9, 0.2]], stds: [[0.001, 0.001]]},
  asset: {assetRoot: somewhere, assetFileName: humanoid.xml}, plane: {staticFriction: 1.0, restitution: 0.0}}
sim: {substeps: 2, physx: {num_threads: 4, solver_type: 1, contact_offset: 0.02}, flex: {warm_start: 0.25}}
bayessim: {trainTrajs: 10000, collectPolicy: policy_random, summarizerFxn: summary_start, trainTrajLen: 10, ftune: True,
  modelClass: MDNN, components: 10, hiddenLayers: [128, 128], lr: 1.e-4, realEvals: 100, realTrajs: 1, realIters: 100,
  ftuneRL: False}
task:
  randomize: True
  randomization_params:
    actions: {range: [0., 0.1], operation: additive, distribution: gaussian, schedule: constant, schedule_steps: 0}
    actor_params:
      torso:
        color: True
        rigid_body_properties:
          mass: {range: [0.1, 2.0], operation: scaling, distribution: uniform, schedule: constant, schedule_steps: 0}
        dof_properties:
          stiffness: {range: [0.0, 10.0], operation: additive, distribution: uniform, schedule: constant}
""",
    "ShadowHand": """
env: {numEnvs: 1024, envSpacing: 0.75, maxEpisodeLength: 600, aggregateMode: 1, objectType: block, rotEps: 0.1,
  realParams: {weights: [1.0], means: [[1.8]], stds: [[0.001]]}, asset: {assetFileName: hand.xml}}
sim: {substeps: 2, physx: {num_threads: 4}}
bayessim: {trainTrajs: 50000, components: 4, lr: 1.e-4}
task:
  randomize: True
  randomization_params:
    observations: {range: [0, .002], range_correlated: [0, .001], operation: additive, distribution: gaussian,
      schedule: linear, schedule_steps: 40000}
    actions: {range: [0., .05], range_correlated: [0, .015], operation: additive, distribution: gaussian,
      schedule: linear, schedule_steps: 40000}
    sim_params:
      gravity: {range: [0, 0.4], operation: additive, distribution: gaussian, schedule: linear, schedule_steps: 40000}
    frequency: 720
    actor_params:
      torso:
        color: True
        rigid_body_properties:
          mass: {range: [0.1, 10], operation: scaling, distribution: uniform, schedule: constant, schedule_steps: 0}
        rigid_shape_properties:
          friction: {num_buckets: 250, range: [0.7, 1.3], operation: scaling, distribution: uniform, setup_only: True}
""",
    "Pendulum": """
env: {numEnvs: 100, episodeLength: 200, realParams: {weights: [1.0], means: [[1.0, 0.5]], stds: [[1.0e-5, 1.0e-5]]}}
rkhsnet: {enable: True, nFeat: 100}
bayessim: {trainTrajs: 10000, summarizerFxn: summary_start, realIters: 20, lr: 1.e-4}
task:
  randomize: True
  randomization_params:
    actor_params:
      pendulum:
        rigid_body_properties: {mass: {range: [0.01, 2.0], operation: scaling, schedule: constant}}
        rigid_shape_properties: {length: {range: [0.01, 2.0], operation: scaling, distribution: uniform}}
""",
}
LEFT_OUT = {
    "Humanoid": "sim, env.envSpacing, env.isFlagrun, env.powerScale, env.upWeight, env.asset, env.plane, color",
    "ShadowHand": "sim, env.envSpacing, env.aggregateMode, env.objectType, env.rotEps, env.asset, color, num_buckets, "
    "setup_only",
    "Pendulum": "rkhsnet",
}
BODY = """<mujoco model="hand"><worldbody><body name="torso"><freejoint/><geom name="palm" size=".1"/><body name="arm">
<joint name="elbow" axis="0 1 0"/><geom size=".05" pos=".1 0 0"/></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("task", ISAAC)
def test_files_made_like_bayessimigs_load_whole_with_one_note(task: str, tmp_path: Path) -> None:
    (tmp_path / "f.yaml").write_text(ISAAC[task])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        loaded = load(task, cfg_env=tmp_path / "f.yaml")
    assert [str(w.message).partition("nothing here: ")[2] for w in caught] == [LEFT_OUT[task]]
    assert str(caught[0].message).startswith(f"{tmp_path}/f.yaml: ")
    section = loaded.to_dict()["task"]
    if task == "Pendulum":
        assert registry.make(task, config=loaded).space.names == ("pendulum_mass_mult", "pendulum_length_mult")
        return
    model = mujoco.MjModel.from_xml_string(BODY)
    space = ParameterSpace.from_config(section, model)
    found = nuisance.read(section["randomization_params"], space)
    assert space.names[:2] == ("torso_mass_mult", "arm_mass_mult") and found is not None
    spread = found.actions.white
    if task == "Humanoid":
        assert space.names[2:] == ("elbow_stiffness",) and loaded.env.episodeLength == 1000
        assert (spread.first, spread.second, found.observations, found.frequency) == (0.0, 0.1, None, 1)
    else:
        assert loaded.env.episodeLength == 600 and found.frequency == 720 and found.gravity.white.second == 0.4
        assert (found.observations.lasting.second, found.actions.schedule.steps) == (0.001, 40000)
    assert from_dict(loaded.to_dict()) == loaded


def test_names_of_one_length_agree_and_slips_are_still_refused(tmp_path: Path) -> None:
    assert load("Pendulum", overrides=["env.maxEpisodeLength=30"]).env.episodeLength == 30
    (tmp_path / "f.yaml").write_text("env: {episodeLength: 3, maxEpisodeLength: 4}\n")
    with pytest.raises(UserError, match=r"env\.episodeLength = 3 and env\.maxEpisodeLength = 4 are one setting"):
        load("Pendulum", cfg_env=tmp_path / "f.yaml")
    for text, word in (("env: {envSpacin: 1}", "env.envSpacin"), ("simm: {}", "simm")):
        (tmp_path / "f.yaml").write_text(text)
        with pytest.raises(UserError, match=f"key '{word}' is unknown"):
            load("Pendulum", cfg_env=tmp_path / "f.yaml")
    assert load("Cartpole", overrides=["env.resetDist=2"]).env["resetDist"] == 2.0  # the task has it
