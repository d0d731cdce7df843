"""ONNX graphs of a policy's networks: a chain of nodes on one running value."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.env import Env
from bayessim_mjx.rl import normalise, recurrent
from bayessim_mjx.rl.networks import Policy

ONE_NODE = {
    "elu": "Elu", "relu": "Relu", "selu": "Selu", "tanh": "Tanh", "sigmoid": "Sigmoid", "softplus": "Softplus",
    "celu": "Celu", "lrelu": "LeakyRelu",
}  # fmt: skip


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
        """Continue the same graph from another value."""
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
        """Apply one of `networks.ACTIVATIONS`."""
        x = self.value
        if name in ONE_NODE:
            self.then(ONE_NODE[name])
        elif name == "swish":  # x sigmoid(x)
            self.then("Sigmoid")
            self.then("Mul", x)
        elif name == "mish":  # x tanh(softplus(x))
            self.then("Softplus")
            self.then("Tanh")
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


def observation_limit(env: Env) -> float | None:
    """Return the largest observation that the task shows to its policy; None: there is no limit."""
    return getattr(env, "observation_clip", {}).get(getattr(env, "variant", ""))


def network(graph: Graph, policy: Policy, env: Env, size: int) -> None:
    """Observation -> mean of the raw action."""
    limit = observation_limit(env)
    if limit is not None:  # as the task does before the policy sees it
        graph.then("Clip", -limit, limit)
    if policy.normalize:
        graph.then("Sub", policy.normalizer.mean)
        graph.then("Div", jnp.sqrt(policy.normalizer.var) + normalise.EPSILON)
        graph.then("Clip", -normalise.LIMIT, normalise.LIMIT)
    if recurrent.kind(policy.actor):
        _remember(graph, jax.device_get(policy.actor))
    *hidden, last = jax.device_get(policy.actor["layers"])
    for layer in hidden:
        graph.then("Gemm", layer["w"], layer["b"])
        graph.activate(policy.activation)
    if policy.beta:
        graph.then("Gemm", last["w"], last["b"])
        _mean_of_beta(graph, policy.action_clip)
    else:
        graph.then("Gemm", last["w"][:, :size], last["b"][:size])  # a spread by state comes after the means


def _mean_of_beta(graph: Graph, limit: float) -> None:
    """limit (2 a / (a + b) - 1), both concentrations softplus(x) + 1."""
    graph.then("Softplus")
    graph.then("Add", 1.0)
    a, b = graph.split(2)
    whole = graph.at(a).then("Add", b)
    graph.at(a).then("Div", whole)
    graph.then("Mul", 2.0 * limit)
    graph.then("Add", -limit)


def _remember(graph: Graph, actor: Any) -> None:
    """Observation -> outputs of the last recurrent layer, and memory_next."""
    layers, observed = recurrent.layers(actor), graph.value
    layer_of = {"gru": _gru, "lstm": _lstm}[recurrent.kind(actor)]  # type: ignore[index]
    memories = ["memory"] if len(layers) == 1 else graph.at("memory").split(len(layers))
    after: list[str] = []
    for layer, memory in zip(layers, memories, strict=True):
        output = "memory_next" if len(layers) == 1 else f"memory_{len(after)}"
        graph.at(observed)
        after.append(output)
        observed = layer_of(graph, layer, memory, output)
    if len(layers) > 1:
        graph.at(after[0]).then("Concat", *after[1:], output="memory_next", axis=1)
    graph.at(observed)


def _gates(graph: Graph, value: str, side: Any, count: int) -> list[str]:
    """Sum each gate over the input, or over the hidden units."""
    graph.at(value).then("Gemm", side["w"], side["b"])
    return graph.split(count)


def _gru(graph: Graph, layer: Any, memory: str, output: str) -> str:
    """Add `recurrent.gru`: the running value -> `output`, the memory after it; return what the next layer sees."""
    observed = _gates(graph, graph.value, layer["x"], 3)
    remembered = _gates(graph, memory, layer["h"], 3)
    sums = [graph.at(x).then("Add", h) for x, h in zip(observed[:2], remembered[:2], strict=True)]
    reset, update = [graph.at(x).then("Sigmoid") for x in sums]
    graph.at(remembered[2]).then("Mul", reset)
    graph.then("Add", observed[2])
    new = graph.then("Tanh")
    graph.at(memory).then("Sub", new)  # new + z (memory - new)
    graph.then("Mul", update)
    return graph.then("Add", new, output=output)


def _lstm(graph: Graph, layer: Any, memory: str, output: str) -> str:
    """Add `recurrent.lstm`: the running value -> `output`, the memory after it; return its hidden units."""
    observed = graph.then("Gemm", layer["x"]["w"], layer["x"]["b"])
    hidden, cells = graph.at(memory).split(2)
    graph.at(hidden).then("Gemm", layer["h"]["w"], layer["h"]["b"])
    graph.then("Add", observed)
    sums = graph.split(4)
    take, keep, new, show = [graph.at(x).then("Tanh" if i == 2 else "Sigmoid") for i, x in enumerate(sums)]
    kept = graph.at(keep).then("Mul", cells)
    graph.at(take).then("Mul", new)
    cells = graph.then("Add", kept)
    graph.then("Tanh")
    hidden = graph.then("Mul", show)
    graph.then("Concat", cells, output=output, axis=1)
    return hidden
