"""Worlds shared by devices and processes: the same curve for any number of them, checkpoints of none in particular."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from bayessim_mjx import device, rl
from bayessim_mjx.config import Config, PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import ppo
from bayessim_mjx.rollout import ring
from tests.rl import probes

SCRIPT = Path(__file__).with_name("sharded.py")
CONFIG = PPOConfig(num_envs=64, num_steps=4, num_epochs=1, num_minibatches=2, hidden_actor=(4,), hidden_critic=(4,))


def start(out, devices, *arguments, what="curves"):
    """A process with so many devices of its own."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, str(SCRIPT), what, str(out), *arguments]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(process, out):
    words = process.communicate(timeout=300)[0]
    assert process.returncode == 0, words[-3000:]
    return json.loads(out.read_text())


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    out = tmp_path_factory.mktemp("devices") / "found.json"
    return finish(start(out, 2), out)


def assert_same_curve(a, b):
    assert len(a) == len(b) == 3
    for one, other in zip(a, b, strict=True):
        assert one.keys() == other.keys() and {"Loss/rnd", "Policy/grad_norm"} < one.keys()
        for tag in one:
            np.testing.assert_allclose(other[tag], one[tag], rtol=1e-3, atol=1e-5, err_msg=tag)


@pytest.mark.slow
def test_curves_do_not_depend_on_the_number_of_devices(runs):
    """Losses, novelty, statistics and returns of six iterations, to float32's rounding."""
    assert_same_curve(runs["curves"]["1"], runs["curves"]["2"])


@pytest.mark.slow
@pytest.mark.ci
def test_worlds_lie_on_all_devices_and_parameters_on_each(runs):
    assert runs["where"] == {"worlds": [2, False], "parameters": [2, True]}


@pytest.mark.slow
@pytest.mark.ci
def test_a_run_saved_on_two_devices_goes_on_on_one(runs):
    first, after = runs["curves"]["2"], runs["resumed"]["1"]
    assert_same_curve(runs["resumed"]["2"], after)
    assert after[0]["env_steps"] == first[-1]["env_steps"] + 2 * 128 * 8


@pytest.mark.slow
@pytest.mark.ci
def test_two_processes_learn_what_one_does(runs, tmp_path):
    """Two devices each, joined by jax.distributed; both save all of it."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    outs = [tmp_path / f"{i}.json" for i in range(2)]
    started = [start(out, 2, address, str(i), "2", what="process") for i, out in enumerate(outs)]
    found = [finish(process, out) for process, out in zip(started, outs, strict=True)]
    assert [f["devices"] for f in found] == [4, 4]
    assert found[0]["where"]["worlds"] == [4, False]
    assert found[0]["curve"] == found[1]["curve"]
    assert_same_curve(runs["curves"]["1"], found[0]["curve"])
    indices = [json.loads((tmp_path / f"saved{i}" / "index.json").read_text()) for i in range(2)]
    assert indices[0]["parts"] == indices[1]["parts"]


class Four:
    size = 4


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"num_envs": 96}, "ppo.num_envs = 96 cannot be shared evenly by 4 devices; give a multiple of 128"),
        ({"num_envs": 128, "num_minibatches": 100}, "ppo.num_minibatches = 100 makes minibatches of 5 transitions"),
    ],
)
def test_numbers_that_devices_cannot_share_are_refused(changes, words):
    config = PPOConfig(**{**CONFIG.to_dict(), **changes})
    with pytest.raises(UserError, match=words):
        rl.init(probes.Walk(), config, jax.random.PRNGKey(0), None, Four())


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"devices": "many"}, "devices = 'many': expected all, or how many"),
        ({"devices": "0"}, "devices = 0: there are 1"),
        ({"devices": "64"}, "devices = 64: there are 1"),
    ],
)
def test_devices_that_are_not_there_are_refused(settings, words):
    with pytest.raises(UserError, match=words):
        device.mesh(Config(device="cpu", **settings))


def test_one_device_is_no_mesh():
    assert device.mesh(Config(device="cpu")) is None
    assert rl.init(probes.Walk(), CONFIG, jax.random.PRNGKey(0)).mesh is None


@pytest.mark.parametrize("worlds", [1, 16, 31, 32, 64, 100, 3072, 4096])
@pytest.mark.parametrize("devices", [1, 2, 3, 4])
def test_devices_have_whole_rings(worlds, devices):
    """What one device sees of its own worlds is what it would see of them among all."""
    size = ring(worlds)
    assert worlds % size == 0 and size >= min(worlds, 32)
    if worlds % (size * devices) == 0:
        assert ring(worlds // devices) == size


def test_the_layout_names_every_array_of_the_state():
    state = rl.init(probes.Walk(), CONFIG, jax.random.PRNGKey(0))
    specs = ppo.layout(state)
    assert jax.tree.structure(specs) == jax.tree.structure(state)
    by_worlds = {jax.tree_util.keystr(path) for path, spec in jax.tree_util.tree_leaves_with_path(specs) if len(spec)}
    first = {jax.tree_util.keystr(path) for path, x in jax.tree_util.tree_leaves_with_path(state) if 64 in x.shape[:1]}
    assert by_worlds == first and len(first) > 8
