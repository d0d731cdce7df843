"""From a policy that fails on the robot to one that works: logs, diagnosis, correction, retraining, on hidden effects.

    python benchmarks/loop/closed_loop.py --task Cartpole --out DIR
    python benchmarks/loop/closed_loop.py --task Ant --out DIR --iterations 250 --seeds 2 -- --num_envs 4096

The surrogate real has three effects, a known parameter 10 % off and finer time steps than the simulator. A policy
trained on the simulator as it was is played on it and logged; `diagnose` sees model and logs alone; `gap_loop` retrains
on what it found, and beside it with wide randomisation and on the surrogate itself. Prints one line of JSON. What is
there already is taken up.
"""

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx import atomic, cli, rl
from bayessim_mjx.closed_loop import study
from bayessim_mjx.diagnosis.result import load as load_diagnosis
from bayessim_mjx.logs.log import Channels

MASS = {"kind": "body", "attribute": "mass", "mean": 1.1, "sd": 0.01, "low": 0.5, "high": 1.5}
HIDDEN = {
    "Cartpole": {
        "effects": [
            {"effect": "actuator_delay", "where": "slider_to_cart", "parameters": {"delay": {"nominal": 0.03}}},
            {
                "effect": "coulomb_friction", "where": "slider_to_cart",
                "parameters": {"level": {"nominal": 30.0, "range": [0, 60]}},
            },
            {"effect": "actuator_gain", "where": "slider_to_cart", "parameters": {"gain": {"nominal": 0.7}}},
        ],
        "calibrated": [MASS | {"name": "pole_mass_mult", "target": "pole"}],
    },
    "Ant": {
        "effects": [
            {"effect": "actuator_delay", "where": "all", "parameters": {"delay": {"nominal": 0.02}}},
            {"effect": "actuator_gain", "where": "all", "parameters": {"gain": {"nominal": 0.6}}},
            {"effect": "viscous_friction", "where": "all", "parameters": {"damping": {"nominal": 0.3}}},
        ],
        "calibrated": [MASS | {"name": "torso_mass_mult", "target": "torso"}],
    },
    "Anymal": {
        "effects": [
            {"effect": "actuator_delay", "where": "all", "parameters": {"delay": {"nominal": 0.01}}},
            {"effect": "actuator_gain", "where": "all", "parameters": {"gain": {"nominal": 0.6}}},
            {
                "effect": "coulomb_friction", "where": "all",
                "parameters": {"level": {"nominal": 4.0, "range": [0, 8]}},
            },
        ],
        "calibrated": [MASS | {"name": "base_mass_mult", "target": "base"}],
    },
}  # fmt: skip
STEP = {"Cartpole": 1 / 960, "Ant": 0.0025, "Anymal": 0.00125}  # s, of the surrogate's simulation: an eighth, fourths
RUNS, SECONDS, LEAST = 48, 4.0, 0.6  # logs, their length, and the shortest that is kept, s
GOES_ON = ("Cartpole",)  # moves on when an episode is over; the model of an ant on its back falls through the floor
SENSORS = 1e-3  # rad or m, and ten times as much per second


def truth(folder: Path, task: str) -> Path:
    """The surrogate as an effects.yaml (JSON is YAML)."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "truth.yaml"
    atomic.write_text(path, json.dumps({"schema": 1} | HIDDEN[task]))
    return path


def record(config, surrogate: Path, folder: Path, iterations: int) -> int:
    """Logs of the plain simulator's policy on the surrogate, as random as in training; how many."""
    plain = study.nominal_task(config)
    state = rl.init(plain, config.ppo, jax.random.PRNGKey(config.seed))
    state, _ = rl.run(plain, config.ppo, state, None, iterations=iterations)
    policy, real = rl.policy_of(state), study.surrogate(config, surrogate, timestep=STEP[config.task])
    thetas = jnp.tile(jnp.asarray(real.space.nominal, jnp.float32), (RUNS, 1))

    def play(key: jax.Array, theta: jax.Array) -> tuple:
        reset_key, key = jax.random.split(key)
        begun = real.reset(reset_key, theta)

        def step(state, key):
            action = policy.act(key, state.obs)  # its randomness excites what a good policy keeps still
            after = real.step(state, action)
            world = state.pipeline_state
            return after, (world.qpos, world.qvel, real.command(action), state.done)

        return jax.lax.scan(step, begun, jax.random.split(key, round(SECONDS / real.dt)))[1]

    rows = jax.jit(jax.vmap(play))(jax.random.split(jax.random.PRNGKey(1), RUNS), thetas)
    return sum(_write(folder, real, k, *[np.asarray(x[k], np.float64) for x in rows]) for k in range(RUNS))


