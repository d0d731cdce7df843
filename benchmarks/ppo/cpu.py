"""CartPole-v1 on one processor core: seconds and samples until it is solved, ours against stable-baselines3 and rsl_rl.

    python benchmarks/ppo/cpu.py --seeds 5 [--peers PYTHON]   # an interpreter that has torch and the two peers

Solved: 100 deterministic episodes last 475 steps on average. All policies are judged by the same simulation, after each
2048 samples and with the clock stopped; else the seconds are those since the command was given, imports and compilation
included. "second start" is ours with the compiled programs of the first one on the disk.

stable-baselines3 runs gymnasium's environment, with the settings that its model zoo publishes for it. rsl_rl and ours
act continuously: they push to the side of the action's sign. rsl_rl gets the same equations in torch and our settings.
"""

import argparse
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import numpy as np

GOAL, LIMIT, EPISODES = 475.0, 500, 100
FAR, TILTED = 2.4, 12 * 2 * np.pi / 360  # m, rad
BETWEEN = 2048  # samples from one judgement to the next
MOST = 300_000  # samples
WORLDS, STEPS = 32, 64  # of ours and of rsl_rl
HIDDEN, EPOCHS, MINIBATCHES, GAMMA, LAMBDA = (64, 64), 10, 4, 0.98, 0.9
RATES = {"fixed": 1e-3, "adaptive": 3e-3}  # at the start
BETTER = ("fixed", "adaptive")  # of ours, and of rsl_rl: its other one takes it 98304 samples
WAYS = ("ours", "second start", "sb3", "rsl_rl")


class Over(Exception):
    """Solved, or given up."""


def moved(math: Any, state: Any, right: Any) -> tuple:
    """gymnasium's CartPole after 0.02 s: position, speed, angle and rate, arrays of one shape; pushed with 10 N."""
    x, speed, angle, rate = state
    sine, cosine = math.sin(angle), math.cos(angle)
    push = (20.0 * right - 10.0 + 0.05 * rate**2 * sine) / 1.1
    turn = (9.8 * sine - cosine * push) / (0.5 * (4.0 / 3.0 - 0.1 * cosine**2 / 1.1))
    pull = push - 0.05 * turn * cosine / 1.1
    return x + 0.02 * speed, speed + 0.02 * pull, angle + 0.02 * rate, rate + 0.02 * turn


def fallen(x: Any, angle: Any) -> Any:
    return (abs(x) > FAR) | (abs(angle) > TILTED)


def judged(right: Callable[[np.ndarray], np.ndarray]) -> float:
    """Mean length of 100 episodes; right(observation [100, 4]) says where to push."""
    state = np.random.default_rng(12345).uniform(-0.05, 0.05, (EPISODES, 4))
    alive, total = np.ones(EPISODES, bool), 0
    for _ in range(LIMIT):
        total += alive.sum()
        state = np.stack(moved(np, state.T, right(state.astype(np.float32))), -1)
        alive &= ~fallen(state[:, 0], state[:, 2])
    return total / EPISODES


class Clock:
    """Seconds since the command was given, but for those spent on judging."""

    def __init__(self, started: float) -> None:
        self.started, self.curve = started, []  # type: ignore[var-annotated]
        self.ready: float | None = None  # when training began

    def seconds(self) -> float:
        return round(time.time() - self.started, 2)

    def judge(self, samples: int, right: Callable[[np.ndarray], np.ndarray]) -> None:
        """Note how good the policy is after so many samples; Over where that is enough."""
        before = self.seconds()
        length = judged(right)
        self.curve.append([samples, before, length])
        self.started += self.seconds() - before
        if length >= GOAL or samples >= MOST:
            raise Over


