"""Every mistake in settings is one error that names its place and what is allowed."""

import os
from pathlib import Path

import pytest

from bayessim_mjx import memory, registry
from bayessim_mjx.config import (
    PPOConfig,
    from_dict,
    load,
    to_yaml,
)  # fmt: skip
from bayessim_mjx.errors import UserError

PARAMS = "task.randomization_params"
MASS = f"{PARAMS}.actor_params.pendulum.rigid_body_properties.mass"
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


BAD = {
    "bayessim.componets=5": r"componets=5'.*mean bayessim\.components or .*Allowed: .*help settings bayessim",
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
    "ppo.rnd={}": r"ppo\.rnd\.weight = 0: novelty adds no reward; give a weight above 0, or ppo\.rnd=null",
    "ppo.symmetry.use_mirror_loss=True": r"ppo\.symmetry\.mirror_loss_coeff = 0 adds no loss; give a coefficient",
    "ppo.symmetry.use_mirror_loss=3": r"ppo\.symmetry\.use_mirror_loss = 3.*expected True or False",
    "bayessim.hiddenLayers=5": r"expected a list of whole numbers",
    "bayessim.hiddenLayers=[8,x]": r"bayessim\.hiddenLayers\[1\] = 'x'.*whole number",
    "bayessim.collectPolicy=rnd": r"allowed are policy_random, policy_ones",
    "bayessim.modelClass=MDN": r"bayessim\.modelClass = 'MDN': allowed are MDNN.*None, plain uniform randomisation$",
    "bayessim.modelClass=MDNN_x": r"bayessim\.modelClass = 'MDNN_x': allowed are MDNN, MDRFF",
    "bayessim.modelClass=MDRFF_Cosine": r"bayessim\.modelClass = .MDRFF_Cosine.: allowed are MDNN, MDRFF",
    "bayessim.coordinates=cosine": r"coordinates = 'cosine' .*allowed are plain, matched, truncated, probit, logit",
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


@pytest.mark.parametrize(
    "task", ["Pendulum", "Cartpole", "Ant", "Quadcopter", "Ingenuity", "Humanoid", "FrankaCabinet", "Anymal"]
)
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
