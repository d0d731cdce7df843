"""Our PPO against Brax's on the same environments, hyperparameters and device; and against the machine's limits.

    python benchmarks/ppo/speed.py                        # speed and time to reward, one seed
    python benchmarks/ppo/speed.py --seeds 5 --steps 20e6  # reward at equal samples
    python benchmarks/ppo/speed.py --limit                # rollout against bare mjx.step, SGD against its arithmetic
    python benchmarks/ppo/speed.py --scaling              # 1k to 64k worlds; weak scaling, curves on 1, 2, 4 devices

One line of JSON per row, as it comes. Every race runs in a process of its own without any cache: its seconds are those
since its command was given, imports and compilation included. Brax is judged by its own evaluations (128 episodes, as
many as published); `seconds_without_evals` is without all of their time. Ours is judged by the same evaluation of the
policies that it had at its log intervals, after the race; `training` has the returns of the last 100 episodes of
training, which lag by an episode. `steps_per_s` is of training alone: the median over epochs or log intervals after
the first. Ours ends once five intervals were over the goal in training: single ones are, by chance, before the policy
is. "wide" is ours with four times the worlds and a quarter of the steps: the same samples per update; "wider" with
eight times. Ours has Brax's segments and first weights (`ppo.segment`, `ppo.weight_init`), too. Where Brax restarts all
worlds before every update (CartpoleBalance), ours has training episodes of an update's length (Go1's: of 14); goals are
those of whole episodes. A function that JAX no longer has is put back for Brax.
"""

import argparse
import contextlib
import functools
import json
import os
import statistics
import subprocess
import sys
import time
from dataclasses import replace

from published import PUBLISHED, SOLVED, between_restarts, ppo_config

WAYS = {"ours": 1, "wide": 4, "wider": 8, "brax": 1}  # and what the number of worlds is multiplied by


def say(row: dict) -> None:
    """A row as a line of JSON."""
    print(json.dumps(row), flush=True)


class Race:
    """What one of them showed: [steps, seconds, reward], and when it got there."""

    def __init__(self, started: float, goal: float, limit: float | None) -> None:
        self.started, self.goal, self.limit = started, goal, limit
        self.curve: list[list[float]] = []
        self.marks: dict[str, float] = {}

    def seconds(self) -> float:
        return round(time.time() - self.started, 2)

    def mark(self, name: str) -> None:
        """Note when something was done."""
        self.marks[name] = self.seconds()

    def over(self, reward: float) -> bool:
        """Whether to stop here: the goal is reached, or the time is over."""
        return reward >= self.goal or self.late()

    def late(self) -> bool:
        return self.limit is not None and self.seconds() > self.limit

    def row(self, speeds: list[float]) -> dict:
        reached = next((point for point in self.curve if point[2] >= self.goal), [None, None, None])
        later = speeds[1:] or speeds
        return {
            "steps_per_s": round(statistics.median(later)) if later else None,
            "seconds_to_reward": reached[1],
            "steps_to_reward": reached[0],
            "marks": self.marks,
            "curve": self.curve,
        }


class Over(Exception):
    """The race is."""


