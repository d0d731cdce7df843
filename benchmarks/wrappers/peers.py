"""Other libraries on our worlds, peer by peer: lines of user code, steps per second beside the bare worlds, the return.

    python benchmarks/wrappers/peers.py [--task Cartpole] [--num_envs 1024] [--only sb3 skrl]
    python benchmarks/wrappers/peers.py --train [--only sb3]      # and train with the lines that are counted

The bare worlds are one jitted `vmap(env.step)` called step by step, or, for Brax, scanned; they never begin anew. Both
take the same random actions and are measured in turns, in seconds of the processor; the table has the median of their
ratio and its range. Lines are those of SNIPPETS, all that a user writes. Libraries that are not there are left out.
"""

import argparse
import importlib.util
import statistics
import tempfile
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

STEPS = 100  # of all worlds in one measurement
WORLDS = 64  # in training

# what a user writes, after `task`, `num_envs` and `folder`; training goes on after the line that makes `env`
SNIPPETS = {
    "sb3": """
from stable_baselines3 import PPO
from bayessim_mjx.wrappers import sb3
env = sb3.make(task, num_envs)
model = PPO("MlpPolicy", env, n_steps=64, batch_size=1024, n_epochs=5, learning_rate=1e-3, device="cpu", seed=0)
model.learn(300_000)
""",
    "rsl_rl": """
from rsl_rl.runners import OnPolicyRunner
from bayessim_mjx.wrappers import rsl_rl
env = rsl_rl.make(task, num_envs)
OnPolicyRunner(env, rsl_rl.settings(), log_dir=folder, device="cpu").learn(150, init_at_random_ep_len=True)
""",
    "skrl, JAX": """
from skrl.utils.runner.jax import Runner
from bayessim_mjx.wrappers import skrl
env = skrl.make(task, num_envs, library="jax")
Runner(env, skrl.settings(5000, folder)).run("train")
""",
    "skrl, PyTorch": """
from skrl.utils.runner.torch import Runner
from bayessim_mjx.wrappers import skrl
env = skrl.make(task, num_envs, library="torch")
Runner(env, skrl.settings(5000, folder)).run("train")
""",
    "rl_games": """
from rl_games.torch_runner import Runner
from bayessim_mjx.wrappers import rl_games
rl_games.register(task)
runner = Runner()
runner.load(rl_games.settings(task, num_envs, 100, folder))
agent = runner.algo_factory.create("a2c_continuous", base_name="run", params=runner.params)
agent.train()
found = agent.game_rewards.get_mean()[0]
""",
    "Brax": """
from bayessim_mjx.wrappers import brax
settings = dict(num_timesteps=400_000, num_evals=2, num_envs=num_envs, batch_size=16, num_minibatches=4)
settings |= dict(unroll_length=16, num_updates_per_batch=4, learning_rate=1e-3, discounting=0.99, entropy_cost=1e-3)
_, _, metrics = brax.train(task, normalize_observations=True, **settings)
found = metrics["eval/episode_reward"]
""",
    "Playground": """
from brax.training.agents.ppo import train as ppo
from mujoco_playground import registry, wrapper
from bayessim_mjx.wrappers import playground
playground.register()
env = registry.load(f"bayessim_mjx/{task}")
settings = dict(num_timesteps=400_000, num_evals=2, num_envs=num_envs, batch_size=16, num_minibatches=4)
settings |= dict(unroll_length=16, num_updates_per_batch=4, learning_rate=1e-3, discounting=0.99, entropy_cost=1e-3)
settings |= dict(wrap_env_fn=wrapper.wrap_for_brax_training, episode_length=500, normalize_observations=True)
_, _, metrics = ppo.train(environment=env, **settings)
found = metrics["eval/episode_reward"]
""",
    "Gymnasium": """
import gymnasium, bayessim_mjx
env = gymnasium.make_vec(f"bayessim_mjx/{task}-v0", num_envs=num_envs)
""",
}
IN_ONE_PROGRAM, UNTRAINED = ("Brax", "Playground"), ("Gymnasium",)  # it has no trainer
NEEDS = {
    "sb3": ("stable_baselines3",), "rsl_rl": ("rsl_rl",), "skrl, JAX": ("skrl",), "skrl, PyTorch": ("skrl", "torch"),
    "rl_games": ("rl_games",), "Brax": ("brax",),
    "Playground": ("mujoco_playground",), "Gymnasium": ("gymnasium",),
}  # fmt: skip


def seconds(run: Callable[[], None]) -> float:
    """Of the processor: other work on the machine takes none of them."""
    begun = time.process_time()
    run()
    return time.process_time() - begun


