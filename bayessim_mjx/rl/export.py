"""A policy as an ONNX file for other machines: normaliser and limits inside, any batch size, and what its numbers mean.

The graph: observation [batch, S] -> action [batch, A] in [-1, 1], the deterministic one, and command [batch, nu] in the
actuators' units where the task scales each action by a number of its own. A policy with a memory takes it, [batch, M],
zeros at the start, and gives memory_next. Metadata are texts, lists in JSON.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx import versions
from bayessim_mjx.env import Env, Task
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import meaning, normalise, recurrent
from bayessim_mjx.rl.networks import Policy
from bayessim_mjx.rl.onnx_graph import Graph, network, observation_limit

OPSET, IR_VERSION = 17, 8  # of 2022: every runtime since reads it
GOLDEN = 8  # observations with the policy's answers, for a check on the target machine
PACKAGES = ("bayessim-mjx", "jax", "mujoco", "onnx")


def command_scale(env: Env, actions: int) -> tuple[np.ndarray, np.ndarray] | None:
    """(scale [A], offset [A]) of the commands offset + scale action; None where they are not of that form."""
    command, actuate = getattr(env, "command", None), getattr(env, "actuate", None)
    if command is None or getattr(actuate, "__func__", Task.actuate) is not Task.actuate:  # commands have a memory
        return None
    probes = np.random.default_rng(0).uniform(-1, 1, (16, actions)).astype(np.float32)
    offset = np.asarray(command(jnp.zeros(actions)))
    if offset.shape != (actions,):
        return None
    scale = np.asarray(command(jnp.ones(actions))) - offset
    commands = np.stack([np.asarray(command(jnp.asarray(action))) for action in probes])
    return (scale, offset) if np.allclose(commands, offset + scale * probes, rtol=1e-4, atol=1e-6) else None


def _graph(policy: Policy, env: Env, actions: int) -> tuple[Graph, dict[str, int]]:
    """From observation to action and command; and how many numbers each of them has."""
    graph, limit = Graph("observation"), policy.action_clip
    network(graph, policy, env, actions)
    if policy.squash:
        graph.then("Tanh")
        graph.then("Mul", limit)
    bound = min(1.0, limit)  # environments clip to +- 1 in any case
    graph.then("Clip", -bound, bound, output="action")
    outputs, scaling = {"action": actions}, command_scale(env, actions)
    if scaling is not None:
        graph.then("Mul", scaling[0])
        graph.then("Add", scaling[1], output="command")
        outputs["command"] = actions
    return graph, outputs


def onnx_model(policy: Policy, env: Env, notes: Mapping[str, Any] | None = None) -> Any:
    """Build the `onnx.ModelProto` of a policy of `env`; `notes`: more metadata. UserError without onnx."""
    try:
        import onnx
        from onnx import helper
    except ImportError:
        raise UserError('--export needs the package onnx: pip install "bayessim-mjx[export]"') from None
    actions = env.action_size - recurrent.memory_size(policy.actor)
    graph, outputs = _graph(policy, env, actions)
    value = lambda name, size: helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["batch", size])  # noqa: E731
    inputs = {"observation": env.observation_size["policy"][0]}
    if recurrent.memory_size(policy.actor):
        inputs["memory"] = outputs["memory_next"] = recurrent.memory_size(policy.actor)
    begins, ends = ([value(name, size) for name, size in side.items()] for side in (inputs, outputs))
    model = helper.make_model(
        helper.make_graph(graph.nodes, "policy", begins, ends, initializer=graph.constants),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="bayessim_mjx",
    )
    described = metadata(policy, env) | dict(notes or {})
    helper.set_model_props(model, {key: v if isinstance(v, str) else json.dumps(v) for key, v in described.items()})
    onnx.checker.check_model(model, full_check=True)
    return model


def metadata(policy: Policy, env: Env) -> dict[str, Any]:
    """Describe the inputs and outputs, in their order, with golden pairs of observations and actions."""
    scaling, golden = (
        command_scale(env, env.action_size - recurrent.memory_size(policy.actor)),
        golden_inputs(policy, env),
    )
    facts = {
        "task": env.name,
        "observation_names": list(getattr(env, "observation_names", ())),
        "action_names": _names(env.mj_model, mujoco.mjtObj.mjOBJ_ACTUATOR, env.mj_model.nu),
        "joint_names": _names(env.mj_model, mujoco.mjtObj.mjOBJ_JOINT, env.mj_model.njnt),
        "control_dt": env.dt,
        "action_clip": policy.action_clip,
        "versions": versions.of(PACKAGES),
        "golden_action": np.asarray(answer(policy, golden)).tolist(),
        **{f"golden_{name}": np.asarray(x).tolist() for name, x in golden.items()},
        **_contract(policy, env),
    }
    if scaling is not None:
        facts |= {"action_scale": scaling[0].tolist(), "action_offset": scaling[1].tolist()}
    return facts


def _contract(policy: Policy, env: Env) -> dict[str, Any]:
    """Describe what `policy check` compares: meaning of each observation, limits, normaliser, ranges of commands."""
    names, meant = list(getattr(env, "observation_names", ())), meaning.of_task(env)
    limit = observation_limit(env)
    limited, span = env.mj_model.actuator_ctrllimited.astype(bool), env.mj_model.actuator_ctrlrange
    facts: dict[str, Any] = {
        "observation_clip": limit,
        "command_joint": [_target(env.mj_model, i) for i in range(env.mj_model.nu)],
        "command_range": [list(map(float, r)) if own else None for own, r in zip(limited, span, strict=True)],
    }
    if meant is not None and len(meant) == len(names):
        facts["observation_meaning"] = meant
    if policy.normalize:
        spread = np.sqrt(np.asarray(policy.normalizer.var)) + normalise.EPSILON
        facts |= {"normaliser_mean": np.asarray(policy.normalizer.mean).tolist(), "normaliser_std": spread.tolist()}
    return facts


def _target(model: mujoco.MjModel, actuator: int) -> str | None:
    """Name the joint of which the command is the target (a position drive with gear 1); None for other actuators."""
    on_joint = int(model.actuator_trntype[actuator]) <= int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    gain, bias = model.actuator_gainprm[actuator, 0], model.actuator_biasprm[actuator, 1]
    if not on_joint or gain <= 0 or not np.isclose(bias, -gain) or model.actuator_gear[actuator, 0] != 1:
        return None
    joint = int(model.actuator_trnid[actuator, 0])
    return mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint) or f"{joint}"


def golden_inputs(policy: Policy, env: Env, count: int = GOLDEN) -> dict[str, jax.Array]:
    """Draw inputs [count, ...]: observations spread like those of the training, some far outside; and memories.

    They are within the limit of the task's observations: the file clips them, and the policy alone does not.
    """
    key, memory_key = jax.random.split(jax.random.PRNGKey(0))
    noise = jax.random.normal(key, (count, policy.normalizer.mean.shape[0]))
    factor = jnp.where(jnp.arange(count) % 4 == 3, 20.0, 1.0)[:, None]
    observation = policy.normalizer.mean + factor * noise * jnp.sqrt(policy.normalizer.var)
    limit = observation_limit(env)
    inputs = {"observation": observation if limit is None else jnp.clip(observation, -limit, limit)}
    size = recurrent.memory_size(policy.actor)
    return inputs | ({"memory": jax.random.uniform(memory_key, (count, size), minval=-1)} if size else {})


def answer(policy: Policy, inputs: Mapping[str, Any]) -> jax.Array:
    """Compute the deterministic actions [N, A] in [-1, 1] at these inputs."""
    acted = policy.act(None, {"policy": inputs["observation"]} | {k: inputs[k] for k in inputs if k == "memory"})
    return jnp.clip(acted[:, : acted.shape[1] - recurrent.memory_size(policy.actor)], -1.0, 1.0)


def difference(path: Path, inputs: Mapping[str, Any], action: Any) -> float | None:
    """Largest difference between the file's actions and `action` [N, A] at these inputs; None without onnxruntime."""
    try:
        import onnxruntime
    except ImportError:
        return None
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    (answers,) = session.run(["action"], {name: np.asarray(x, np.float32) for name, x in inputs.items()})
    return float(np.abs(answers - np.asarray(action)).max())


def write(path: Path, policy: Policy, env: Env, notes: Mapping[str, Any] | None = None) -> float | None:
    """Write the file; the largest difference to the policy at golden inputs, None without onnxruntime."""
    data = onnx_model(policy, env, notes).SerializeToString()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    inputs = golden_inputs(policy, env)
    return difference(path, inputs, answer(policy, inputs))


def _names(model: mujoco.MjModel, kind: mujoco.mjtObj, count: int) -> Sequence[str]:
    return [mujoco.mj_id2name(model, kind, i) or f"{i}" for i in range(count)]
