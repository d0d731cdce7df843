"""PPO on our Ant, nominal physics: steps/s and return, next to Brax PPO on the same task and device in the same run.

    python benchmarks/ppo/ant.py --iterations 500 --num_envs 4096 --brax_steps 10000000

Compilation is counted apart. Brax trains the same environment object through Brax's own protocol, with its published
Ant hyperparameters; its returns are of its own evaluation episodes. One removed JAX function is put back for it. With
`env.impl=warp --brax_impl jax` ours has its physics by MuJoCo Warp and Brax the JAX implementation that it comes with.
"""

import argparse
import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx import config, registry, rl


def ours(env, settings, iterations: int, seed: int) -> None:
    ppo = replace(settings.ppo, log_interval=10)
    started = time.perf_counter()
    state = rl.init(env, ppo, jax.random.PRNGKey(seed), None)
    state, _ = rl.run(env, ppo, state, None, iterations=1)
    jax.block_until_ready(state.params)
    compile_s = time.perf_counter() - started
    started = time.perf_counter()

    def progress(metrics, state):
        if int(state.iteration) % 50 == 1 or int(state.iteration) >= iterations:
            shown = (
                "env_steps",
                "Train/mean_reward",
                "Train/mean_episode_length",
                "Perf/total_fps",
                "Loss/learning_rate",
            )
            numbers = "  ".join(f"{name.split('/')[-1]} {metrics[name]:.4g}" for name in shown)
            print(f"ours  {time.perf_counter() - started:6.1f} s  it {int(state.iteration)}  {numbers}", flush=True)

    state, _ = rl.run(env, ppo, state, None, iterations=iterations - 1, progress=progress)
    seconds = time.perf_counter() - started
    steps = (iterations - 1) * ppo.num_envs * ppo.num_steps
    thetas = jnp.tile(jnp.asarray(env.space.nominal), (256, 1))
    result = rl.evaluate(env, rl.policy_of(state), jax.random.PRNGKey(1), thetas)
    returns = np.asarray(result["return"])
    print(
        f"ours: {steps / seconds / 1e6:.3f} M env-steps/s training, {steps / 1e6:.1f} M steps in {seconds:.1f} s, "
        f"first iteration with compilation {compile_s:.1f} s, evaluation {returns.mean():.0f} +- {returns.std():.0f}",
        flush=True,
    )


def brax(env, steps: int, num_envs: int, seed: int) -> None:
    from brax.training.agents.ppo import train as ppo_train

    marks = []

    def progress(step, metrics):
        marks.append(float(metrics.get("training/sps", 0)))
        reward = float(metrics["eval/episode_reward"])
        print(f"brax  steps {step:10d} return {reward:8.1f} sps {marks[-1]:10.0f}", flush=True)

    ppo_train.train(
        environment=env, num_timesteps=steps, num_evals=4, episode_length=env.episode_length, num_envs=num_envs,
        seed=seed, batch_size=2048, num_minibatches=32, num_updates_per_batch=4, unroll_length=5, discounting=0.97,
        learning_rate=3e-4, entropy_cost=1e-2, reward_scaling=10, normalize_observations=True, progress_fn=progress,
        num_eval_envs=128,
    )  # fmt: skip
    print(f"brax: {marks[-1] / 1e6:.3f} M env-steps/s training (its own training/sps of the last epoch)", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="Ant")
    parser.add_argument("--iterations", type=int, default=500)
    parser.add_argument("--num_envs", type=int, default=4096)
    parser.add_argument("--brax_steps", type=int, default=0, help="0: leave Brax out")
    parser.add_argument(
        "--brax_impl", choices=("same", "jax", "warp"), default="same", help="the physics of Brax's worlds"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_args()
    settings = config.load(args.task, overrides=[f"env.numEnvs={args.num_envs}", *args.overrides])
    env = registry.make(args.task, config=settings)
    print(jax.devices(), settings.ppo, flush=True)
    ours(env, settings, args.iterations, args.seed)
    if args.brax_steps:
        if args.brax_impl != "same":
            overrides = [f"env.numEnvs={args.num_envs}", *args.overrides, f"env.impl={args.brax_impl}"]
            env = registry.make(args.task, config=config.load(args.task, overrides=overrides))
        brax(env, args.brax_steps, args.num_envs, args.seed)


if __name__ == "__main__":
    main()