def _write(folder: Path, env, run: int, qpos, qvel, ctrl, done) -> bool:
    """One log up to the end of its episode; False where that is too short to be of use."""
    over = (done > 0).any() and env.name not in GOES_ON
    length = int(np.argmax(done > 0)) if over else len(done)
    if length * env.dt < LEAST:
        return False
    names, rng = Channels.of(env.mj_model), np.random.default_rng(run)
    qpos, qvel = qpos + SENSORS * rng.normal(size=qpos.shape), qvel + 10 * SENSORS * rng.normal(size=qvel.shape)
    table = np.column_stack([np.arange(length) * env.dt, ctrl[:length], qpos[:length], qvel[:length]])
    header = ["time", *(f"ctrl:{n}" for n in names.actuators)]
    header += [*(f"qpos:{n}" for n in names.qpos), *(f"qvel:{n}" for n in names.qvel)]
    folder.mkdir(parents=True, exist_ok=True)
    np.savetxt(folder / f"run{run:02d}.csv", table, "%.9g", ",", header=",".join(header), comments="")
    return True


def command(name: str, *arguments: object) -> float:
    """Run a command of the package; its seconds."""
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-m", f"bayessim_mjx.{name}", *map(str, arguments)], check=True)
    return round(time.perf_counter() - begun, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=sorted(HIDDEN), default="Cartpole")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--iterations", type=int, default=250, help="PPO iterations of every policy")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--effects", default="all", help="on offer in the diagnosis")
    parser.add_argument("--timestep", type=float, help="s, of the corrected simulator (default: gap_loop's)")
    parser.add_argument("more", nargs="*", help="after --: further arguments of the task's configuration")
    args = parser.parse_args()
    config = cli.config_of(cli.Parser("closed_loop", "").parse(["--task", args.task, *args.more]))
    surrogate, logs, found = truth(args.out, args.task), args.out / "logs", args.out / "diagnosis"
    row: dict = {"task": args.task, "device": str(jax.devices()[0])}
    if not logs.is_dir():
        row["logs"] = record(config, surrogate, logs, args.iterations)
    if not (found / "diagnosis.json").is_file():
        row["diagnose s"] = command(
            "diagnose", "--task", args.task, "--data", logs, "--out", found, "--headless", "--effects", args.effects
        )
    given = ["--task", args.task, "--diagnosis", found, "--surrogate", surrogate, "--seeds", args.seeds, "--headless"]
    given += ["--surrogate_timestep", STEP[args.task]]
    given += [] if args.timestep is None else ["--timestep", args.timestep]
    row["gap_loop s"] = command("gap_loop", *given, "--iterations", args.iterations, *args.more)
    print(json.dumps(row | summary(found), default=float))


def summary(folder: Path) -> dict:
    """Verdict, gap in return and what retraining recovers."""
    found = load_diagnosis(folder)
    study = json.loads((folder / "gap_loop" / "gap_loop.json").read_text())
    effects = {f"{e.name}@{e.where}": {n: p.mean for n, p in e.parameters.items()} for e in found.effects}
    returns = {
        role: {on: round(np.mean([p["returns"][on]["mean"] for p in each]), 1) for on in each[0]["returns"]}
        for role, each in study["policies"].items()
    }
    gap = found.to_dict()["gap"]
    return {
        "verdict": found.verdict,
        "effects": effects,
        "motion gap": {k: gap[k] for k in ("nominal", "calibrated", "with_effects")},
        "returns": returns,
        "gap in return": study["gap"]["policy"],
        "recovered": study["recovery"],
    }


if __name__ == "__main__":
    main()
