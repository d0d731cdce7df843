"""How near training comes to what the machine can do: bare physics, arithmetic, more worlds, more devices."""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from bayessim_mjx import config, device, registry, rl
from bayessim_mjx.rl import ppo
from bayessim_mjx.rl.train import LATEST

HUMANOID = (400, 200, 100)  # widths of Isaac Gym's Humanoid
PEAK = {"NVIDIA H200": (494e12, 67e12, 4.8e12)}  # dense TF32 and float32 FLOP/s, bytes/s, as the data sheet says
Say = Callable[[dict], None]


def setting(task: str, worlds: int, **changes: Any) -> tuple[Any, Any]:
    """(environment, PPO settings) of a task of ours, or of `brax:...`."""
    settings = config.load(task, overrides=[f"env.numEnvs={worlds}"])
    return registry.make(task, config=settings), replace(settings.ppo, **changes)


def seconds(run: Callable[[], Any], repeats: int = 5) -> float:
    """Median time of a call, after one that compiles."""
    jax.block_until_ready(run())
    taken = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(run())
        taken.append(time.perf_counter() - start)
    return float(np.median(taken))


def bare(env: Any, worlds: int, steps: int, lean: bool) -> Callable[[], Any]:
    """`steps` of mjx.step in a scan over batched worlds that carries mjx.Data on; lean: only what MuJoCo's state is."""
    model = mjx.put_model(env.mj_model, impl="jax")
    start = mjx.make_data(env.mj_model, impl="jax")
    names = ("qpos", "qvel", "act", "qacc_warmstart") if lean else None
    keys = jax.random.split(jax.random.PRNGKey(0), worlds)
    nudged = jax.vmap(lambda k: start.replace(qpos=start.qpos + 0.01 * jax.random.normal(k, start.qpos.shape)))(keys)

    @partial(jax.jit)
    def run(data: Any) -> Any:
        def step(part: Any, _: None) -> tuple[Any, None]:
            data = jax.vmap(lambda p: start.replace(**p))(part) if lean else part
            data = jax.vmap(partial(mjx.step, model))(data)
            return ({name: getattr(data, name) for name in names} if lean else data), None

        with jax.default_matmul_precision("highest"):  # as our physics has it
            return jax.lax.scan(step, data, None, length=steps)[0]

    given = {name: getattr(nudged, name) for name in names} if lean else nudged
    return lambda: run(given)


def limit(task: str, worlds: int, say: Say) -> None:
    """Rollout against bare physics of the same batch and sub-steps; SGD against its FLOPs and bytes."""
    env, settings = setting(task, worlds)
    substeps = round(env.dt / env.mj_model.opt.timestep)
    steps = settings.num_steps * substeps
    physics = {name: seconds(bare(env, worlds, steps, name == "lean")) for name in ("whole", "lean")}
    state = rl.init(env, settings, jax.random.PRNGKey(0))
    collect = jax.jit(lambda state: ppo._collect(env, settings, state, None, state.key))
    rollout = seconds(lambda: collect(state))
    update = rl.make_update(env, settings)
    whole = seconds(lambda: update(state, None))
    count = worlds * settings.num_steps
    best, sgd = min(physics.values()), whole - rollout
    weights = sum(x.size for x in jax.tree.leaves(state.params) if x.ndim == 2)
    passes = count * settings.num_epochs
    flops = 6 * weights * passes + 4 * weights * count  # forward and backward; values before and after
    width = 2 * env.observation_size["policy"][0] + 2 * env.action_size + 4
    moved = 4 * (2 * width * passes + 2 * passes * sum((*settings.hidden_actor, *settings.hidden_critic)) * 2)
    row = {
        "row": "limit", "task": task, "worlds": worlds, "steps": settings.num_steps, "substeps": substeps,
        "bare_s": {k: round(v, 5) for k, v in physics.items()}, "rollout_s": round(rollout, 5),
        "update_s": round(whole, 5), "rollout_share": round(best / rollout, 3),
        "rollout_steps_per_s": round(count / rollout), "train_steps_per_s": round(count / whole),
        "sgd_s": round(sgd, 5), "sgd_flops": flops, "sgd_bytes": moved,
    }  # fmt: skip
    kind = jax.devices()[0].device_kind
    if kind in PEAK:
        tensor, _, memory = PEAK[kind]
        row["sgd_share"] = round(max(flops / tensor, moved / memory) / sgd, 4)
    say(row)


