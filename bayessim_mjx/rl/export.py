"""A policy as an ONNX file for other machines: normaliser and limits inside, any batch size, and what its numbers mean.

The graph: observation [batch, S] -> action [batch, A] in [-1, 1], the deterministic one, and command [batch, nu] in the
actuators' units where the task scales each action by a number of its own. A policy with a memory takes it, [batch, M],
zeros at the start, and gives memory_next. Metadata are texts, lists in JSON.
"""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.env import Env
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import normalise, recurrent
from bayessim_mjx.rl.networks import Policy

OPSET, IR_VERSION = 17, 8  # of 2022: every runtime since reads it
GOLDEN = 8  # observations with the policy's answers, for a check on the target machine
PACKAGES = ("bayessim-mjx", "jax", "mujoco", "onnx")
ONE_NODE = {"elu": "Elu", "relu": "Relu", "selu": "Selu", "tanh": "Tanh"}


class Graph:
    """A chain of ONNX nodes on one running value."""

    def __init__(self, value: str) -> None:
        self.value, self.nodes, self.constants = value, [], []  # type: ignore[var-annotated]

    def then(self, operation: str, *others: Any, output: str = "", **attributes: Any) -> str:
        """value = operation(value, *others); arrays become constants, texts are names of other values."""
        from onnx import helper

        names = [self.value, *(o if isinstance(o, str) else self.constant(o) for o in others)]
        self.value = output or f"value_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operation, names, [self.value], **attributes))
        return self.value

    def at(self, value: str) -> Graph:
        """The same graph, to be gone on with from another value."""
        self.value = value
        return self

    def split(self, count: int) -> list[str]:
        """Names of as many equal parts of the value's columns."""
        from onnx import helper

        names = [f"value_{len(self.nodes)}_{i}" for i in range(count)]
        self.nodes.append(helper.make_node("Split", [self.value], names, axis=1))
        return names

    def constant(self, array: Any) -> str:
        """Name of a float32 constant."""
        from onnx import numpy_helper

        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(array, np.float32), name))
        return name

    def activate(self, name: str) -> None:
        """The activations of `networks.ACTIVATIONS`."""
        x = self.value
        if name in ONE_NODE:
            self.then(ONE_NODE[name])
        elif name == "swish":  # x sigmoid(x)
            self.then("Sigmoid")
            self.then("Mul", x)
        else:  # gelu, as JAX's: x (1 + tanh(sqrt(2 / pi) (x + 0.044715 x^3))) / 2
            for operation, other in (
                ("Mul", x),
                ("Mul", 0.044715),
                ("Add", 1.0),
                ("Mul", x),
                ("Mul", (2 / np.pi) ** 0.5),
            ):
                self.then(operation, other)
            self.then("Tanh")
            for operation, other in (("Add", 1.0), ("Mul", x), ("Mul", 0.5)):
                self.then(operation, other)


def command_scale(env: Env, actions: int) -> tuple[np.ndarray, np.ndarray] | None:
    """(scale [A], offset [A]) of the commands offset + scale action; None where they are not of that form."""
    command = getattr(env, "command", None)
    if command is None:
        return None
    probes = np.random.default_rng(0).uniform(-1, 1, (16, actions)).astype(np.float32)
    offset = np.asarray(command(jnp.zeros(actions)))
    if offset.shape != (actions,):
        return None
    scale = np.asarray(command(jnp.ones(actions))) - offset
    commands = np.stack([np.asarray(command(jnp.asarray(action))) for action in probes])
    return (scale, offset) if np.allclose(commands, offset + scale * probes, rtol=1e-4, atol=1e-6) else None


def _network(graph: Graph, policy: Policy, env: Env, size: int) -> None:
    """Observation -> mean of the raw action."""
    limit = getattr(env, "observation_clip", {}).get(getattr(env, "variant", ""))
    if limit is not None:  # as the task does before the policy sees it
        graph.then("Clip", -limit, limit)
    if policy.normalize:
        graph.then("Sub", policy.normalizer.mean)
        graph.then("Div", jnp.sqrt(policy.normalizer.var) + normalise.EPSILON)
        graph.then("Clip", -normalise.LIMIT, normalise.LIMIT)
    kind = recurrent.kind(policy.actor)
    if kind is not None:
        {"gru": _gru, "lstm": _lstm}[kind](graph, jax.device_get(policy.actor[kind]))
    *hidden, last = jax.device_get(policy.actor["layers"])
    for layer in hidden:
        graph.then("Gemm", layer["w"], layer["b"])
        graph.activate(policy.activation)
    graph.then("Gemm", last["w"][:, :size], last["b"][:size])  # a spread by state comes after the means


