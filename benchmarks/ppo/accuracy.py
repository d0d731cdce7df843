"""How far tasks' physics are from MuJoCo C once its solver has converged: MJX, MuJoCo Warp, C with the task's options.

    python benchmarks/ppo/accuracy.py --tasks Humanoid Anymal --steps 1 5 10

Some worlds at nominal physics from random first states, random commands that are held for a control step. Lines of
JSON: median over worlds of the largest difference of a speed (rad/s or m/s) and of a coordinate, after so many control
steps. Warp needs warp-lang; on a CPU its kernels take minutes to compile.
"""

import argparse
import copy
import json
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx import registry
from bayessim_mjx.physics import control_step
from bayessim_mjx.physics.implementation import installed

TASKS = ("Ant", "Humanoid", "Anymal", "FrankaCabinet", "ShadowHand")
CONVERGED = (200, 100, 1e-12)  # iterations of the solver, of its line search; tolerance
SHARE = 0.3  # of the range of a command around its middle


def commands(model: mujoco.MjModel, steps: int, worlds: int, rng: np.random.Generator) -> np.ndarray:
    """`[steps, worlds, nu]`, uniform; a command without limits is taken to have -1 and 1."""
    limited = model.actuator_ctrllimited.astype(bool)[:, None]
    low, high = np.where(limited, model.actuator_ctrlrange, [-1.0, 1.0]).T
    drawn = rng.uniform(-SHARE, SHARE, (steps, worlds, model.nu))
    return np.asarray(0.5 * (low + high) + (high - low) * drawn, np.float32)


def in_c(env: Any, qpos: np.ndarray, qvel: np.ndarray, command: np.ndarray, converged: bool) -> np.ndarray:
    """Coordinates and speeds `[steps, worlds, nq + nv]` of MuJoCo C."""
    model = copy.copy(env.mj_model)
    if converged:
        model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = CONVERGED
    moved = np.zeros((*command.shape[:2], model.nq + model.nv))
    for world in range(len(qpos)):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos[world], qvel[world]
        for step, row in enumerate(command[:, world]):
            data.ctrl[:] = row
            mujoco.mj_step(model, data, env.physics.substeps)
            moved[step, world] = np.concatenate([data.qpos, data.qvel])
    return moved


def in_jax(env: Any, qpos: jax.Array, qvel: jax.Array, command: np.ndarray) -> np.ndarray:
    """The same by the environment's own physics."""
    theta = jnp.asarray(env.space.nominal, jnp.float32)

    def one(qpos: jax.Array, qvel: jax.Array, command: jax.Array) -> jax.Array:
        def step(world: Any, row: jax.Array) -> tuple[Any, jax.Array]:
            world, _ = control_step(env.physics, world, row)
            return world, jnp.concatenate([world.qpos, world.qvel])

        return jax.lax.scan(step, env.physics.world(theta, qpos, qvel), command)[1]

    return np.asarray(jax.jit(jax.vmap(one, in_axes=(0, 0, 1), out_axes=1))(qpos, qvel, command))


def measure(task: str, worlds: int, steps: Sequence[int], seed: int) -> None:
    impls = ("jax", "warp") if installed() else ("jax",)
    envs = {impl: registry.make(task, impl=impl, numEnvs=worlds) for impl in impls}
    env = envs["jax"]
    qpos, qvel = jax.vmap(env.initial)(jax.random.split(jax.random.PRNGKey(seed), worlds))
    command = commands(env.mj_model, max(steps), worlds, np.random.default_rng(seed))
    exact = in_c(env, qpos, qvel, command, converged=True)
    moved = {"c": in_c(env, qpos, qvel, command, converged=False)}
    moved |= {impl: in_jax(own, qpos, qvel, command) for impl, own in envs.items()}
    nq, opt = env.mj_model.nq, env.mj_model.opt
    for who, values in moved.items():
        away = np.abs(values - exact)
        row = {"task": task, "who": who, "iterations": [opt.iterations, opt.ls_iterations]}
        for step in steps:
            place, speed = (np.median(x.max(-1)) for x in np.split(away[step - 1], [nq], axis=-1))
            row[f"after {step}"] = {"speed": float(f"{speed:.2g}"), "place": float(f"{place:.2g}")}
        print(json.dumps(row), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--worlds", type=int, default=8)
    parser.add_argument("--steps", nargs="+", type=int, default=(1, 5, 10), help="control steps after which to look")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for task in args.tasks:
        measure(task, args.worlds, args.steps, args.seed)


if __name__ == "__main__":
    main()
