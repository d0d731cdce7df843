"""Returns with MuJoCo Warp beside those with JAX, through a wrapper's worlds and through our own collection.

    python benchmarks/wrappers/warp_returns.py [--task Ant Humanoid] [--num_envs 2048 8192] [--steps 100]

Both implementations get the same first states, nominal parameters, random actions and iterations of the solver (20, as
Warp makes in any case). A line for each task, number of worlds and path has the mean return of a world over the steps
with its standard error, and how many episodes ended for good. The exit code is 1 where the means differ by more than 4
standard errors of their difference, or where contacts had no room. Nobody tells Warp how many worlds step together.
"""

import argparse
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx import registry
from bayessim_mjx.errors import UserError
from bayessim_mjx.rollout import rollout
from bayessim_mjx.wrappers.worlds import worlds

ITERATIONS = 20  # of the solver and its line search
FAR = 4.0  # standard errors


def made(task: str, impl: str) -> Any:
    """The task with a solver that has the iterations which Warp takes."""
    kind = type(registry.make(task))

    def spec(self: Any) -> Any:
        found = kind.spec(self)
        found.option.iterations = found.option.ls_iterations = ITERATIONS
        return found

    return type(kind.__name__, (kind,), {"spec": spec, "__module__": kind.__module__})({"impl": impl})


def actions(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    return jnp.clip(jax.random.normal(key, shape), -1.0, 1.0)


def through_worlds(env: Any, count: int, steps: int) -> tuple[np.ndarray, int]:
    """As SB3, rsl_rl, skrl and rl_games have them: (rewards of each world over the steps [N], ends for good)."""
    batch, total, ended = worlds(env, count, seed=0), np.zeros(count), 0
    batch.reset()
    for step in range(steps):
        after = batch.step(actions(jax.random.PRNGKey(step), (count, env.action_size)))
        total += np.asarray(after.reward)
        ended += int(after.terminated.sum())
    return total, ended


def through_collection(env: Any, count: int, steps: int) -> tuple[np.ndarray, int]:
    """As the loop collects its training set: one episode in each world."""
    thetas = jnp.tile(jnp.asarray(env.space.nominal, jnp.float32), (count, 1))

    def act(key: jax.Array, obs: dict[str, jax.Array]) -> jax.Array:
        return actions(key, (env.action_size,))

    found = rollout(env, act, jax.random.PRNGKey(0), thetas, steps)
    if not bool(jnp.isfinite(found.observation).all()):
        raise UserError("contacts had no room in the collection")
    return np.asarray(found.reward.sum(1)), int(found.terminated.sum())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", nargs="+", default=["Ant", "Humanoid"])
    parser.add_argument("--num_envs", nargs="+", type=int, default=[2048, 8192])
    parser.add_argument("--steps", type=int, default=100)
    args = parser.parse_args()
    print(f"device: {jax.devices()[0].device_kind}; {args.steps} steps", flush=True)
    failed = 0
    for task in args.task:
        envs = {impl: made(task, impl) for impl in ("jax", "warp")}
        for count in args.num_envs:
            for path in (through_worlds, through_collection):
                failed += not compared(task, count, path, envs, args.steps)
    return int(failed > 0)


def compared(task: str, count: int, path: Any, envs: dict[str, Any], steps: int) -> bool:
    """Whether both implementations give the same returns; one line says how far they are apart."""
    told, means, errors = [], [], []
    label = f"{task}, {count} worlds, {path.__name__.replace('_', ' ')}"
    try:
        for impl, env in envs.items():
            returns, ended = path(env, count, steps)
            means.append(float(returns.mean()))
            errors.append(float(returns.std(ddof=1)) / count**0.5)
            told.append(f"{impl} {means[-1]:.4g} +- {errors[-1]:.2g} ({ended} ended)")
    except UserError as error:
        print(f"{label}: {'; '.join(told)}; {error}", flush=True)
        return False
    apart = abs(means[0] - means[1]) / max(float(np.hypot(*errors)), 1e-12)
    print(f"{label}: {'; '.join(told)}; {apart:.1f} standard errors apart", flush=True)
    return apart <= FAR


if __name__ == "__main__":
    sys.exit(main())
