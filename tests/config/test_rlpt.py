"""BayesSimIG's --cfg_train: what PPO has here under another name is taken over, the others are named or refused."""

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import pytest

from bayessim_mjx.config import Config, PPOConfig, foreign, load
from bayessim_mjx.errors import UserError

FILE = """
seed: 7
clip_observations: 5.0
clip_actions: 0.9
policy: {pi_hid_sizes: [256, 128, 64], vf_hid_sizes: [96, 48], activation: selu}
learn:
  agent_name: hand
  test: False
  resume: 0
  save_interval: 20
  print_log: True
  max_iterations: 1234
  cliprange: 0.15
  ent_coef: 0.003
  nsteps: 24
  noptepochs: 9
  nminibatches: 6
  max_grad_norm: 0.7
  optim_stepsize: 7.e-4
  schedule: fixed
  desired_kl: 0.016
  gamma: 0.97
  lam: 0.93
  init_noise_std: 0.8
  log_interval: 2
  value_loss_coef: 3.0
  use_clipped_value_loss: False
"""
MEANT = {  # read by hand off the file above
    "hidden_actor": (256, 128, 64), "hidden_critic": (96, 48), "activation": "selu", "action_clip": 0.9,
    "save_interval": 20, "log_interval": 2, "max_iterations": 1234, "clip_param": 0.15, "entropy_coef": 0.003,
    "num_steps": 24, "num_epochs": 9, "num_minibatches": 6, "max_grad_norm": 0.7, "learning_rate": 7e-4,
    "schedule": "fixed", "desired_kl": 0.016, "gamma": 0.97, "gae_lambda": 0.93, "init_std": 0.8,
    "value_loss_coef": 3.0, "use_clipped_value_loss": False,
}  # fmt: skip


def loaded(folder: Path, text: str, **more: Any) -> Config:
    (folder / "f.yaml").write_text(text)
    return load("Cartpole", cfg_train=folder / "f.yaml", **more)


def test_every_setting_is_taken_over_or_named_in_one_note(tmp_path: Path) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = loaded(tmp_path, FILE)
    before = load("Cartpole")
    assert found == dataclasses.replace(before, seed=7, ppo=dataclasses.replace(before.ppo, **MEANT))
    assert all(getattr(before.ppo, key) != value for key, value in MEANT.items()), "each one is another than before"
    assert [str(w.message) for w in caught] == [
        f"{tmp_path}/f.yaml: left out, as they mean nothing here: clip_observations, learn.agent_name, learn.test, "
        "learn.resume, learn.print_log"
    ]


def test_what_the_file_does_not_say_stays_and_flags_win(tmp_path: Path) -> None:
    found = loaded(tmp_path, "learn: {gamma: 0.5}", overrides=["ppo.gamma=0.25"])
    assert found == load("Cartpole", overrides=["ppo.gamma=0.25"])
    assert loaded(tmp_path, "policy: {activation: relu}\nlearn:\n").ppo.activation == "relu"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("learn: {nstep: 3}", r"f\.yaml: key 'learn\.nstep' is unknown\. Did you mean learn\.nsteps"),
        ("policy: {pi_sizes: [3]}", r"key 'policy\.pi_sizes' is unknown"),
        ("learn: {}\nparams: {}", "key 'params' is unknown"),
        ("learn: {}\nppo: {gamma: 0.5}", "key 'ppo' is unknown"),
        ("learn: 3", "learn = 3: expected a section"),
        ("learn: {schedule: linear}", r"ppo\.schedule = 'linear' \(.*f\.yaml\): allowed are adaptive, fixed"),
        ("policy: {activation: crelu}", r"ppo\.activation = 'crelu' \(.*f\.yaml\): allowed are elu"),
        ("learn: {nsteps: 0}", r"ppo\.num_steps = 0 \(.*f\.yaml\): must be at least 1"),
    ],
)
def test_nonsense_is_refused_by_name(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=words):
        loaded(tmp_path, text)


def test_what_it_is_taken_over_to_is_there() -> None:
    ours = {f.name for f in dataclasses.fields(PPOConfig)}
    names = [name for keys in foreign.RLPT.values() for name in keys.values()]
    assert {name.removeprefix("ppo.") for name in names if name != "seed"} <= ours and len(set(names)) == len(names)
