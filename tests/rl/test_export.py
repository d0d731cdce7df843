"""ONNX files against the policies that they were made of, by onnxruntime."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import registry
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import export, networks, normalise, recurrent
from bayessim_mjx.rl.networks import Policy

pytest.importorskip("onnx", reason="the extra [export] is not installed")
runtime = pytest.importorskip("onnxruntime", reason="the extra [export] is not installed")
SPREAD = jnp.array([0.5, 0.7, 4.0])


@pytest.fixture(scope="module")
def env():
    return registry.make("Pendulum")


def policy(activation="elu", state_dependent_std=False, size=3, actions=1, **changes):
    """A policy with statistics of its own, whose actions reach their limits."""
    keys = jax.random.split(jax.random.PRNGKey(1))
    kind = {"distribution": "beta" if changes.get("beta") else "gaussian", "state_dependent_std": state_dependent_std}
    config = PPOConfig(hidden_actor=(16, 8), hidden_critic=(8,), **kind)
    params = networks.init(keys[0], networks.Sizes(size, size, actions), config)
    layers = params["actor"]["layers"]
    actor = {**params["actor"], "layers": [*layers[:-1], jax.tree.map(lambda x: 60 * x, layers[-1])]}
    scale = jnp.resize(SPREAD, size)
    moments = normalise.update(normalise.init(size), 0.3 + scale * jax.random.normal(keys[1], (100, size)))
    return Policy(actor, moments, activation=activation, **changes)


def run(path, observation):
    session = runtime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return session.run(None, {"observation": np.asarray(observation, np.float32)})


@pytest.mark.parametrize(
    "kind",
    [{"activation": name} for name in networks.ACTIVATIONS]
    + [{"squash": True, "action_clip": 0.8}, {"action_clip": 0.5}, {"action_clip": 3.0}, {"normalize": False},
       {"state_dependent_std": True, "squash": True}, {"beta": True, "action_clip": 0.9}, {"std_range": (0.1, 3.0)}],
    ids=str,
)  # fmt: skip
def test_every_kind_of_policy_answers_alike_in_any_batch(env, kind, tmp_path):
    p = policy(**kind)
    assert export.write(tmp_path / "policy.onnx", p, env) < 2e-6
    for batch in (1, 5, 300):
        observation = 3 * SPREAD * jax.random.normal(jax.random.PRNGKey(batch), (batch, 3))
        action, command = run(tmp_path / "policy.onnx", observation)
        expected = np.clip(p.act(None, observation), -1, 1)
        np.testing.assert_allclose(action, expected, atol=2e-6)
        np.testing.assert_allclose(command, jax.vmap(env.command)(expected), atol=1e-5)
    assert np.std(action) > 0.05 and np.abs(action).max() <= min(1.0, p.action_clip) + 1e-6


@pytest.mark.parametrize(
    ("cell", "layers", "numbers"), [("gru", 1, 4), ("lstm", 1, 8), ("gru", 3, 12), ("lstm", 2, 16)]
)
def test_a_memory_goes_in_and_comes_out(env, tmp_path, cell, layers, numbers):
    """Three steps from zeros: the file's actions and memories are those of the policy."""
    config = PPOConfig(hidden_actor=(8,), hidden_critic=(8,), memory=4, memory_cell=cell, memory_layers=layers)
    params = networks.init(jax.random.PRNGKey(0), networks.Sizes(3, 3, 1), config)
    actor = {**params["actor"], "layers": jax.tree.map(lambda x: 9 * x, params["actor"]["layers"])}
    p, remembering = Policy(actor, normalise.init(3)), recurrent.remembering(env, numbers)
    assert export.write(tmp_path / "policy.onnx", p, remembering) < 2e-6
    session = runtime.InferenceSession(tmp_path / "policy.onnx", providers=["CPUExecutionProvider"])
    assert [(i.name, i.shape) for i in session.get_inputs()] == [
        ("observation", ["batch", 3]),
        ("memory", ["batch", numbers]),
    ]
    memory = np.zeros((2, numbers), np.float32)
    for step in range(3):
        obs = np.asarray(jax.random.normal(jax.random.PRNGKey(step), (2, 3)))
        expected = p.act(None, {"policy": obs, "memory": memory})
        action, memory = session.run(["action", "memory_next"], {"observation": obs, "memory": memory})
        np.testing.assert_allclose(np.hstack([action, memory]), expected, atol=2e-6)
    assert np.abs(memory).max() > 0.1


def test_the_file_says_what_its_numbers_mean(env, tmp_path):
    p = policy()
    export.write(tmp_path / "policy.onnx", p, env, {"checkpoint": "000100"})
    session = runtime.InferenceSession(tmp_path / "policy.onnx", providers=["CPUExecutionProvider"])
    facts = session.get_modelmeta().custom_metadata_map
    assert (facts["task"], facts["checkpoint"], float(facts["control_dt"])) == ("Pendulum", "000100", env.dt)
    assert json.loads(facts["observation_names"]) == ["cos_theta", "sin_theta", "theta_dot"]
    assert json.loads(facts["joint_names"]) == list(env.joint_names)
    assert json.loads(facts["action_names"]) == list(env.actuator_names)
    assert json.loads(facts["action_scale"]) == [2.0] and json.loads(facts["action_offset"]) == [0.0]
    assert json.loads(facts["versions"])["jax"] == jax.__version__
    golden = json.loads(facts["golden_observation"])
    np.testing.assert_allclose(run(tmp_path / "policy.onnx", golden)[0], json.loads(facts["golden_action"]), atol=2e-6)
    assert [(i.name, i.shape) for i in session.get_inputs()] == [("observation", ["batch", 3])]
    assert [(o.name, o.shape) for o in session.get_outputs()] == [("action", ["batch", 1]), ("command", ["batch", 1])]


@pytest.mark.slow
def test_names_are_as_many_as_numbers_for_every_task():
    for name in registry.names():
        env = registry.make(name)
        facts = export.metadata(policy(size=env.observation_size["policy"][0], actions=env.action_size), env)
        assert len(facts["observation_names"]) == env.observation_size["policy"][0], name
        assert len(facts["action_names"]) == env.action_size, name
        if name in (
            "BallBalance",
            "FrankaCabinet",
            "Ingenuity",
            "Quadcopter",
            "ShadowHand",
        ):  # commands have a memory, or forces are a product
            assert "action_scale" not in facts
        else:
            assert len(facts["action_scale"]) == env.action_size, name


def test_observations_are_clipped_as_the_task_does(tmp_path):
    env = registry.make("Pendulum", variant="bayessim2021")
    p = policy(normalize=False)
    export.write(tmp_path / "policy.onnx", p, env)
    far = jnp.array([[0.0, 0.0, 5000.0]])
    np.testing.assert_allclose(run(tmp_path / "policy.onnx", far)[0], p.act(None, jnp.clip(far, -100, 100)), atol=2e-6)


def test_a_command_of_another_form_is_left_out():
    class Mixing:
        action_size = 2

        def command(self, action):
            return jnp.stack([action[0] + action[1], action[1]])

    assert export.command_scale(Mixing(), 2) is None
    Mixing.command = lambda self, action: action**3
    assert export.command_scale(Mixing(), 2) is None
    Mixing.command = lambda self, action: 3 * action + jnp.array([1.0, 2.0])
    np.testing.assert_allclose(export.command_scale(Mixing(), 2), [[3, 3], [1, 2]])


def test_without_the_package_the_extra_is_named(env, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "onnx", None)
    with pytest.raises(UserError, match=r"bayessim-mjx\[export\]"):
        export.onnx_model(policy(), env)
