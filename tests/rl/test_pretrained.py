"""Policies that come with the package: whole, as good as stated, and refused where damaged."""

import dataclasses
import json
import re
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bayessim_mjx
from bayessim_mjx import registry, rl
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import pretrained
from bayessim_mjx.rl.normalise import Moments

PAGE = Path(__file__).parents[2] / "docs" / "pretrained.md"


@pytest.fixture
def copy(tmp_path):
    shutil.copytree(pretrained.FOLDER, tmp_path / "released")
    return tmp_path / "released"


def test_a_policy_reaches_its_stated_return():
    facts = pretrained.about("pendulum")["return"]
    env, policy = registry.make("Pendulum"), bayessim_mjx.pretrained("Pendulum")
    thetas = jnp.tile(jnp.asarray(env.space.nominal), (64, 1))
    returns = rl.evaluate(env, policy, jax.random.PRNGKey(3), thetas)["return"]  # other starts than when it was stated
    assert abs(returns.mean() - facts["mean"]) < 4 * facts["sd"] / np.sqrt(len(returns))
    assert facts["mean"] > -200  # resting, it gets -1200


@pytest.mark.slow
@pytest.mark.parametrize("task", [pytest.param("Cartpole", marks=pytest.mark.ci), "BallBalance"])
def test_the_other_policies_do_too(task):
    assert set(pretrained.names()) == {"Pendulum", "Cartpole", "BallBalance"}
    facts = pretrained.about(task)["return"]
    env = registry.make(task)
    thetas = jnp.tile(jnp.asarray(env.space.nominal), (64, 1))
    returns = rl.evaluate(env, pretrained.pretrained(task), jax.random.PRNGKey(3), thetas)["return"]
    assert returns.mean() > facts["mean"] - 4 * max(facts["sd"], 1.0) / np.sqrt(len(returns))


@pytest.mark.parametrize("task", pretrained.names())
def test_files_are_whole_and_small_and_the_page_tells_of_them(task):
    facts, policy = pretrained.about(task), pretrained.pretrained(task)
    assert (pretrained.FOLDER / facts["file"]).stat().st_size < 300_000
    assert policy.act(None, policy.normalizer.mean[None]).shape[0] == 1
    [row] = re.findall(rf"\| {task} \| (-?[\d.]+) ± ([\d.]+).*\| `(.*)` \|", PAGE.read_text())
    assert abs(float(row[0]) - facts["return"]["mean"]) < 0.5 and abs(float(row[1]) - facts["return"]["sd"]) < 0.5
    assert row[2] == facts["command"]


def test_what_is_written_is_read_again(tmp_path):
    layers = [{"w": jnp.ones((2, 3)), "b": jnp.zeros(3)}, {"w": jnp.ones((3, 1)), "b": jnp.zeros(1)}]
    actor = {"layers": layers, "log_std": jnp.zeros(1)}
    policy = rl.Policy(actor, Moments(jnp.zeros(2), jnp.ones(2), jnp.ones(())), squash=True, std_range=(0.1, 3.0))
    pretrained.write(policy, "MyTask", {"note": "x"}, tmp_path)
    read = pretrained.pretrained("my_task", tmp_path)
    assert (
        jax.tree.structure(read) == jax.tree.structure(policy) and pretrained.about("MyTask", tmp_path)["note"] == "x"
    )
    assert all(map(np.array_equal, jax.tree.leaves(read), jax.tree.leaves(policy)))


def test_all_that_a_policy_is_beside_its_arrays_is_kept():
    static = {field.name for field in dataclasses.fields(rl.Policy) if not field.metadata.get("pytree_node", True)}
    assert set(pretrained.KEPT) == static - {"deterministic", "half"}  # how it is asked, not what it is


def test_an_unknown_task_is_refused_with_those_that_there_are():
    with pytest.raises(UserError, match="'Anymal': policies come for Pendulum"):
        bayessim_mjx.pretrained("Anymal")


def test_a_damaged_or_missing_file_is_refused(copy):
    name = pretrained.about("Cartpole", copy)["file"]
    damaged = bytearray((copy / name).read_bytes())
    damaged[len(damaged) // 2] ^= 1
    (copy / name).write_bytes(damaged)
    with pytest.raises(UserError, match=r"cartpole\.npz: damaged: its SHA-256 is"):
        pretrained.pretrained("Cartpole", copy)
    (copy / name).unlink()
    with pytest.raises(UserError, match="cannot be read"):
        pretrained.pretrained("Cartpole", copy)
    (copy / pretrained.INDEX).write_text(json.dumps({})[:1])
    with pytest.raises(UserError, match="list of policies"):
        pretrained.names(copy)