def trained(env: Any, settings: Any, mesh: Any, iterations: int, seed: int = 0) -> tuple[list[dict], float]:
    """Metrics of each log interval, and seconds of the first one with compilation."""
    seen: list[dict] = []
    start = time.perf_counter()
    state = rl.init(env, settings, jax.random.PRNGKey(seed), None, mesh)
    state, first = rl.run(env, settings, state, iterations=1)
    compiled = time.perf_counter() - start
    rl.run(env, settings, state, iterations=iterations - 1, progress=lambda m, _: seen.append(dict(m)))
    return seen or [first], compiled


def memory() -> int | None:
    """Most bytes in use so far, MiB; None where the device does not say."""
    stats = jax.devices()[0].memory_stats()
    return None if not stats else round(stats["peak_bytes_in_use"] / 2**20)


def over_worlds(task: str, worlds: int, iterations: int, say: Say) -> None:
    """Steps per second and memory of one device, nets as large as Humanoid's."""
    env, settings = setting(task, worlds, hidden_actor=HUMANOID, hidden_critic=HUMANOID, log_interval=5)
    seen, compiled = trained(env, settings, None, iterations)
    speed = float(np.median([m["Perf/total_fps"] for m in seen]))
    row = {"row": "worlds", "task": task, "worlds": worlds, "steps_per_s": round(speed), "peak_mib": memory()}
    say(row | {"first_s": round(compiled, 1)})


def over_devices(task: str, worlds: int, iterations: int, say: Say) -> None:
    """Weak scaling: so many worlds on each of 1, 2, 4 ... devices."""
    alone = 0.0
    for count in [n for n in (1, 2, 4, 8) if n <= len(jax.devices())]:
        env, settings = setting(task, worlds * count, log_interval=5)
        mesh = device.mesh_of(jax.devices()[:count])
        seen, compiled = trained(env, settings, mesh, iterations)
        speed = float(np.median([m["Perf/total_fps"] for m in seen]))
        alone = alone or speed
        row = {"row": "devices", "task": task, "devices": count, "worlds": worlds * count, "steps_per_s": round(speed)}
        say(row | {"efficiency": round(speed / count / alone, 3), "first_s": round(compiled, 1)})


def same_curve(task: str, worlds: int, iterations: int, say: Say) -> None:
    """The same worlds on one device and on all of them: how far the curves lie apart."""
    env, settings = setting(task, worlds, log_interval=1)
    counts = (1, len(jax.devices()))
    runs = [trained(env, settings, device.mesh_of(jax.devices()[:n]), iterations)[0] for n in counts]
    apart = []
    for one, other in zip(*runs, strict=True):
        tags = [t for t in one if t.split("/")[0] in ("Loss", "Policy") or t in LATEST]
        ratio = [abs(one[t] - other[t]) / (abs(one[t]) + 1e-6) for t in tags if np.isfinite(one[t])]
        apart.append(float(f"{max(ratio):.2e}"))
    rewards = [[round(m["Train/mean_reward"], 2) for m in run][:: max(1, iterations // 10)] for run in runs]
    say({"row": "curve", "task": task, "devices": counts, "worlds": worlds, "apart": apart, "rewards": rewards})


def measure(args: argparse.Namespace, say: Say) -> None:
    """What the command asks for."""
    print(jax.devices(), jnp.zeros(()).devices(), flush=True)
    if args.limit:
        for worlds in args.worlds or (4096,):
            limit(args.task, worlds, say)
        return
    if "worlds" in args.scaling or not args.scaling:
        for worlds in args.worlds or [1024 * 2**i for i in range(7)]:
            over_worlds(args.task, worlds, args.iterations, say)
    if "devices" in args.scaling or not args.scaling:
        over_devices(args.task, (args.worlds or [4096])[0], args.iterations, say)
    if "curve" in args.scaling or not args.scaling:
        same_curve(args.task, (args.worlds or [4096])[0], args.iterations, say)
