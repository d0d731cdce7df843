"""Seconds that a first fit takes to trace, lower and compile, program by program, and what a second one compiles.

    JAX_PLATFORMS=cpu python benchmarks/inference/compilation.py
    JAX_PLATFORMS=cpu python benchmarks/inference/compilation.py --problem two_moons --simulations 10000 components=8

One JSON row per fit. CPU seconds count where other work runs beside it. No persistent compilation cache may be set.
"""

from __future__ import annotations

import argparse
import collections
import json
import time
from typing import Any

import jax
from posteriors import option
from problems import PROBLEMS

from bayessim_mjx.inference import InferenceSettings, fit, init

STAGES = {
    "/jax/core/compile/jaxpr_trace_duration": "trace s",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower s",
    "/jax/core/compile/backend_compile_duration": "compile s",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", default="pendulum", choices=list(PROBLEMS))
    parser.add_argument("--simulations", type=int, default=1000)
    args, rest = parser.parse_known_args()
    if jax.config.values["jax_compilation_cache_dir"]:
        parser.error("unset JAX_COMPILATION_CACHE_DIR: programs that are found there are not compiled")
    problem, settings = PROBLEMS[args.problem](), InferenceSettings(**dict(map(option, rest)))
    thetas, x = jax.block_until_ready(problem.pairs(jax.random.PRNGKey(0), args.simulations))
    seconds: dict[str, dict[str, float]] = collections.defaultdict(lambda: collections.defaultdict(float))

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event in STAGES:
            name = str(kwargs.get("fun_name", "")).removeprefix("jit(").removesuffix(")")
            seconds[name][STAGES[event]] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(listen)
    for number in ("first", "second"):
        seconds.clear()
        wall, cpu = time.perf_counter(), time.process_time()
        state = init(jax.random.PRNGKey(0), settings, problem.space, x.shape[1])
        state, info = fit(jax.random.PRNGKey(1), state, thetas, x)
        jax.block_until_ready(state.params)
        row: dict[str, Any] = {"fit": number, "problem": problem.name, "simulations": args.simulations}
        row |= {"wall s": round(time.perf_counter() - wall, 2), "cpu s": round(time.process_time() - cpu, 2)}
        row |= {"log q": round(float(info.log_q), 3), "programs": len(seconds)}
        row["each"] = {name: {k: round(v, 2) for k, v in found.items()} for name, found in seconds.items()}
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
