"""A folder for a model hub: its files say the same as the policy and its settings."""

import jax
import numpy as np
import pytest

from bayessim_mjx import config, registry
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import export, hub, pretrained

pytest.importorskip("onnx", reason="the extra [export] is not installed")
runtime = pytest.importorskip("onnxruntime", reason="the extra [export] is not installed")
COMMAND = "python -m bayessim_mjx.train --task Pendulum"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """(folder, policy, settings)"""
    settings = config.load("Pendulum", overrides=["logdir=/home/somebody/logs", "ppo.gamma=0.9"])
    policy, folder = pretrained.pretrained("Pendulum"), tmp_path_factory.mktemp("hub") / "pendulum"
    returns = {"nominal physics": np.array([-100.0, -200.0])}
    assert hub.write(folder, policy, registry.make("Pendulum"), settings, returns, COMMAND) < 2e-6
    return folder, policy, settings


def test_the_folder_is_whole_and_its_settings_are_read_again(made):
    folder, _, settings = made
    assert sorted(path.name for path in folder.iterdir()) == sorted(hub.OWN)
    read = config.load(cfg_env=folder / "config.yaml")
    assert read.ppo == settings.ppo and read.task == "Pendulum"
    assert "somebody" not in (folder / "config.yaml").read_text()


def test_the_card_has_metadata_and_returns(made):
    folder = made[0]
    _, metadata, text = (folder / "README.md").read_text().split("---\n", 2)
    (folder.parent / "metadata.yaml").write_text(metadata)
    index = config.read_yaml(folder.parent / "metadata.yaml")["model-index"]
    assert index[0]["results"][0]["metrics"][0]["value"] == -150.0
    assert "| nominal physics | -150 ± 50 |" in text and COMMAND in text and "over 2 episodes" in text


def test_the_code_on_the_card_runs(made, monkeypatch):
    folder, policy, _ = made
    monkeypatch.chdir(folder)
    found = {}
    exec((folder / "README.md").read_text().split("```python\n")[1].split("```")[0], found)
    zero = {name: 0 * value for name, value in export.golden_inputs(policy, registry.make("Pendulum"), 1).items()}
    np.testing.assert_allclose(found["action"], jax.device_get(export.answer(policy, zero)), atol=2e-6)


def test_nothing_is_overwritten(made):
    folder, policy, settings = made
    with pytest.raises(UserError, match=r"--hub .*: policy.onnx, config.yaml, README.md there already"):
        hub.write(folder, policy, registry.make("Pendulum"), settings, {})


def test_the_card_has_no_folder_of_this_machine():
    policy, env = pretrained.pretrained("Pendulum"), registry.make("Pendulum")
    command = "train --task /home/ann/robots/acro.py:Acro cfg=/data/a.yaml ppo.gamma=0.9 rel/b.yaml"
    card = hub.card(policy, env, "Pendulum", {"nominal physics": np.zeros(2)}, command)
    assert "train --task acro.py:Acro cfg=a.yaml ppo.gamma=0.9 rel/b.yaml" in card