def stepper(env: Any, actions: np.ndarray) -> Callable[[], None]:
    """The bare worlds, one program called `STEPS` times."""
    keys = jax.random.split(jax.random.PRNGKey(0), len(actions))
    step = jax.jit(jax.vmap(env.step))
    state, given = jax.jit(jax.vmap(env.reset))(keys), jnp.asarray(actions)

    def run() -> None:
        after = state
        for _ in range(STEPS):
            after = step(after, given)
            jax.block_until_ready(after.reward)

    return run


def scanned(step: Callable[..., Any], state: Any, actions: np.ndarray) -> Callable[[], None]:
    """One program of `STEPS` steps."""
    given = jnp.asarray(actions)
    whole = jax.jit(lambda s: jax.lax.scan(lambda s, _: (step(s, given), None), s, length=STEPS)[0].reward)
    return lambda: jax.block_until_ready(whole(state))


def made(name: str, task: str, num_envs: int) -> Any:
    """The peer's environment."""
    if name == "rl_games":
        from rl_games.common import vecenv

        from bayessim_mjx.wrappers import rl_games

        rl_games.register(task)
        return vecenv.create_vec_env(task, num_envs)
    space: dict[str, Any] = {"task": task, "num_envs": num_envs}
    lines = SNIPPETS[name].strip().splitlines()
    exec("\n".join(lines[: next(i for i, line in enumerate(lines) if line.startswith("env =")) + 1]), space)
    return space["env"]


def through(name: str, task: str, num_envs: int, actions: np.ndarray) -> Callable[[], None]:
    """`STEPS` steps by the peer's interface, with actions of its kind."""
    if name == "Brax":
        from bayessim_mjx.wrappers import brax, fresh

        env = fresh.wrap(brax.ours(task))
    else:
        env = made(name, task, num_envs)
    if name == "Playground":
        from mujoco_playground import wrapper

        env = wrapper.wrap_for_brax_training(env, episode_length=500)
    if name in IN_ONE_PROGRAM:
        state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), num_envs))
        return scanned(env.step, state, actions)
    env.reset()
    given: Any = actions
    if name in ("rsl_rl", "skrl, PyTorch", "rl_games"):
        import torch

        given = torch.from_numpy(actions)
    elif name == "skrl, JAX":
        given = jnp.asarray(actions)

    def run() -> None:
        for _ in range(STEPS):
            out = env.step(given)
            jax.block_until_ready([x for x in out if isinstance(x, jax.Array)])

    return run


def measured(name: str, task: str, num_envs: int, repeats: int) -> tuple[float, list[float]]:
    """(steps per second, share of the bare worlds' in each turn)."""
    from bayessim_mjx import registry

    env = registry.make(task)
    actions = np.random.default_rng(0).uniform(-1, 1, (num_envs, env.action_size)).astype(np.float32)
    keys = jax.random.split(jax.random.PRNGKey(0), num_envs)
    if name in IN_ONE_PROGRAM:
        bare = scanned(jax.vmap(env.step), jax.jit(jax.vmap(env.reset))(keys), actions)
    else:
        bare = stepper(env, actions)
    wrapped = through(name, task, num_envs, actions)
    for run in (bare, wrapped):  # compile
        run()
    turns = [(seconds(bare), seconds(wrapped)) for _ in range(repeats)]
    return STEPS * num_envs / statistics.median(b for _, b in turns), [a / b for a, b in turns]


def trained(name: str, task: str) -> float:
    """The return that the lines reach: of the episodes that ended last, or the library's own figure `found`."""
    from bayessim_mjx.wrappers.agents.shared import Recent

    lines, recent = SNIPPETS[name].strip().splitlines(), None
    with tempfile.TemporaryDirectory() as folder:
        space: dict[str, Any] = {"task": task, "num_envs": WORLDS, "folder": folder}
        for line in lines:
            exec(line, space)
            if line.startswith("env =") and "found" not in lines[-1]:
                recent = Recent(space["env"].worlds)
    return float(space["found"]) if recent is None else recent.metrics()["Train/mean_reward"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Cartpole")
    parser.add_argument("--num_envs", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--train", action="store_true", help=f"and train, {WORLDS} worlds")
    parser.add_argument("--only", nargs="+", choices=list(SNIPPETS), default=list(SNIPPETS))
    args = parser.parse_args()
    print(
        "| library | lines | steps per core-second | of the bare worlds | return |\n|---|---|---|---|---|", flush=True
    )
    for name in args.only:
        if any(importlib.util.find_spec(module) is None for module in NEEDS[name]):
            continue
        speed, shares = measured(name, args.task, args.num_envs, args.repeats)
        share = f"{statistics.median(shares):.0%} ({min(shares):.0%} to {max(shares):.0%})"
        reached = f"{trained(name, args.task):.0f}" if args.train and name not in UNTRAINED else ""
        count = len(SNIPPETS[name].strip().splitlines())
        print(f"| {name} | {count} | {speed:,.0f} | {share} | {reached} |", flush=True)


if __name__ == "__main__":
    main()