def run_ours(name: str, published: dict, seed: int, race: Race, task: dict) -> dict:
    """Until the goal, or four times the steps; `whole`: all steps, however early the goal is reached."""
    race.mark("python")
    import jax

    from bayessim_mjx import registry, rl

    race.mark("imports")
    config, whole = ppo_config(published, WAYS[task["who"]], **task["ours"]), task["whole"]
    whole_env = registry.make(name, impl=task["impl"], episodeLength=published["episode_length"])
    length = min(published["episode_length"], between_restarts(published) * config.num_steps)
    env, share = registry.make(name, impl=task["impl"], episodeLength=length), length / published["episode_length"]
    total = max(1, round(published["num_timesteps"] / (config.num_envs * config.num_steps)))
    config = replace(config, log_interval=max(1, total // 50))
    row: dict = {"worlds": config.num_envs, "training": []}
    speeds: list[float] = []
    policies: list = []

    def progress(metrics: dict, state) -> None:
        speeds.append(metrics["Perf/total_fps"])
        policies.append((int(metrics["env_steps"]), race.seconds(), jax.device_get(rl.policy_of(state))))
        row["training"].append(round(metrics["Train/mean_reward"], 1))
        enough = sum(x >= race.goal * share for x in row["training"]) >= 5
        if race.late() or (enough and not whole):
            raise Over

    race.mark("environment")
    state = rl.start(env, config, jax.random.PRNGKey(seed))
    race.mark("compiled")
    with contextlib.suppress(Over):
        rl.run(env, config, state, iterations=total if whole else 4 * total, progress=progress)
    say({"env": name, "unjudged": row | {"steps": [p[0] for p in policies], "seconds": [p[1] for p in policies]}})
    for (steps, taken, _), reward in zip(policies, judged(whole_env, policies), strict=True):
        race.curve.append([steps, taken, reward])
    return race.row(speeds) | row | {"reward": race.curve[-1][2], "steps": race.curve[-1][0]}


def judged(env, policies: list) -> list[float]:
    """Mean returns of 128 episodes of each policy, with its noise, as Brax evaluates."""
    import jax
    import jax.numpy as jnp

    from bayessim_mjx import rl

    thetas = jnp.zeros((len(policies), 128, 0))
    found = rl.evaluate_together(env, [p[2] for p in policies], jax.random.PRNGKey(1), thetas, deterministic=False)
    return [round(float(x), 1) for x in found["return"].mean(1)]


def run_brax(name: str, published: dict, seed: int, race: Race, task: dict) -> dict:
    """Brax's trainer as published, on its own environment."""
    race.mark("python")
    from brax.training.agents.ppo import train
    from brax.training.agents.ppo.networks import make_ppo_networks

    from bayessim_mjx import registry

    options, speeds, whole = dict(published), [], task["whole"]
    if networks := options.pop("network_factory", None):
        options["network_factory"] = functools.partial(make_ppo_networks, **networks)
    if name.startswith("playground:"):
        from mujoco_playground import wrapper

        options["wrap_env_fn"] = wrapper.wrap_for_brax_training

    evaluations = [0.0]

    def progress(steps: int, metrics: dict) -> None:
        reward = float(metrics["eval/episode_reward"])
        race.curve.append([int(steps), race.seconds(), round(reward, 1)])
        evaluations[0] = float(metrics["eval/walltime"])  # of all so far
        if "training/sps" in metrics:
            speeds.append(float(metrics["training/sps"]))
        say({"env": name, "brax": race.curve[-1]})
        if race.late() or (race.over(reward) and not whole):
            raise Over

    race.mark("imports")
    with contextlib.suppress(Over):
        train.train(environment=registry.make(name, impl=task["impl"]).env, seed=seed, progress_fn=progress, **options)
    row = race.row(speeds) | {"reward": race.curve[-1][2], "steps": race.curve[-1][0], "worlds": options["num_envs"]}
    if row["seconds_to_reward"] is not None and not whole:
        row["seconds_without_evals"] = round(row["seconds_to_reward"] - evaluations[0], 2)
    return row


def work(task: dict) -> None:
    """One row, in this process."""
    import jax

    name, published = task["env"], PUBLISHED[task["env"]] | task["changes"]
    race = Race(task["started"], SOLVED.get(name, float("inf")), task["limit"])
    if task["who"] == "brax":
        row = run_brax(name, published, task["seed"], race, task)
    else:
        row = run_ours(name, published, task["seed"], race, task) | {"ours": task["ours"]}
    about = {"who": task["who"], "env": name, "impl": task["impl"], "seed": task["seed"]}
    say(about | {"device": jax.devices()[0].device_kind, "jax": jax.__version__} | row)


def race(args: argparse.Namespace) -> None:
    """All environments, ways and seeds, each in a process of its own."""
    changes = {"num_timesteps": int(args.steps)} if args.steps else {}
    changes |= json.loads(args.changes)
    environment = {**os.environ, "BAYESSIM_MJX_CACHE": "off"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    for name in args.envs:
        for seed in range(args.first, args.first + args.seeds):
            for who in args.who:
                whole = bool(args.steps) or args.whole
                task = {
                    "who": who,
                    "env": name,
                    "seed": seed,
                    "changes": changes,
                    "whole": whole,
                    "limit": args.seconds,
                    "impl": args.impl,
                    "ours": json.loads(args.ours),
                }
                words = json.dumps(task | {"started": time.time()})
                try:
                    subprocess.run(
                        [sys.executable, __file__, "--work", words], env=environment, check=True, timeout=args.timeout
                    )
                except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
                    say({"who": who, "env": name, "seed": seed, "failed": str(error)[-300:]})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="*", default=list(PUBLISHED), choices=list(PUBLISHED))
    parser.add_argument("--who", nargs="*", default=list(WAYS), choices=list(WAYS))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--steps", type=float, default=0, help="environment steps of all; 0: as published")
    parser.add_argument("--whole", action="store_true", help="ours goes on after the goal, too")
    parser.add_argument("--changes", default="{}", help="of the published settings, JSON")
    parser.add_argument("--ours", default="{}", help='of our PPO settings in the race, JSON: {"precision": "bfloat16"}')
    parser.add_argument("--impl", choices=("jax", "warp"), default="jax", help="physics of Playground's environments")
    parser.add_argument("--seconds", type=float, default=None, help="after which a race ends with what it has")
    parser.add_argument("--timeout", type=float, default=None, help="seconds after which a race is given up")
    parser.add_argument("--limit", action="store_true")
    parser.add_argument("--compilation", action="store_true", help="the compiler's options, measured")
    parser.add_argument("--scaling", nargs="*", choices=["worlds", "devices", "curve"], default=None)
    parser.add_argument("--task", default="Ant", help="of the measures that are no race")
    parser.add_argument("--worlds", type=int, nargs="*", help="of the measures that are no race")
    parser.add_argument("--iterations", type=int, default=50, help="of the measures that are no race")
    parser.add_argument("--work", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.work:
        work(json.loads(args.work))
    elif args.limit or args.compilation or args.scaling is not None:
        import limits

        limits.measure(args, say)
    else:
        race(args)


if __name__ == "__main__":
    main()