def _gates(graph: Graph, value: str, side: Any, count: int) -> list[str]:
    """The sums of each gate over the input, or over the hidden units."""
    graph.at(value).then("Gemm", side["w"], side["b"])
    return graph.split(count)


def _gru(graph: Graph, layer: Any) -> None:
    """Observation -> memory_next, as `recurrent.gru` does."""
    observed = _gates(graph, graph.value, layer["x"], 3)
    remembered = _gates(graph, "memory", layer["h"], 3)
    sums = [graph.at(x).then("Add", h) for x, h in zip(observed[:2], remembered[:2], strict=True)]
    reset, update = [graph.at(x).then("Sigmoid") for x in sums]
    graph.at(remembered[2]).then("Mul", reset)
    graph.then("Add", observed[2])
    new = graph.then("Tanh")
    graph.at("memory").then("Sub", new)  # new + z (memory - new)
    graph.then("Mul", update)
    graph.then("Add", new, output="memory_next")


def _lstm(graph: Graph, layer: Any) -> None:
    """Observation -> hidden units, and memory_next, as `recurrent.lstm` does."""
    observed = graph.then("Gemm", layer["x"]["w"], layer["x"]["b"])
    hidden, cells = graph.at("memory").split(2)
    graph.at(hidden).then("Gemm", layer["h"]["w"], layer["h"]["b"])
    graph.then("Add", observed)
    sums = graph.split(4)
    take, keep, new, show = [graph.at(x).then("Tanh" if i == 2 else "Sigmoid") for i, x in enumerate(sums)]
    kept = graph.at(keep).then("Mul", cells)
    graph.at(take).then("Mul", new)
    cells = graph.then("Add", kept)
    graph.then("Tanh")
    hidden = graph.then("Mul", show)
    graph.then("Concat", cells, output="memory_next", axis=1)
    graph.at(hidden)


def onnx_model(policy: Policy, env: Env, notes: Mapping[str, Any] | None = None) -> Any:
    """The `onnx.ModelProto` of a policy of `env`; `notes`: more metadata. UserError where onnx is not installed."""
    try:
        import onnx
        from onnx import helper
    except ImportError:
        raise UserError('--export needs the package onnx: pip install "bayessim-mjx[export]"') from None
    graph, limit, actions = (
        Graph("observation"),
        policy.action_clip,
        env.action_size - recurrent.memory_size(policy.actor),
    )
    _network(graph, policy, env, actions)
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
    """What the inputs and outputs are, in their order, and golden pairs of observations and actions."""
    scaling, golden = command_scale(env, env.action_size - recurrent.memory_size(policy.actor)), golden_inputs(policy)
    facts = {
        "task": env.name,
        "observation_names": list(getattr(env, "observation_names", ())),
        "action_names": _names(env.mj_model, mujoco.mjtObj.mjOBJ_ACTUATOR, env.mj_model.nu),
        "joint_names": _names(env.mj_model, mujoco.mjtObj.mjOBJ_JOINT, env.mj_model.njnt),
        "control_dt": env.dt,
        "action_clip": policy.action_clip,
        "versions": {name: _version(name) for name in PACKAGES},
        "golden_action": np.asarray(answer(policy, golden)).tolist(),
        **{f"golden_{name}": np.asarray(x).tolist() for name, x in golden.items()},
    }
    if scaling is not None:
        facts |= {"action_scale": scaling[0].tolist(), "action_offset": scaling[1].tolist()}
    return facts


def golden_inputs(policy: Policy, count: int = GOLDEN) -> dict[str, jax.Array]:
    """Inputs [count, ...]: observations spread like those of the training, some far outside; and memories."""
    key, memory_key = jax.random.split(jax.random.PRNGKey(0))
    noise = jax.random.normal(key, (count, policy.normalizer.mean.shape[0]))
    factor = jnp.where(jnp.arange(count) % 4 == 3, 20.0, 1.0)[:, None]
    inputs = {"observation": policy.normalizer.mean + factor * noise * jnp.sqrt(policy.normalizer.var)}
    size = recurrent.memory_size(policy.actor)
    return inputs | ({"memory": jax.random.uniform(memory_key, (count, size), minval=-1)} if size else {})


def answer(policy: Policy, inputs: Mapping[str, Any]) -> jax.Array:
    """The deterministic actions [N, A] in [-1, 1] at these inputs."""
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
    inputs = golden_inputs(policy)
    return difference(path, inputs, answer(policy, inputs))


def _names(model: mujoco.MjModel, kind: mujoco.mjtObj, count: int) -> Sequence[str]:
    return [mujoco.mj_id2name(model, kind, i) or f"{i}" for i in range(count)]


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"