def run_ours(seed: int, clock: Clock, schedule: str) -> None:
    import jax
    import jax.numpy as jnp

    from bayessim_mjx import rl
    from bayessim_mjx.config import PPOConfig
    from bayessim_mjx.env import State

    class CartPole:
        action_size, observation_size, episode_length = 1, {"policy": (4,)}, LIMIT

        class space:
            nominal = np.zeros(0, np.float32)

        def reset(self, key: jax.Array, theta: jax.Array | None = None) -> State:
            return self.shown(jax.random.uniform(key, (4,), minval=-0.05, maxval=0.05), jnp.int32(0))

        def step(self, state: State, action: jax.Array) -> State:
            return self.shown(jnp.stack(moved(jnp, state.pipeline_state, action[0] > 0)), state.info["steps"] + 1)

        def shown(self, world: jax.Array, steps: jax.Array) -> State:
            obs = {"policy": world}
            down = fallen(world[0], world[2]).astype(jnp.float32)
            late = (steps >= LIMIT).astype(jnp.float32)
            info = {"terminated": down, "truncated": late, "final_observation": obs, "steps": steps}
            return State(world, obs, jnp.float32(1), down, {}, info)

    config = PPOConfig(
        num_envs=WORLDS, num_steps=STEPS, num_epochs=EPOCHS, num_minibatches=MINIBATCHES, gamma=GAMMA,
        gae_lambda=LAMBDA, schedule=schedule, learning_rate=RATES[schedule],
        hidden_actor=HIDDEN, hidden_critic=HIDDEN, log_interval=1,
    )  # fmt: skip
    mean = jax.jit(lambda policy, obs: policy.distribution(obs)[0][:, 0] > 0)

    def progress(metrics: dict, state: rl.TrainState) -> None:
        policy = rl.policy_of(state)
        clock.judge(int(metrics["env_steps"]), lambda obs: np.asarray(mean(policy, obs)))

    env = CartPole()
    state = rl.start(env, config, jax.random.PRNGKey(seed))
    clock.ready = clock.seconds()
    rl.run(env, config, state, iterations=2 * MOST // BETWEEN, progress=progress)


def run_sb3(seed: int, clock: Clock, _: str) -> None:
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.utils import LinearSchedule

    torch.set_num_threads(1)

    class Judge(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_start(self) -> None:  # after the update
            if self.num_timesteps and self.num_timesteps % BETWEEN == 0:
                clock.judge(self.num_timesteps, lambda obs: self.model.predict(obs, deterministic=True)[0])

    # of rl-baselines3-zoo, for CartPole-v1
    model = PPO(
        "MlpPolicy", make_vec_env("CartPole-v1", n_envs=8, seed=seed), n_steps=32, batch_size=256, gae_lambda=0.8,
        gamma=0.98, n_epochs=20, ent_coef=0.0, learning_rate=LinearSchedule(1e-3, 0.0, 1.0),
        clip_range=LinearSchedule(0.2, 0.0, 1.0), seed=seed, device="cpu",
    )  # fmt: skip
    clock.ready = clock.seconds()
    model.learn(100_000, callback=Judge())


def run_rsl_rl(seed: int, clock: Clock, schedule: str) -> None:
    import torch
    from rsl_rl.env import VecEnv
    from rsl_rl.runners import OnPolicyRunner
    from tensordict import TensorDict

    torch.set_num_threads(1)
    torch.manual_seed(seed)

    class CartPole(VecEnv):
        num_envs, num_actions, max_episode_length, device, cfg = WORLDS, 1, LIMIT, "cpu", {}

        def __init__(self) -> None:
            self.state = self.fresh()
            self.episode_length_buf = torch.zeros(WORLDS, dtype=torch.long)

        def fresh(self) -> torch.Tensor:
            return torch.rand(WORLDS, 4) * 0.1 - 0.05

        def get_observations(self) -> TensorDict:
            return TensorDict({"policy": self.state}, batch_size=[WORLDS])

        def step(self, actions: torch.Tensor) -> tuple:
            self.state = torch.stack(moved(torch, self.state.T, actions[:, 0] > 0), -1)
            self.episode_length_buf += 1
            down, late = fallen(self.state[:, 0], self.state[:, 2]), self.episode_length_buf >= LIMIT
            ended = down | late
            self.state = torch.where(ended[:, None], self.fresh(), self.state)
            self.episode_length_buf[ended] = 0
            return self.get_observations(), torch.ones(WORLDS), ended.long(), {"time_outs": late & ~down}

    network = {"class_name": "MLPModel", "hidden_dims": HIDDEN, "activation": "elu", "obs_normalization": True}
    config = {
        "num_steps_per_env": STEPS, "save_interval": 10**9, "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": network | {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0}},
        "critic": network, "algorithm": {
            "class_name": "PPO", "num_learning_epochs": EPOCHS, "num_mini_batches": MINIBATCHES, "gamma": GAMMA,
            "lam": LAMBDA, "learning_rate": RATES[schedule], "schedule": schedule, "entropy_coef": 0.0,
        },
    }  # fmt: skip
    runner = OnPolicyRunner(CartPole(), config, log_dir=None, device="cpu")
    actor, update, done = runner.alg.get_policy(), runner.alg.update, [0]

    def right(obs: np.ndarray) -> np.ndarray:
        seen = TensorDict({"policy": torch.as_tensor(obs)}, batch_size=[len(obs)])
        actor.eval()
        with torch.inference_mode():
            found = actor(seen)[:, 0] > 0
        actor.train()
        return found.numpy()

    def updated() -> dict:
        figures = update()
        done[0] += WORLDS * STEPS
        clock.judge(done[0], right)
        return figures

    runner.alg.update = updated
    clock.ready = clock.seconds()
    runner.learn(2 * MOST // BETWEEN, init_at_random_ep_len=True)


def work(task: dict) -> None:
    """One row, in this process."""
    clock = Clock(task["started"])
    run = {"sb3": run_sb3, "rsl_rl": run_rsl_rl}.get(task["who"], run_ours)
    with contextlib.suppress(Over), contextlib.redirect_stdout(sys.stderr):
        run(task["seed"], clock, task["schedule"])
    samples, seconds, length = clock.curve[-1]
    solved = length >= GOAL
    assert clock.ready is not None
    row = {"samples": samples if solved else None, "seconds": seconds if solved else None, "ready": clock.ready}
    print(json.dumps({k: task[k] for k in ("who", "seed")} | row | {"length": length, "curve": clock.curve}))


def row_of(who: str, seed: int, schedule: str, python: str, cache: str) -> dict:
    """One race, in a process of its own."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": "", "JAX_PLATFORMS": "cpu"}
    environment |= {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    words = json.dumps({"who": who, "seed": seed, "schedule": schedule, "started": time.time()})
    done = subprocess.run([python, __file__, "--work", words], env=environment, stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--who", nargs="*", default=list(WAYS), choices=WAYS)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument(
        "--schedule", choices=list(RATES), help="of the rate, of ours and rsl_rl; none: each its better"
    )
    parser.add_argument("--peers", default=sys.executable, metavar="PYTHON", help="interpreter of the peers")
    parser.add_argument("--work", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.work:
        return work(json.loads(args.work))
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    rows = []
    for seed in range(args.seeds):
        with tempfile.TemporaryDirectory() as cache:
            for who in args.who:
                python = args.peers if who in ("sb3", "rsl_rl") else sys.executable
                rows.append(row_of(who, seed, args.schedule or BETTER[who == "rsl_rl"], python, cache))
                print(json.dumps(rows[-1]), flush=True)
    for who in args.who:
        mine = [row for row in rows if row["who"] == who]
        middle = {k: statistics.median(r[k] or np.inf for r in mine) for k in ("samples", "seconds", "ready")}
        print(json.dumps({"who": who, "solved": sum(r["samples"] is not None for r in mine), "median": middle}))


if __name__ == "__main__":
    main()
