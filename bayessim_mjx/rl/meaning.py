"""What each entry of an observation means: weight * source + offset, found by probing the task at random states.

Sources are texts that a robot's log can give: `qpos:<joint>`, `sin:<joint>`, `cos:<joint>`, `qvel:<joint>`; of a free
or ball joint `position:<joint>.x`, `quaternion:<joint>.w`, `gravity:<joint>.x` (direction of gravity in the body's
axes), `turning:<joint>.x` (angular velocity in the body's axes), `turning_world:<joint>.x`, `velocity:<joint>.x` (in
the body's axes), `velocity_world:<joint>.x`; `action:<actuator>` (previous action); `task:<number>`, as a goal.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.env import Env, Task
from bayessim_mjx.frames import rotation
from bayessim_mjx.keys import branch

PROBES = 256  # random states: more than the sources of any task of the package, so that a fit is no accident
EXACT = 1e-3  # of the entry's spread: the largest residual of an entry that its sources explain; float32 rounding
SMALL = 1e-4  # of the largest weight: a smaller one is float32 rounding
HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
FREE, BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
UNITS = {
    **{"sin": "1", "cos": "1", "position": "m", "quaternion": "1", "gravity": "1", "turning": "rad/s"},
    **{"turning_world": "rad/s", "velocity": "m/s", "velocity_world": "m/s", "action": "1", "task": ""},
}

_KNOWN: weakref.WeakKeyDictionary[Env, list[Any]] = weakref.WeakKeyDictionary()  # probing compiles a program
Entry = dict[str, Any] | None  # terms: {source: weight}, offset, unit of the sources; None: no such form


def of_task(env: Env) -> list[Entry] | None:
    """Describe every entry of the group "policy"; None where the environment, without its wrappers, is no `Task`.

    An entry whose form is not affine in the sources (a contact force, an angle to a goal) is None.
    """
    env = env.unwrapped
    if not isinstance(env, Task):
        return None
    if env not in _KNOWN:
        sources, values, seen = _probes(env)
        units = _units(env.mj_model)
        _KNOWN[env] = [_entry(sources, values, column, units) for column in seen.T]
    return _KNOWN[env]


def _entry(sources: Sequence[str], values: np.ndarray, seen: np.ndarray, units: dict[str, str]) -> Entry:
    """Fit one entry [P] by one source, else by all of them [P, n]."""
    spread = float(seen.std())
    if not np.isfinite(seen).all() or spread < 1e-9:
        return None
    centred, own = values - values.mean(0), seen - seen.mean()
    one = centred.T @ own / np.maximum((centred**2).sum(0), 1e-12)
    left = np.abs(own[:, None] - one * centred).max(0)
    best = int(np.argmin(left))
    if left[best] < EXACT * spread:
        weights = {sources[best]: float(one[best])}
    else:
        every, *_ = np.linalg.lstsq(centred, own, rcond=1e-6)
        if np.abs(own - centred @ every).max() > EXACT * spread:
            return None
        large = np.flatnonzero(np.abs(every) > SMALL * np.abs(every).max())
        weights = {sources[int(i)]: float(every[i]) for i in large}
    columns = [sources.index(name) for name in weights]
    offset = float(np.median(seen - values[:, columns] @ np.array([*weights.values()])))
    kinds = {units.get(name, UNITS.get(name.partition(":")[0], "")) for name in weights}
    rounded = {name: float(f"{weight:.5g}") for name, weight in weights.items()}
    return {
        "terms": rounded,
        "offset": float(f"{offset:.5g}") if abs(offset) > SMALL * spread else 0.0,
        "unit": kinds.pop() if len(kinds) == 1 else "",
    }


def _units(model: mujoco.MjModel) -> dict[str, str]:
    """Units of positions and velocities of hinges and slides, by source."""
    found: dict[str, str] = {}
    for i in range(model.njnt):
        unit = {HINGE: "rad", SLIDE: "m"}.get(int(model.jnt_type[i]))
        if unit is not None:
            found |= {f"qpos:{_name(model, i)}": unit, f"qvel:{_name(model, i)}": f"{unit}/s"}
    return found


def _name(model: mujoco.MjModel, joint: int) -> str:
    return mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, joint) or f"{joint}"


def _probes(env: Task) -> tuple[list[str], np.ndarray, np.ndarray]:
    """(names of the sources, their values [P, n], observations [P, S]) at random states."""
    model, rng = env.mj_model, np.random.default_rng(0)
    qpos = rng.normal(0.0, 0.7, (PROBES, model.nq)).astype(np.float32)
    qvel = rng.normal(0.0, 1.5, (PROBES, model.nv)).astype(np.float32)
    for i in range(model.njnt):
        start = model.jnt_qposadr[i] + (3 if model.jnt_type[i] == FREE else 0)
        if model.jnt_type[i] in (FREE, BALL):
            q = rng.normal(size=(PROBES, 4))
            qpos[:, start : start + 4] = q / np.linalg.norm(q, axis=1, keepdims=True)
    action = rng.uniform(-1, 1, (PROBES, env.action_size)).astype(np.float32)
    keys = jax.random.split(jax.random.PRNGKey(0), PROBES)

    def one(q: jax.Array, v: jax.Array, a: jax.Array, key: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        world = env.physics.world(jnp.asarray(env.space.nominal), q, v)
        world = world.replace(task={"steps": jnp.zeros((), jnp.int32)} | env.start(key, world))
        drawn = {k: x for k, x in world.task.items() if _is_real(x)}
        shifted = {k: x + jax.random.normal(branch(key, i), x.shape) for i, (k, x) in enumerate(drawn.items())}
        world = world.replace(task=world.task | shifted)
        return env.observe(world, env.physics.kinematics(world), a)["policy"], shifted

    seen, task = jax.jit(jax.vmap(one))(qpos, qvel, action, keys)
    sources = _of_state(model, qpos, qvel)
    sources |= {f"action:{name}": action[:, i] for i, name in enumerate(env.actuator_names)}
    for name, value in task.items():
        flat = np.asarray(value).reshape(PROBES, -1)
        many = np.asarray(value).ndim > 1
        sources |= {f"task:{name}" + (f"[{i}]" if many else ""): flat[:, i] for i in range(flat.shape[1])}
    return list(sources), np.stack([*sources.values()], 1).astype(np.float64), np.asarray(seen, np.float64)


def _is_real(x: Any) -> bool:
    return bool(jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating))


def _of_state(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> dict[str, np.ndarray]:
    """Values [P] of the sources that follow from the state."""
    found: dict[str, np.ndarray] = {}
    for i in range(model.njnt):
        name, q, v, kind = _name(model, i), int(model.jnt_qposadr[i]), int(model.jnt_dofadr[i]), int(model.jnt_type[i])
        if kind in (HINGE, SLIDE):
            found |= {f"qpos:{name}": qpos[:, q], f"qvel:{name}": qvel[:, v]}
            if kind == HINGE:
                found |= {f"sin:{name}": np.sin(qpos[:, q]), f"cos:{name}": np.cos(qpos[:, q])}
            continue
        if kind == FREE:
            found |= _axes(f"position:{name}", qpos[:, q : q + 3])
            quat, spin = qpos[:, q + 3 : q + 7], qvel[:, v + 3 : v + 6]
        else:
            quat, spin = qpos[:, q : q + 4], qvel[:, v : v + 3]
        turn = np.asarray(jax.vmap(rotation)(jnp.asarray(quat)))
        found |= {f"quaternion:{name}.{axis}": quat[:, k] for k, axis in enumerate("wxyz")}
        found |= _axes(f"gravity:{name}", -turn[:, 2]) | _axes(f"turning:{name}", spin)
        found |= _axes(f"turning_world:{name}", np.einsum("pij,pj->pi", turn, spin))
        if kind == FREE:
            found |= _axes(f"velocity_world:{name}", qvel[:, v : v + 3])
            found |= _axes(f"velocity:{name}", np.einsum("pji,pj->pi", turn, qvel[:, v : v + 3]))
    return found


def _axes(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    return {f"{name}.{axis}": values[:, i] for i, axis in enumerate("xyz")}
