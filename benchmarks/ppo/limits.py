"""How near training comes to what the machine can do: bare physics, arithmetic, more worlds, more devices."""

import argparse
import faulthandler
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx
from published import PUBLISHED, ppo_config

from bayessim_mjx import config, device, registry, rl
from bayessim_mjx.env import Task
from bayessim_mjx.rl import ppo
from bayessim_mjx.rl.catalogue import learner
from bayessim_mjx.rl.train import LATEST
from bayessim_mjx.rl.worlds import gather
from bayessim_mjx.rl.worlds import reset as reset_worlds

STATE = ("qpos", "qvel", "act", "qacc_warmstart")  # what the next timestep needs of mjx.Data
HUMANOID = (400, 200, 100)  # widths of Isaac Gym's Humanoid
PEAK = {"NVIDIA H200": (494e12, 67e12, 4.8e12)}  # dense TF32 and float32 FLOP/s, bytes/s, as the data sheet says
Say = Callable[[dict], None]


VARIANTS: dict[str, dict[str, Any]] = {  # ways to compile the update
    "no autotuning": {"xla_gpu_autotune_level": 0},
    "as is": {},
    "modules in parallel": {
        "xla_gpu_enable_llvm_module_compilation_parallelism": True, "xla_gpu_force_compilation_parallelism": 8,
    },
    "loops in command buffers": {
        "xla_gpu_enable_command_buffer": "FUSION,CUBLAS,CUDNN,CUSTOM_CALL,DYNAMIC_SLICE_FUSION,CONDITIONAL,WHILE",
    },
}  # fmt: skip


