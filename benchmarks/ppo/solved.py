"""Seconds and steps of training until a task is solved at nominal physics, several seeds.

    python benchmarks/ppo/solved.py --tasks Ant Humanoid Ingenuity --seeds 0 1 2

A deterministic evaluation of 128 episodes is made every --every updates; the task is solved at the first one whose mean
return reaches the line. Compilation and evaluations are counted apart from the seconds of training. A row of JSON for
each task and seed; the seeds of a task share its programs. Settings (`ppo.entropy_coef=.003`) may stand anywhere.
"""

import argparse
import json
import sys
import time
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx import config, registry, rl

# task: (worlds, return, seconds on an A100 that its ancestor published or None)
LINES: dict[str, tuple[int, float, float | None]] = {
    "Quadcopter": (8192, 1200, None),
    "BallBalance": (4096, 300, None),
    "Ingenuity": (4096, 5000, 30),
    "Ant": (4096, 3000, 20),
    "Humanoid": (4096, 5000, 240),
    "Anymal": (4096, 60, None),
    "FrankaCabinet": (4096, 2400, None),
    "ShadowHand": (16384, 3000, 300),
}
EPISODES = 128


class Race:
    """A task and its programs, for one seed after the other."""

    def __init__(self, task: str, every: int, overrides: list[str]) -> None:
        worlds, self.line, _ = LINES[task]
        settings = config.load(task, overrides=[f"env.numEnvs={worlds}", "task.randomize=False", *overrides])
        self.env, self.ppo = registry.make(task, config=settings), replace(settings.ppo, log_interval=every)
        self.every, self.most = every, settings.ppo.max_iterations
        self.thetas = jnp.tile(jnp.asarray(self.env.space.nominal, jnp.float32), (EPISODES, 1))

    def evaluation(self, state: Any) -> float:
        result = rl.evaluate(self.env, rl.policy_of(state), jax.random.PRNGKey(1), self.thetas)
        return float(np.asarray(result["return"]).mean())

    def run(self, seed: int, seconds: float) -> dict[str, Any]:
        """Train until solved, or until so many seconds are over."""
        began = time.perf_counter()
        state = rl.init(self.env, self.ppo, jax.random.PRNGKey(seed), None)
        state, _ = rl.run(self.env, self.ppo, state, None, iterations=self.every)
        jax.block_until_ready(state.params)
        returns = [self.evaluation(state)]
        first, training, evaluating = time.perf_counter() - began, 0.0, 0.0
        while returns[-1] < self.line and int(state.iteration) < self.most and time.perf_counter() - began < seconds:
            at = time.perf_counter()
            state, _ = rl.run(self.env, self.ppo, state, None, iterations=self.every)
            jax.block_until_ready(state.params)
            training += time.perf_counter() - at
            at = time.perf_counter()
            returns.append(self.evaluation(state))
            evaluating += time.perf_counter() - at
        updates = int(state.iteration)
        # the first updates compile: they count as long as the later ones take
        pace = training / (updates - self.every) if updates > self.every else float("nan")
        return {
            "seed": seed, "solved": returns[-1] >= self.line, "return": round(returns[-1], 1),
            "steps_m": round(updates * self.ppo.num_envs * self.ppo.num_steps / 1e6, 2),
            "train_s": round(pace * updates, 2), "first_s": round(first, 1), "evaluations_s": round(evaluating, 1),
            "steps_per_s_m": round(self.ppo.num_envs * self.ppo.num_steps / pace / 1e6, 3),
            "returns": [round(r) for r in returns],
        }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=list(LINES), default=list(LINES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--every", type=int, default=10, help="updates between evaluations")
    parser.add_argument("--seconds", type=float, default=1e9, help="most seconds of a seed")
    overrides = [word for word in sys.argv[1:] if "=" in word and not word.startswith("-")]  # key=value, anywhere
    args = parser.parse_args([word for word in sys.argv[1:] if word not in overrides])
    for task in args.tasks:
        race = Race(task, args.every, overrides)
        for seed in args.seeds:
            told = race.run(seed, args.seconds)
            print(json.dumps({"task": task, "device": jax.devices()[0].device_kind} | told), flush=True)


if __name__ == "__main__":
    main()
