"""A toy robot on a free base with two joints: its manifest, its state as a sum of sines, and its logs."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper

DT = 0.02  # s
JOINTS = ("hip", "knee")
HOME = np.array([0.4, -0.8])
NAMES = [
    *(f"gravity_{i}" for i in "xyz"), *(f"spin_{i}" for i in "xyz"), *(f"{j}_position" for j in JOINTS),
    *(f"{j}_velocity" for j in JOINTS), *(f"{j}_action" for j in JOINTS),
]  # fmt: skip


def manifest() -> dict[str, Any]:
    def entry(source: str, weight: float = 1.0, offset: float = 0.0, unit: str = "1") -> dict[str, Any]:
        return {"terms": {source: weight}, "offset": offset, "unit": unit}

    meaning = [
        *(entry(f"gravity:root.{i}") for i in "xyz"),
        *(entry(f"turning:root.{i}", 0.25, unit="rad/s") for i in "xyz"),
        *(entry(f"qpos:{j}", 1.0, -h, "rad") for j, h in zip(JOINTS, HOME, strict=True)),
        *(entry(f"qvel:{j}", 0.05, unit="rad/s") for j in JOINTS),
        *(entry(f"action:{j}") for j in JOINTS),
    ]
    return {
        "observation_names": NAMES, "observation_meaning": meaning, "action_names": list(JOINTS), "control_dt": DT,
        "action_clip": 1.0, "action_scale": [0.5, 0.5], "action_offset": HOME.tolist(),
        "normaliser_mean": [0.1] * len(NAMES), "normaliser_std": [0.6] * len(NAMES),
    }  # fmt: skip


def weights(seed: int = 0) -> np.ndarray:
    """[S, 2] of the policy: tanh(W (o - mean) / std)."""
    return np.random.default_rng(seed).normal(size=(len(NAMES), 2)) * 0.35


def write_policy(path: Path, facts: dict[str, Any] | None = None, seed: int = 0) -> Path:
    """An ONNX file of one layer."""
    constants = [("mean", np.full(len(NAMES), 0.1)), ("std", np.full(len(NAMES), 0.6)), ("w", weights(seed))]
    nodes = [
        helper.make_node("Sub", ["observation", "mean"], ["a"]), helper.make_node("Div", ["a", "std"], ["b"]),
        helper.make_node("MatMul", ["b", "w"], ["c"]), helper.make_node("Tanh", ["c"], ["action"]),
    ]  # fmt: skip
    value = lambda name, size: helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])  # noqa: E731
    kept = [numpy_helper.from_array(x.astype(np.float32), name) for name, x in constants]
    graph = helper.make_graph(nodes, "policy", [value("observation", len(NAMES))], [value("action", 2)], kept)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    facts = manifest() if facts is None else facts
    helper.set_model_props(model, {k: json.dumps(v) for k, v in facts.items()})
    path.write_bytes(model.SerializeToString())
    return path


def act(observation: np.ndarray) -> np.ndarray:
    return np.tanh((observation - 0.1) / 0.6 @ weights())


def rotation(quat: np.ndarray) -> np.ndarray:
    w, x, y, z = quat
    return np.array([
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ])  # fmt: skip


def motion(seed: int, steps: int) -> dict[str, np.ndarray]:
    """Positions and velocities of the joints, quaternion and angular velocity (body), by sines."""
    rng, t = np.random.default_rng(seed), DT * np.arange(steps)
    size, rate, phase = rng.uniform(0.2, 0.5, (3, 8)), rng.uniform(2, 12, (3, 8)), rng.uniform(0, 6, (3, 8))
    waves = np.einsum("ij,ijk->kj", size, np.sin(rate[:, :, None] * t + phase[:, :, None]))
    speeds = np.einsum("ij,ijk->kj", size * rate, np.cos(rate[:, :, None] * t + phase[:, :, None]))
    quat = np.stack([np.ones(steps), 0.5 * waves[:, 0], 0.5 * waves[:, 1], waves[:, 2]], 1)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return {
        "time": t,
        "q": HOME + 0.6 * waves[:, 3:5],
        "v": 0.6 * speeds[:, 3:5],
        "quat": quat,
        "spin": 2 * waves[:, 5:8],
    }


def observe(m: dict[str, np.ndarray], k: int, last: np.ndarray) -> np.ndarray:
    """One observation, as the manifest says it."""
    down = -rotation(m["quat"][k])[2]
    return np.concatenate([down, 0.25 * m["spin"][k], m["q"][k] - HOME, 0.05 * m["v"][k], last])


def write_log(
    path: Path, observation: Any = observe, command: Any = lambda a: HOME + 0.5 * a, noise: float = 0.0, seed: int = 0,
    steps: int = 300, acted: Any = act, drop: tuple[str, ...] = (), dt: float = DT,
) -> Path:  # fmt: skip
    """Write a log of the policy: `observation(motion, step, last action)`, `command(action)`, `acted(observation)`."""
    m, rng, last, rows = motion(seed, steps), np.random.default_rng(seed + 1), np.zeros(2), []
    header = [
        "time",
        *(f"observation:{n}" for n in NAMES),
        *(f"action:{j}" for j in JOINTS),
        *(f"ctrl:{j}" for j in JOINTS),
    ]
    header += [*(f"qpos:{j}" for j in JOINTS), *(f"qvel:{j}" for j in JOINTS)]
    header += [*(f"qpos:root[{i}]" for i in range(7)), *(f"qvel:root[{i}]" for i in range(6))]
    for k in range(steps):
        seen = observation(m, k, last)
        last = acted(seen)
        state = np.concatenate([m["q"][k], m["v"][k], np.zeros(3), m["quat"][k], np.zeros(3), m["spin"][k]])
        rows.append([dt * k, *seen, *last, *command(last), *(state + noise * rng.normal(size=len(state)))])
    keep = [i for i, name in enumerate(header) if not name.startswith(drop or "-")]
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, np.array(rows)[:, keep], "%.9g", ",", header=",".join(header[i] for i in keep), comments="")
    return path
