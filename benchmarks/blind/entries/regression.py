"""What the baselines of the blind suite share: efforts that the model does not explain, and terms that could."""

import copy
import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.signal import savgol_filter

from bayessim_mjx.logs import Log, read_logs

SMOOTH = 0.12  # s, of the window that positions are differentiated in
EDGE = 5  # rows left out at both ends of a log
SHEET = 0.05  # of data-sheet values
# term -> the effect that a reader would name, and whether it sits at the actuator
EFFECTS = {
    "sign(v)": ("coulomb_friction", False), "v": ("viscous_friction", False), "v|v|": ("quadratic_drag", False),
    "a": ("armature", False), "q": ("joint_spring", False), "1": ("actuator_bias", True), "u": ("actuator_gain", True),
    "du": ("actuator_delay", True), "u|u|": ("effort_loss", True), "sin(q)": ("payload", False),
    "cos(q)": ("gravity_tilt", False),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Problem:
    """One joint: y [T] effort that is not explained, X [T, k] terms, nuisance [T, m], group [T] of its log.

    nuisance: what 5 % more of each data-sheet value does.
    """

    joint: str
    actuator: str
    body: str
    y: np.ndarray
    X: np.ndarray
    nuisance: np.ndarray
    group: np.ndarray


def problems(model_path: str, data: str) -> list[Problem]:
    """Of every driven joint, from all logs."""
    model = mujoco.MjModel.from_xml_path(model_path)
    parts = [_signals(model, log) for log in read_logs(data, model)]
    out = []
    for i in range(model.nu):
        joint = int(model.actuator_trnid[i, 0])
        dof, qadr = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
        columns = [_terms(p, i, dof, qadr) for p in parts]
        sheet = np.concatenate([_known(model, p, dof) for p in parts])
        out.append(
            Problem(
                model.joint(joint).name,
                model.actuator(i).name,
                model.body(model.jnt_bodyid[joint]).name,
                np.concatenate([p["y"][:, dof] for p in parts]),
                np.concatenate(columns),
                SHEET * sheet,
                np.concatenate([np.full(len(p["y"]), k) for k, p in enumerate(parts)]),
            )  # fmt: skip
        )
    return out


def _signals(model: mujoco.MjModel, log: Log) -> dict[str, np.ndarray]:
    window = max(5, int(SMOOTH / log.period) // 2 * 2 + 1)
    q, v, a = (savgol_filter(log.qpos, window, 4, deriv=d, delta=log.period, axis=0) for d in range(3))
    held = 0.5 * (log.ctrl + np.concatenate([log.ctrl[:1], log.ctrl[:-1]]))  # a row's command acts from the row on
    u = savgol_filter(held, window, 4, axis=0)  # as smooth as the motion: an equation holds for what is filtered alike
    y = _missing(model, q, v, a, u)
    moving = [body for body in range(1, model.nbody) if model.body_weldid[body]]
    masses = [_missing(_heavier(model, body), q, v, a, u) - y for body in moving]
    cut = slice(EDGE, -EDGE)
    found = {"q": q, "v": v, "a": a, "u": u, "du": np.gradient(u, log.period, axis=0), "y": y}
    return {k: x[cut] for k, x in found.items()} | {"masses": np.stack(masses, 1)[cut]}


def _known(model: mujoco.MjModel, p: dict[str, np.ndarray], dof: int) -> np.ndarray:
    """[T, m] what masses, damping and rotor inertia of the data sheet do at a joint."""
    own = [model.dof_damping[dof] * p["v"][:, dof], model.dof_armature[dof] * p["a"][:, dof]]
    return np.column_stack([p["masses"][:, :, dof], *own])


def _heavier(model: mujoco.MjModel, body: int) -> Any:
    other = copy.copy(model)
    other.body_mass[body] *= 2
    other.body_inertia[body] *= 2
    return other


def _missing(model: Any, q: np.ndarray, v: np.ndarray, a: np.ndarray, u: np.ndarray) -> np.ndarray:
    """[T, nv] what the motion needs beyond the actuators' forces."""
    data, out = mujoco.MjData(model), []
    for row in zip(q, v, a, u, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:], data.ctrl[:] = row
        mujoco.mj_inverse(model, data)
        needed = data.qfrc_inverse.copy()
        mujoco.mj_forward(model, data)
        out.append(needed - data.qfrc_actuator)
    return np.array(out)


def _terms(p: dict[str, np.ndarray], i: int, dof: int, qadr: int) -> np.ndarray:
    q, v, a, u = p["q"][:, qadr], p["v"][:, dof], p["a"][:, dof], p["u"][:, i]
    slow = 0.02 * np.abs(v).max() + 1e-9
    motion = [np.tanh(v / slow), v, v * np.abs(v), a, q, np.ones_like(q)]
    return np.stack([*motion, u, p["du"][:, i], u * np.abs(u), np.sin(q), np.cos(q)], 1)


def least_squares(p: Problem, terms: list[int], shrink: float = 0.0) -> tuple[np.ndarray, np.ndarray, float]:
    """(coefficients, errors as if residuals were independent, rss), data-sheet values as accurate as they are.

    shrink: ridge of the terms, as a share of their squares: some depend on each other.
    """
    sigma = max(float(np.std(p.y)), 1e-12)
    A = np.column_stack([p.X[:, terms], p.nuisance])
    own = shrink * np.sum(p.X[:, terms] ** 2, axis=0)
    ridge = np.diag([*own] + [sigma**2] * p.nuisance.shape[1])
    inverse = np.linalg.pinv(A.T @ A + ridge)
    x = inverse @ A.T @ p.y
    rss = float(np.sum((p.y - A @ x) ** 2))
    errors = np.sqrt(np.maximum(np.diag(inverse) * rss / max(len(p.y) - A.shape[1], 1), 1e-300))
    return x[: len(terms)], errors[: len(terms)], rss


def place(p: Problem, term: int) -> tuple[str, str]:
    """(effect, where) of a term."""
    effect, at_actuator = list(EFFECTS.values())[term]
    where = {"payload": p.body, "gravity_tilt": "world"}.get(effect, p.actuator if at_actuator else p.joint)
    return effect, where


def write(verdict: str, effects: list[tuple[str, str]] = ()) -> None:  # type: ignore[assignment]
    """diagnosis.json of an entry that only names effects, in the folder of the third argument."""
    out = Path(sys.argv[3])
    out.mkdir(parents=True, exist_ok=True)
    named = [{"name": n, "where": w, "parameters": {}, "equivalent_to": []} for n, w in effects]
    (out / "diagnosis.json").write_text(json.dumps({"verdict": verdict, "effects": named}))