@lru_cache
def setting(task: str, worlds: int, **changes: Any) -> tuple[Any, Any]:
    """(environment, PPO settings) of a task of ours; of `brax:...` and `playground:...` as in the race."""
    if ":" in task:
        published = PUBLISHED[task]
        widening = max(1, (worlds or published["num_envs"]) // published["num_envs"])
        env = registry.make(task, episodeLength=published["episode_length"])
        return env, ppo_config(published, widening, **changes)
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
    precision = "highest" if isinstance(env, Task) else "default"  # as the environment has it
    names = STATE if lean else None
    keys = jax.random.split(jax.random.PRNGKey(0), worlds)
    nudged = jax.vmap(lambda k: start.replace(qpos=start.qpos + 0.01 * jax.random.normal(k, start.qpos.shape)))(keys)

    @partial(jax.jit)
    def run(data: Any) -> Any:
        def step(part: Any, _: None) -> tuple[Any, None]:
            data = jax.vmap(lambda p: start.replace(**p))(part) if lean else part
            data = jax.vmap(partial(mjx.step, model))(data)
            return ({name: getattr(data, name) for name in names} if lean else data), None

        with jax.default_matmul_precision(precision):
            return jax.lax.scan(step, data, None, length=steps)[0]

    given = {name: getattr(nudged, name) for name in names} if lean else nudged
    return lambda: run(given)


def bare_own(
    env: Task,
    state: Any,
    steps: int,
    model_of: Callable[[Any], mjx.Model] | None = None,
    template: mjx.Data | None = None,
    lean: bool = True,
) -> Callable[[], Any]:
    """The same, each world with a model of its own: parameters differ from world to world.

    model_of: the model of a world; template: what a lean state is completed by. By default both are those that the
    environment steps, Warp's where its physics is.
    """
    warp = env.physics.warp
    own, start, timestep = env.physics.model_of, env.physics.template, mjx.step
    if warp is not None:
        own, start, timestep = (lambda world: warp.model_of(world.fields)), warp.data, warp.step
    own, start = model_of or own, template or start

    @jax.jit
    def run(worlds: Any, part: Any) -> Any:
        def one(world: Any, part: Any) -> Any:
            data = timestep(own(world), start.replace(**part) if lean else part)
            return {name: getattr(data, name) for name in STATE} if lean else data

        def step(part: Any, _: None) -> tuple[Any, None]:
            return jax.vmap(one)(worlds, part), None

        with jax.default_matmul_precision("highest"):
            return jax.lax.scan(step, part, None, length=steps)[0]

    worlds = state.env_states.pipeline_state
    part = {"qpos": worlds.qpos, "qvel": worlds.qvel, "act": worlds.act, "qacc_warmstart": worlds.warmstart}
    part = part if lean else jax.vmap(lambda given: start.replace(**given))(part)
    return lambda: run(worlds, part)


def built(function: Callable[..., Any], *given: Any) -> tuple[Any, dict[str, float]]:
    """(compiled function, seconds of tracing, lowering and compiling)."""
    times = [time.perf_counter()]
    stage: Any = jax.jit(function)
    for step in (lambda f: f.trace(*given), lambda f: f.lower(), lambda f: f.compile()):
        stage = step(stage)
        times.append(time.perf_counter())
    return stage, {n: round(b - a, 2) for n, a, b in zip(("trace", "lower", "compile"), times, times[1:], strict=False)}


def limit(task: str, worlds: int, say: Say) -> None:
    """Rollout against bare physics of the same batch and sub-steps; SGD against its FLOPs and bytes."""
    env, settings = setting(task, worlds)
    worlds = settings.num_envs
    substeps = round(env.dt / env.mj_model.opt.timestep)
    init, init_s = built(lambda key: ppo.init(env, settings, key), jax.random.PRNGKey(0))
    state = init(jax.random.PRNGKey(0))
    update, update_s = built(lambda state: ppo.update(env, settings, state, None), state)
    row = {"task": task, "worlds": worlds, "steps": settings.num_steps, "substeps": substeps}
    whole = seconds(lambda: update(state))
    count = worlds * settings.num_steps
    say({"row": "programs", **row, "init": init_s, "update": update_s, "update_s": round(whole, 5),
         "train_steps_per_s": round(count / whole)})  # fmt: skip
    reset = built(lambda state: reset_worlds(env, state.key, None, worlds), state)[0]
    collect = built(lambda state: gather(learner(env, settings), state, None, state.key), state)[0]
    resets, rollout = seconds(lambda: reset(state)), seconds(lambda: collect(state))
    physics = {n: seconds(bare(env, worlds, settings.num_steps * substeps, n == "lean")) for n in ("lean", "whole")}
    best, sgd = min(physics.values()), whole - rollout
    if isinstance(env, Task):
        physics["own"] = seconds(bare_own(env, state, settings.num_steps * substeps))
    weights = sum(x.size for x in jax.tree.leaves(state.params) if x.ndim == 2)
    passes = count * settings.num_epochs
    flops = 6 * weights * passes + 4 * weights * count  # forward and backward; values before and after
    width = 2 * env.observation_size["policy"][0] + 2 * env.action_size + 4
    moved = 4 * (2 * width * passes + 2 * passes * sum((*settings.hidden_actor, *settings.hidden_critic)) * 2)
    row |= {
        "bare_s": {k: round(v, 5) for k, v in physics.items()}, "reset_s": round(resets, 5),
        "rollout_s": round(rollout, 5), "update_s": round(whole, 5), "rollout_share": round(best / rollout, 3),
        "rollout_steps_per_s": round(count / rollout), "train_steps_per_s": round(count / whole),
        "sgd_s": round(sgd, 5), "sgd_flops": flops, "sgd_bytes": moved,
    }  # fmt: skip
    if "own" in physics:
        row["rollout_share_own"] = round(physics["own"] / rollout, 3)
    kind = jax.devices()[0].device_kind
    if kind in PEAK:
        tensor, _, memory = PEAK[kind]
        row["sgd_share"] = round(max(flops / tensor, moved / memory) / sgd, 4)
    say({"row": "limit", **row})


def compilation(task: str, worlds: int, say: Say) -> None:
    """Seconds to compile the update, and of the update itself, by the compiler's options."""
    env, settings = setting(task, worlds)
    state = rl.init(env, settings, jax.random.PRNGKey(0))
    lowered = jax.jit(lambda state: ppo.update(env, settings, state, None)).lower(state)
    for name, options in VARIANTS.items():
        row: dict[str, Any] = {"row": "compilation", "task": task, "worlds": settings.num_envs, "variant": name}
        start = time.perf_counter()
        try:
            update = lowered.compile(compiler_options=options)
            row["compile_s"] = round(time.perf_counter() - start, 2)
            row["update_s"] = round(seconds(partial(update, state)), 5)
        except jax.errors.JaxRuntimeError as error:  # this compiler does not know the option
            row["failed"] = str(error)[:200]
        say(row)


def trained(env: Any, settings: Any, mesh: Any, iterations: int, seed: int = 0) -> tuple[list[dict], float]:
    """Metrics of each log interval, and seconds of the first one with compilation."""
    seen: list[dict] = []
    start = time.perf_counter()
    progress("compiling")
    state = rl.start(env, settings, jax.random.PRNGKey(seed), None, mesh)
    progress("first update")
    state, first = rl.run(env, settings, state, iterations=1)
    progress("further updates")
    compiled = time.perf_counter() - start
    rl.run(env, settings, state, iterations=iterations - 1, progress=lambda m, _: seen.append(dict(m)))
    return seen or [first], compiled


def progress(words: str) -> None:
    """A line for those who wait, and for the case that the process dies without one."""
    print(f"{time.strftime('%H:%M:%S')} {words}", file=sys.stderr, flush=True)


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
        progress(f"{task} on {count} devices")
        seen, compiled = trained(env, settings, mesh, iterations)
        speed = float(np.median([m["Perf/total_fps"] for m in seen]))
        alone = alone or speed
        row = {"row": "devices", "task": task, "devices": count, "worlds": worlds * count, "steps_per_s": round(speed)}
        say(row | {"efficiency": round(speed / count / alone, 3), "first_s": round(compiled, 1)})


def same_curve(task: str, worlds: int, iterations: int, say: Say) -> None:
    """The same worlds on one device and on all of them: how far the curves lie apart."""
    env, settings = setting(task, worlds, log_interval=5)
    counts = (1, len(jax.devices()))
    runs = [trained(env, settings, device.mesh_of(jax.devices()[:n]), iterations)[0] for n in counts]
    apart = []
    for one, other in zip(*runs, strict=True):
        tags = [t for t in one if t.split("/")[0] in ("Loss", "Policy") or t in LATEST]
        ratio = [abs(one[t] - other[t]) / (abs(one[t]) + 1e-2) for t in tags if np.isfinite(one[t])]
        apart.append(float(f"{max(ratio):.2e}"))
    rewards = [[round(m["Train/mean_reward"], 2) for m in run] for run in runs]
    say({"row": "curve", "task": task, "devices": counts, "worlds": worlds, "apart": apart, "rewards": rewards})


def measure(args: argparse.Namespace, say: Say) -> None:
    """What the command asks for."""
    faulthandler.enable()  # a process that a signal ends leaves a traceback
    print(jax.devices(), jnp.zeros(()).devices(), flush=True)
    if args.limit or args.compilation:
        for worlds in args.worlds or (0 if ":" in args.task else 4096,):
            (limit if args.limit else compilation)(args.task, worlds, say)
        return
    if "worlds" in args.scaling or not args.scaling:
        for worlds in args.worlds or [1024 * 2**i for i in range(7)]:
            over_worlds(args.task, worlds, args.iterations, say)
    if "devices" in args.scaling or not args.scaling:
        over_devices(args.task, (args.worlds or [4096])[0], args.iterations, say)
    if "curve" in args.scaling or not args.scaling:
        same_curve(args.task, (args.worlds or [4096])[0], args.iterations, say)
